"""Damage matrix: kind x place x compression; what is recovered against what is intact, byte for
byte.

``python tests/benchmarks/log_damage.py [--quick] [--seed S]``. A scan is intact where no byte of
its chunk's record is touched. Every cell damages the log at random places of its kind; the share of
intact scans that come back bit for bit must be 100 %, no scan may come back other than it was
written, and a damaged log must list a loss.
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from log_cases import header, scans, write

from avsreplay.errors import AvsError
from avsreplay.log import mcap_format as mcap
from avsreplay.log import open_source

CLOUDS = scans(40, 300)
Damage = Callable[[bytes, int, np.random.Generator], bytes]


def flip(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    """One bit."""
    out = bytearray(data)
    out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def zero(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    """A run of zeros, as a lost disk block leaves."""
    size = int(rng.integers(64, 1025))
    return data[:at] + bytes(min(size, len(data) - at)) + data[at + size :]


def remove(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    """Bytes taken out."""
    return data[:at] + data[at + int(rng.integers(1, 257)) :]


def insert(data: bytes, at: int, rng: np.random.Generator) -> bytes:
    """Bytes put in."""
    return (
        data[:at]
        + rng.integers(0, 256, int(rng.integers(1, 257)), dtype=np.uint8).tobytes()
        + data[at:]
    )


def cut(data: bytes, at: int, _rng: np.random.Generator) -> bytes:
    """The end cut off."""
    return data[:at]


KINDS: dict[str, Damage] = {
    "flip": flip,
    "zero": zero,
    "remove": remove,
    "insert": insert,
    "cut": cut,
}


def frames(data: bytes) -> list[tuple[int, int, int]]:
    """(opcode, begin, end) of every record."""
    at, out = 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        out.append((opcode, at, at + 9 + length))
        at += 9 + length
    return out


def places(data: bytes) -> dict[str, tuple[int, int]]:
    """Byte ranges by name."""
    found = frames(data)
    chunk = [(b, e) for op, b, e in found if op == mcap.Opcode.CHUNK]
    index = next(
        (b, e)
        for op, b, e in found
        if op == mcap.Opcode.MESSAGE_INDEX and b >= chunk[len(chunk) // 2][1]
    )
    end = next(e for op, _, e in found if op == mcap.Opcode.DATA_END)
    named = {"header record": mcap.Opcode.METADATA, "model": mcap.Opcode.ATTACHMENT}
    out = {
        name: next((b, e) for op, b, e in found if op == opcode) for name, opcode in named.items()
    }
    out |= {
        "first chunk": chunk[0],
        "a chunk's head": (chunk[7][0], chunk[7][0] + 49),
        "middle chunk": chunk[9],
    }
    return out | {"last chunk": chunk[-1], "message index": index, "summary": (end, len(data) - 8)}


def untouched(data: bytes, broken: bytes) -> set[int]:
    """Stamps of the scans in chunks whose record is still there, whole."""
    chunk = [(b, e) for op, b, e in frames(data) if op == mcap.Opcode.CHUNK]
    whole = [data[b:e] in broken for b, e in chunk]
    return {CLOUDS[i].t_ns for i in range(len(CLOUDS)) if whole[i // 2]}


def cell(
    data: bytes,
    span: tuple[int, int],
    kind: str,
    folder: Path,
    rng: np.random.Generator,
    tries: int,
) -> list[int]:
    """Intact, recovered of them, wrong, not told, refused: sums over the tries."""
    total = np.zeros(5, dtype=int)
    for _ in range(tries):
        broken = KINDS[kind](data, int(rng.integers(*span)), rng)
        path = folder / "x.mcap"
        path.write_bytes(broken)
        intact = untouched(data, broken)
        try:
            with open_source(path) as source:
                found = {s.t_ns: s.points.tobytes() for s in source.scans()}
                losses = source.losses
        except AvsError:
            total += (len(intact), 0, 0, 0, 1)
            continue
        right = {c.t_ns: c.points.tobytes() for c in CLOUDS}
        good = {t for t, points in found.items() if right.get(t) == points}
        silent = int(len(good) < len(CLOUDS) and not losses)
        total += (len(intact), len(intact & good), len(found) - len(good), silent, 0)
    return total.tolist()


def main() -> int:
    """Print the matrix; exit 1 where an intact scan is not recovered, one is wrong, or a loss
    is not told.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tries", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="three tries a cell")
    asked = parser.parse_args()
    rng, bad = np.random.Generator(np.random.PCG64(asked.seed)), 0
    print(
        f"{'compression':12s}{'place':16s}{'kind':8s}{'intact':>8s}{'back':>8s}{'wrong':>7s}{'untold':>8s}{'refused':>9s}"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for compression in ("none", "lz4", "zstd"):
            write(
                folder / "a.mcap",
                header(np.random.Generator(np.random.PCG64(1))),
                CLOUDS,
                compression=compression,
                overwrite=True,
            )
            data = (folder / "a.mcap").read_bytes()
            for place, span in places(data).items():
                for kind in KINDS:
                    row = cell(data, span, kind, folder, rng, 3 if asked.quick else asked.tries)
                    bad += row[0] - row[1] + row[2] + row[3]
                    print(
                        f"{compression:12s}{place:16s}{kind:8s}"
                        + "{:8d}{:8d}{:7d}{:8d}{:9d}".format(*row)
                    )
    print(json.dumps({"short of perfect": bad}))
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
