"""Surface indices kept on disk, so that a large model is indexed once.

A file is ``<key>.avsindex``: 8 bytes of magic, the CRC-32 of the payload (4 bytes, little-endian), the payload. The key
is the SHA-256 of the layout version, the byte order, the reach and the vertices and faces of the surface, so a changed
model, reach or version uses another file. A truncated, altered or foreign file is ignored. A folder that
cannot be written to is no error: the index is then built in every run, with the same result.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

MAGIC = b"AVSINDEX"
HEADER = len(MAGIC) + 4
LEAST_PRIMITIVES = 20_000  # a smaller model is indexed faster than a file is found


def user_folder() -> Path | None:
    """Return the cache folder of avsreplay for this user by the rules of the platform; None where there is no home."""
    given = {"win32": "LOCALAPPDATA", "darwin": ""}.get(sys.platform, "XDG_CACHE_HOME")
    base = Path(os.environ.get(given, "")) if given else Path()
    if base.is_absolute():  # a relative path is invalid by the XDG specification
        return base / "avsreplay"
    if sys.platform == "win32":
        return None
    try:
        return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "avsreplay"
    except RuntimeError:  # no home folder
        return None


def cache_path(folder: Path, layout: int, vertices: Array, faces: NDArray[np.int32], reach_m: float) -> Path:
    """Return the file name of the index of a surface.

    Args:
        folder: cache folder.
        layout: version of the layout of the index.
        vertices: (n, 3) in {C} [m].
        faces: (m, 3) vertex indices.
        reach_m: largest distance of a query [m].
    """
    key = hashlib.sha256(f"{layout} {sys.byteorder} {float(reach_m).hex()} {vertices.shape} {faces.shape}".encode())
    key.update(vertices.tobytes())
    key.update(faces.tobytes())
    return folder / f"{key.hexdigest()}.avsindex"


def checksum(payload: bytes | memoryview) -> bytes:
    """Return the checksum of a payload as it stands in the file; SHA-256 takes four times as long."""
    return zlib.crc32(payload).to_bytes(4, "little")


def read(path: Path) -> memoryview | None:
    """Return the payload, or None if there is no complete, unchanged file."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    payload = memoryview(data)[HEADER:]
    whole = data[:HEADER] == MAGIC + checksum(payload)
    return payload if whole else None


def write(path: Path, payload: bytes) -> bool:
    """Write the file completely or not at all; return whether it was written."""
    name = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem[:8], suffix=".part")
        with os.fdopen(handle, "wb") as out:
            out.write(MAGIC + checksum(payload))
            out.write(payload)
        Path(name).replace(path)
    except OSError:
        if name:
            Path(name).unlink(missing_ok=True)
        return False
    return True
