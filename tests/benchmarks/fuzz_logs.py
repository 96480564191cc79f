"""Fuzz campaign on everything that reads bytes: ``python tests/benchmarks/fuzz_logs.py [--quick]
[--inputs N]``.

Input i depends only on (campaign, i), so a finding is repeated with ``--only i``. Every input must
end in scans or in one AvsError: a traceback, more than 10 s, more than the stated memory, a crash
of the interpreter or a file written anywhere is a finding.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fuzz_inputs import case, seeds
from fuzz_workers import Campaign, Check, report, run_campaign

from avsreplay import toml_document
from avsreplay.errors import AvsError
from avsreplay.log import SourceOptions, open_source, parse_surface
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.doctor import examine, repair
from avsreplay.log.point_cloud2 import raw_cloud
from avsreplay.log.pose_files import read_conf, read_poses

LIMIT_S, LIMIT_MIB, MESSAGE_MIB = 10, 512, 16
MAX_SEED = 512 << 10
LOGS, POSES = ("mcap", "bag", "db3"), ("tum", "kitti", "euroc")


def check(name: str, data: bytes, folder: Path, deep: bool) -> str:
    """Give one input to what reads it; what came of it in one word.

    Raises whatever is no AvsError.
    """
    kind = name.rsplit(".", 1)[-1]
    try:
        if kind in ("cdr", "ros1"):
            raw_cloud(data, kind)
        elif kind == "toml":
            toml_document.parse(data.decode("utf-8", "replace"), name)
        elif name.startswith("model"):
            parse_surface(data, name)
        else:
            return _file(name, kind, data, folder, deep)
    except (AvsError, BadMessage) as error:
        return _one_line(error)
    return "read"


def _one_line(error: Exception) -> str:
    text = str(error)
    if isinstance(error, AvsError) and ("\n" in text or "\x1b" in text):
        raise AssertionError(f"an error of more than one line, or with controls: {text!r}")
    return "refused"


def _file(name: str, kind: str, data: bytes, folder: Path, deep: bool) -> str:
    path = folder / name
    path.write_bytes(data)
    try:
        if kind in POSES:
            read_poses(path)
        elif kind == "conf":
            read_conf(path)
        else:
            lost = _scan(path if kind in LOGS else folder)
            if deep and kind == "mcap":
                _doctored(path, folder)
            return "partly" if lost else "read"
    finally:
        for left in folder.iterdir():
            left.unlink()
    return "read"


def _scan(path: Path) -> int:
    with open_source(path, SourceOptions(max_message_mib=MESSAGE_MIB), inspect=True) as source:
        source.info()
        damaged = sum(scan.status.value == "damaged" for scan in source.scans())
        return damaged + len(source.losses)


def _doctored(path: Path, folder: Path) -> None:
    examine(path, SourceOptions(max_message_mib=MESSAGE_MIB))
    clean = folder / "clean.mcap"
    repair(path, clean, max_message_mib=MESSAGE_MIB)
    with open_source(clean, inspect=True) as source:
        if source.losses:
            raise AssertionError(f"a repaired file that has losses: {source.losses}")
        if any(scan.status.value == "damaged" for scan in source.scans()):
            raise AssertionError("a repaired file with a damaged scan")


def corpus_of(folders: list[Path]) -> dict[str, bytes]:
    """The seeds, or in their place every small file of the folders that a reader here knows by its
    ending.
    """
    kinds = {*LOGS, "ply", "pcd", "conf", "obj"}
    files = sorted(p for folder in folders for p in folder.rglob("*") if p.suffix[1:] in kinds)
    small = [p for p in files if p.stat().st_size <= MAX_SEED]
    named = {
        ("model-" if p.suffix == ".obj" else f"{i}-") + p.name: p.read_bytes()
        for i, p in enumerate(small)
    }
    return named if folders else seeds()


def campaign(
    number: int, inputs: list[int], batch: int, folders: list[Path] | None = None
) -> Campaign:
    """Run the inputs of a campaign in batches."""
    corpus = corpus_of(folders or [])

    def task(at: int) -> tuple[str, Check]:
        name, data = case(number, at, corpus)
        return name, lambda folder: check(name, data, folder, deep=at % 5 == 0)

    return run_campaign(inputs, task, LIMIT_S, LIMIT_MIB, batch)


def main() -> int:
    """Run and print one JSON document; exit 1 on any finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--campaign", type=int, default=1)
    parser.add_argument("--only", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument(
        "--seeds", type=Path, nargs="*", default=[], help="folders with files to mutate"
    )
    parser.add_argument("--quick", action="store_true", help="1,000 inputs")
    asked = parser.parse_args()
    count = 1000 if asked.quick else asked.inputs
    inputs = (
        [asked.only] if asked.only is not None else list(range(asked.first, asked.first + count))
    )
    return report(asked.campaign, len(inputs), campaign(asked.campaign, inputs, 2500, asked.seeds))


if __name__ == "__main__":
    raise SystemExit(main())
