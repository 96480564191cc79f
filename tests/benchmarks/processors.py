"""Are the results the same bytes on every processor? ``python tests/benchmarks/processors.py
[--quick] [--qemu]``

Replays the fixtures with every installed back end and records a scenario, each run in a process of
its own, on this processor and on emulated ones, and compares ``rows.jsonl`` and the recorded log
byte for byte. For each environment that differs it prints the first differing cells and the columns
with the largest differences.

Two kinds of emulation. Environment variables choose the kernel of OpenBLAS, numpy's SIMD variants
and the variants of glibc: quick, but the command itself sets these variables unless
``AVSREPLAY_ARITHMETIC=native`` (``--native``) asks it not to. ``--qemu`` runs the whole interpreter
on an emulated processor (package qemu-user), which nothing in the process can override. ``--aarch64
PYTHON`` adds an interpreter for aarch64 with this project installed (``PYTHON`` may be a command
line, for example ``qemu-aarch64 -L ROOT ROOT/usr/bin/python3``).

Exit code 1 if any compared run differs, except the back ends of others (``--exact`` names those
that must agree).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from avsreplay import arithmetic

ROOT = Path(__file__).resolve().parents[2]
CASES = {
    "tumble": ("tumble.mcap",),
    "spin-raster": ("spin-raster.mcap",),
    "auto start": ("tumble.mcap", "--init", "auto"),
    "batch fit": ("tumble.mcap", "--guess", "last", "--policy", "all", "--reference", "fit"),
    "reference": ("tumble.mcap", "--backend", "reference", "--n-scans", "12"),
    "kiss": ("tumble.mcap", "--backend", "kiss"),
    "small_gicp": ("tumble.mcap", "--backend", "small_gicp"),
    "open3d": ("tumble.mcap", "--backend", "open3d"),
    "record": ("tumble.toml",),
}
EXACT = ("tumble", "spin-raster", "auto start", "batch fit", "reference", "record")
AVX512 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR X86_V4"
AVX2 = f"AVX F16C FMA3 AVX2 X86_V3 {AVX512}"
NO_FMA = "glibc.cpu.hwcaps=-AVX2_Usable,-FMA_Usable,-FMA4_Usable,-AVX2,-FMA,-FMA4"
NO_AVX = f"{NO_FMA},-AVX_Usable,-AVX,-AVX512F,-ERMS"
ENVIRONMENTS: dict[str, dict[str, str]] = {
    **{
        f"BLAS {name}": {"OPENBLAS_CORETYPE": name}
        for name in (
            "Prescott",
            "Core2",
            "Nehalem",
            "Sandybridge",
            "Haswell",
            "Zen",
            "SkylakeX",
            "Cooperlake",
        )
    },
    "numpy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": AVX512},
    "numpy without AVX2": {"NPY_DISABLE_CPU_FEATURES": AVX2},
    "glibc without FMA": {"GLIBC_TUNABLES": NO_FMA},
    "glibc without AVX": {"GLIBC_TUNABLES": NO_AVX},
    "all as Haswell": {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": AVX512},
    "all as Nehalem": {
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": AVX2,
        "GLIBC_TUNABLES": NO_AVX,
    },
}
QEMU = ("Nehalem", "Haswell")  # it emulates no AVX-512
OVERRIDDEN = (*arithmetic.PINS, arithmetic.VARIABLE)


def replay(python: list[str], case: str, out: Path, extra: dict[str, str]) -> bytes:
    """``rows.jsonl`` of one run, or the log that a scenario gives.

    Raises SystemExit if the command fails.
    """
    name, *flags = CASES[case]
    command = "record" if name.endswith(".toml") else "run"
    out = out / f"{command}.mcap" if command == "record" else out / command
    words = [
        *python,
        "-m",
        "avsreplay",
        command,
        str(ROOT / "fixtures" / name),
        "-o",
        str(out),
        "--overwrite",
        *flags,
    ]
    env = {k: v for k, v in os.environ.items() if k not in OVERRIDDEN}
    done = subprocess.run(
        words, cwd=ROOT, env={**env, **extra}, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 4):
        raise SystemExit(
            f"{shlex.join(words)}\nended with {done.returncode}:\n{done.stderr[-2000:]}"
        )
    return out.read_bytes() if command == "record" else (out / "rows.jsonl").read_bytes()


def difference(one: bytes, other: bytes) -> dict[str, object]:
    """What differs between two files of rows, or between two logs."""
    if not one.startswith(b"{"):
        return {
            "bytes": sum(x != y for x, y in zip(one, other, strict=False)),
            "lengths": [len(one), len(other)],
        }
    a, b = ([json.loads(line) for line in text.splitlines()] for text in (one, other))
    cells = [
        (i, name)
        for i, (x, y) in enumerate(zip(a, b, strict=True))
        for name in x
        if x[name] != y.get(name)
    ]
    largest: dict[str, float] = {}
    flags = 0
    for i, name in cells:
        x, y = a[i][name], b[i][name]
        if isinstance(x, float) and isinstance(y, float):
            largest[name] = max(largest.get(name, 0.0), abs(x - y))
        else:
            flags += 1
    worst = dict(sorted(largest.items(), key=lambda item: -item[1])[:6])
    return {
        "cells": len(cells),
        "not numbers": flags,
        "rows": len({i for i, _ in cells}),
        "first": cells[:3],
        "largest": {name: float(f"{value:.2g}") for name, value in worst.items()},
    }


def environments(asked: argparse.Namespace) -> dict[str, tuple[list[str], dict[str, str]]]:
    """Name -> (interpreter, environment variables); the first is this processor."""
    here = [sys.executable]
    found: dict[str, tuple[list[str], dict[str, str]]] = {"this processor": (here, {})}
    if not asked.qemu_only:
        found |= {name: (here, variables) for name, variables in ENVIRONMENTS.items()}
    if asked.qemu or asked.qemu_only:
        # The pins are set from outside: a process that replaces itself would leave the emulator.
        found |= {
            f"qemu {cpu}": (["qemu-x86_64", "-cpu", cpu, *here], arithmetic.PINS) for cpu in QEMU
        }
    if asked.aarch64:
        found["aarch64"] = (shlex.split(asked.aarch64), {})
    if asked.quick:
        found = dict(list(found.items())[:1] + list(found.items())[-2:])
    native = {arithmetic.VARIABLE: "native"} if asked.native else {}
    return {name: (python, {**variables, **native}) for name, (python, variables) in found.items()}


def main() -> int:
    """Run and print one JSON document per run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument(
        "--exact", nargs="*", default=list(EXACT), help="cases that must agree byte for byte"
    )
    parser.add_argument(
        "--qemu", action="store_true", help="also on processors emulated by qemu-user"
    )
    parser.add_argument("--qemu-only", action="store_true", help="only those")
    parser.add_argument("--aarch64", help="command line of a Python interpreter for aarch64")
    parser.add_argument(
        "--native", action="store_true", help="let the libraries choose their arithmetic"
    )
    parser.add_argument("--quick", action="store_true", help="two environments")
    asked = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for case in asked.cases:
            first = None
            for name, (python, extra) in environments(asked).items():
                rows = replay(python, case, Path(folder), extra)
                first = rows if first is None else first
                what = "same" if rows == first else difference(first, rows)
                wrong += case in asked.exact and rows != first
                print(json.dumps({"case": case, "processor": name, "rows": what}), flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
