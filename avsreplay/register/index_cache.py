"""Surface indices, and what a search needs of a model, kept on disk, so that a large model is
prepared once.

A file is ``<key>.avsindex``: 8 bytes of magic, a checksum of the payload (8 bytes), zeros up to 64,
the payload. The key is the SHA-256 of the layout version, the byte order, the reach and the
vertices and faces of the surface, so a changed model, reach or version uses another file. A
truncated, altered or foreign file is ignored. A folder that cannot be written to is no error: the
index is then built in every run, with the same result.
"""

from __future__ import annotations

import hashlib
import io
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.binary_files import parse_npy, read_members
from avsreplay.geometry import Array
from avsreplay.read_budget import BadFile, ReadBudget
from avsreplay.records import Surface

MAGIC = b"AVSINDEX"
HEADER = 64  # the arrays of the payload are aligned to this in the file and in memory
LEAST_PRIMITIVES = 20_000  # a smaller model is indexed faster than its file is read


def user_folder() -> Path | None:
    """Return the cache folder of avsreplay for this user by the rules of the platform; None
    where there is no home.
    """
    given = {"win32": "LOCALAPPDATA", "darwin": ""}.get(sys.platform, "XDG_CACHE_HOME")
    base = Path(os.environ.get(given, "")) if given else Path()
    if base.is_absolute():  # a relative path is invalid by the XDG specification
        return base / "avsreplay"
    if sys.platform == "win32":
        return None
    try:
        return (
            Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "avsreplay"
        )
    except RuntimeError:  # no home folder
        return None


def folder_for(surface: Surface) -> Path | None:
    """Return the cache folder if the surface is large enough for a file; else None."""
    large = max(len(surface.vertices), len(surface.faces)) >= LEAST_PRIMITIVES
    return user_folder() if large else None


def cache_path(
    folder: Path, layout: int | str, vertices: Array, faces: NDArray[np.int32], reach_m: float
) -> Path:
    """Return the file name of the index of a surface.

    Args:
        folder: cache folder.
        layout: version of the layout of the index, or of what else is kept of the surface.
        vertices: (n, 3) in {C} [m].
        faces: (m, 3) vertex indices.
        reach_m: largest distance of a query [m].
    """
    key = hashlib.sha256(
        f"{layout} {sys.byteorder} {float(reach_m).hex()} {vertices.shape} {faces.shape}".encode()
    )
    key.update(np.ascontiguousarray(vertices).data)
    key.update(np.ascontiguousarray(faces).data)
    return folder / f"{key.hexdigest()}.avsindex"


Checksum = Callable[[NDArray[np.uint8]], int]
"""The checksum of the kernel, because zlib's CRC-32 takes five times as long."""


def header(payload: bytes | NDArray[np.uint8], checksum: Checksum) -> bytes:
    """Return the bytes of the file before a payload."""
    value = checksum(np.frombuffer(payload, np.uint8))
    return (MAGIC + value.to_bytes(8, sys.byteorder)).ljust(HEADER, b"\0")


def read(path: Path, checksum: Checksum) -> NDArray[np.uint8] | None:
    """Return the payload, or None if there is no complete, unchanged file."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    payload = data[HEADER:]
    whole = len(data) > HEADER and data[:HEADER].tobytes() == header(payload, checksum)
    return payload if whole else None


def read_arrays(path: Path | None, checksum: Checksum) -> dict[str, NDArray[Any]]:
    """Return the arrays that ``write_arrays`` wrote by their names; none without a complete,
    unchanged file.
    """
    payload = None if path is None else read(path, checksum)
    if payload is None:
        return {}
    try:
        members = read_members(payload.tobytes(), ReadBudget(payload.nbytes))
        return {name.removesuffix(".npy"): parse_npy(member) for name, member in members.items()}
    except BadFile:  # another program wrote it
        return {}


def write_arrays(path: Path | None, arrays: Mapping[str, NDArray[Any]], checksum: Checksum) -> None:
    """Write arrays to a file where there is a path; the same arrays give the same bytes."""
    if path is not None:
        out = io.BytesIO()
        np.savez(out, allow_pickle=False, **arrays)
        write(path, out.getvalue(), checksum)


def write(path: Path, payload: bytes, checksum: Checksum) -> bool:
    """Write the file completely or not at all; return whether it was written."""
    name = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem[:8], suffix=".part")
        with os.fdopen(handle, "wb") as out:
            out.write(header(payload, checksum))
            out.write(payload)
        Path(name).replace(path)
    except OSError:
        if name:
            Path(name).unlink(missing_ok=True)
        return False
    return True
