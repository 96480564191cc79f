"""Surface indices kept on disk, so that a large model is indexed once.

A file is ``<key>.avsindex``: 8 bytes of magic, the SHA-256 of the payload, the payload. The key is the SHA-256 of the
layout version, the byte order, the reach and the vertices and faces of the surface, so a changed model, reach or
version uses another file. A file that is truncated, altered or of another kind is ignored.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import UsageError
from avsreplay.geometry import Array

MAGIC = b"AVSINDEX"


def path_of(folder: Path, layout: int, vertices: Array, faces: NDArray[np.int32], reach_m: float) -> Path:
    """Return the file name of the index of this surface and reach in ``folder``."""
    key = hashlib.sha256(f"{layout} {sys.byteorder} {float(reach_m).hex()} {vertices.shape} {faces.shape}".encode())
    key.update(vertices.tobytes())
    key.update(faces.tobytes())
    return folder / f"{key.hexdigest()}.avsindex"


def read(path: Path) -> bytes | None:
    """Return the payload, or None if there is no complete, unchanged file."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    magic, digest, payload = data[:8], data[8:40], data[40:]
    whole = magic == MAGIC and hashlib.sha256(payload).digest() == digest
    return payload if whole else None


def write(path: Path, payload: bytes) -> None:
    """Write the file atomically. Raises UsageError if the folder cannot be written to."""
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem[:8], suffix=".part")
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(MAGIC + hashlib.sha256(payload).digest() + payload)
        Path(name).replace(path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> UsageError:
    reason = error.strerror or "cannot be written"
    return UsageError(f"index not saved: {reason}", where=str(path.parent), hint="name a folder that can be written to")
