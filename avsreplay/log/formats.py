"""One scan from one file: PLY, PCD, KITTI ``.bin``, ``.npy``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.log.ply import BadFile, read_ply

__all__ = ["SCAN_FORMATS", "read_points"]


def read_points(path: Path) -> NDArray[Any]:
    """(n, 3) points of a file as they stand in it, float32 or float64.

    Raises BadFile where the bytes are not what the ending says, OSError where they cannot be read.
    """
    return _READERS[path.suffix.lower()](path.read_bytes())


def _floats(points: NDArray[Any]) -> NDArray[Any]:
    return points if points.dtype in (np.float32, np.float64) else points.astype(np.float64)


def _ply(data: bytes) -> NDArray[Any]:
    return _floats(read_ply(data).points())


def _kitti(data: bytes) -> NDArray[Any]:
    if len(data) % 16:
        raise BadFile(f"{len(data)} bytes are not whole KITTI points of 16")
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3]


_READERS: dict[str, Callable[[bytes], NDArray[Any]]] = {".ply": _ply, ".bin": _kitti}
SCAN_FORMATS = tuple(_READERS)
