"""Coverage-guided fuzzing of the parsers that see bytes first, through atheris (``pip install
atheris``).

``python tests/benchmarks/fuzz_parsers.py {cdr,ros1,pcd,ply,lzf,npy} [-runs=200000] [-max_len=4096]
[corpus folders]``: the arguments behind the parser's name are libFuzzer's. A crash file in the
working folder is a finding.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["avsreplay.log"]):
    from fuzz_inputs import seeds

    from avsreplay.binary_files import BadFile
    from avsreplay.log.bytes_io import BadMessage
    from avsreplay.log.ply import read_ply
    from avsreplay.log.point_cloud2 import raw_cloud
    from avsreplay.log.scan_files import read_pcd, read_points, unpack_lzf

_SCRATCH = Path(tempfile.mkdtemp()) / "one.npy"


def _npy(data: bytes) -> object:
    _SCRATCH.write_bytes(data)
    return read_points(_SCRATCH, 1 << 20)


PARSERS: dict[str, Callable[[bytes], object]] = {
    "cdr": raw_cloud,
    "ros1": lambda data: raw_cloud(data, "ros1"),
    "pcd": read_pcd,
    "ply": read_ply,
    "lzf": lambda data: unpack_lzf(data[2:], int.from_bytes(data[:2], "little")),
    "npy": _npy,
}


def main() -> None:
    """Hand over to libFuzzer, with the valid files of that kind as a corpus."""
    kind = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if kind not in PARSERS:
        raise SystemExit(f"which parser? one of {', '.join(PARSERS)}")
    parser = PARSERS[kind]

    def one(data: bytes) -> None:
        try:
            parser(data)
        except (BadMessage, BadFile):
            return

    corpus = Path(tempfile.mkdtemp())
    for name, data in seeds().items():
        if name.endswith(kind):
            (corpus / name).write_bytes(data)
    atheris.Setup([*sys.argv, str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
