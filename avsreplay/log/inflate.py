"""Decompression that never gives more than it was promised."""

from __future__ import annotations

import threading
from typing import Any

from avsreplay.log.cursor import BadMessage

__all__ = ["inflate"]

_PER_THREAD = threading.local()  # a decompressor is costly to make and serves one thread at a time


def inflate(data: bytes, compression: str, size: int) -> bytes:
    """Exactly ``size`` bytes. Raises BadMessage where the data holds more, fewer, or is not what it says."""
    if compression == "":
        out = data
    elif compression == "zstd":
        out = _zstd(data, size)
    elif compression == "lz4":
        out = _lz4(data, size)
    elif compression == "bz2":
        out = _bz2(data, size)
    else:
        raise BadMessage(f"unknown compression '{compression}'")
    if len(out) != size:
        raise BadMessage(f"a chunk inflates to other than the {size} bytes it promises")
    return out


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        promised = zstandard.get_frame_parameters(data).content_size
        # The library reserves what the frame's own head promises, whatever limit it is given.
        if promised not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise BadMessage(f"a chunk inflates to other than the {size} bytes it promises")
        if not hasattr(_PER_THREAD, "zstd"):
            _PER_THREAD.zstd = zstandard.ZstdDecompressor()
        out: bytes = _PER_THREAD.zstd.decompress(data, max_output_size=max(size, 1))
        return out
    except (zstandard.ZstdError, MemoryError) as error:
        raise BadMessage(f"a chunk does not inflate: {error}") from None


def _lz4(data: bytes, size: int) -> bytes:
    import lz4.frame

    try:
        frame: Any = lz4.frame
        out: bytes = frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise BadMessage(f"a chunk does not inflate: {error}") from None
    return out


def _bz2(data: bytes, size: int) -> bytes:
    import bz2

    try:
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    except (OSError, EOFError, ValueError, MemoryError) as error:
        raise BadMessage(f"a chunk does not inflate: {error}") from None
