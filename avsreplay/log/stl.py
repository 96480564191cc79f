"""Reading of binary STL files, the usual export of CAD programs. Other STL files are left to trimesh.

Trimesh loads SciPy, which takes 0.4 s of processor time. Vertices and faces are the same as from trimesh.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avsreplay.binary_files import BadFile
from avsreplay.geometry import Array

_HEAD = 84  # a text of 80 bytes, then the number of triangles
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_binary_stl(data: bytes) -> tuple[Array, NDArray[np.int64]] | None:
    """Return the corners of all triangles and the triangles, in the order of the file.

    Args:
        data: the bytes of an STL file.

    Returns:
        Corners (3 n, 3) in the unit of the file and faces (n, 3); None if the file is not binary, has no triangle, or
        is longer than its number of triangles states.

    Raises:
        BadFile: the file is binary and shorter than that.
    """
    count = int.from_bytes(data[80:_HEAD], "little")
    size = _HEAD + count * _TRIANGLE.itemsize
    if _HEAD <= len(data) < size and not data.lstrip().startswith(b"solid"):
        raise BadFile(f"declares {count} triangles in a file of {len(data)} bytes")
    if not count or len(data) != size:
        return None
    corners = np.frombuffer(data, _TRIANGLE, offset=_HEAD)["corners"]
    return corners.reshape(-1, 3).astype(np.float64), np.arange(3 * count, dtype=np.int64).reshape(-1, 3)
