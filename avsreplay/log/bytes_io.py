"""Bytes of a file: reading at an offset, decompression with a size limit, and text made safe
to print.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from avsreplay.errors import UnreadableInput, printable

_SMALL_READ_BYTES = 256  # reads up to this size (record heads) are served from one cached block
_CACHED_BLOCK_BYTES = 1 << 16
# first bytes of the files of ROS bags
ROS1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\x00"
# a decompressor is expensive to create and may serve one thread at a time
_PER_THREAD = threading.local()


class BadMessage(ValueError):
    """The bytes of a message or record do not match its type."""


def shown(text: object) -> str:
    r"""Return ``str(text)`` with every control character replaced by an escape (``\x1b``,
    ``\u202e``).
    """
    return printable(str(text))


class ByteFile:
    """A file opened for reading at given offsets; may be used by several threads.

    Attributes:
        size: size in bytes at the time of opening.
    """

    def __init__(self, path: Path, upto: int | None = None) -> None:
        """Open the file.

        Args:
            path: the file.
            upto: number of bytes that are read of a file that still grows.

        Raises:
            UnreadableInput: the file does not exist or cannot be opened.
        """
        try:
            self._file = path.open("rb", buffering=0)
            size = path.stat().st_size
            self.size = size if upto is None else min(size, upto)
        except OSError as error:
            what = (
                "no such file"
                if isinstance(error, FileNotFoundError)
                else error.strerror or "cannot be read"
            )
            raise UnreadableInput(what, where=shown(path), hint="check the path") from None
        self._lock = threading.Lock()
        self._block = (0, b"")

    def read(self, offset: int, size: int) -> bytes:
        """Return exactly ``size`` bytes. Raises BadMessage if the file ends before."""
        if size > _SMALL_READ_BYTES:
            return self._read(offset, size)
        begin, block = self._block
        if not begin <= offset <= offset + size <= begin + len(block):
            begin, block = self._block = (
                offset,
                self._read(offset, max(min(_CACHED_BLOCK_BYTES, self.size - offset), size)),
            )
        return block[offset - begin : offset - begin + size]

    def read_at_most(self, offset: int, size: int) -> bytes:
        """Return ``size`` bytes, or fewer at the end of the file."""
        return self.read(offset, max(min(size, self.size - offset), 0))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, offset: int, size: int) -> bytes:
        parts, done = list[bytes](), 0
        if offset + size > self.size:  # checked before memory is allocated
            raise BadMessage(f"the file ends at byte {self.size}, {offset + size} needed")
        try:
            with self._lock:
                self._file.seek(offset)
                while done < size and (part := self._file.read(size - done)):
                    parts.append(part)
                    done += len(part)
        except OSError as error:
            raise BadMessage(f"byte {offset} cannot be read: {error.strerror}") from None
        if done < size:
            raise BadMessage(f"the file ends at byte {offset + done}, {offset + size} needed")
        return parts[0] if len(parts) == 1 else b"".join(parts)


def inflate(data: bytes, compression: str, size: int) -> bytes:
    """Return ``data`` decompressed, exactly ``size`` bytes.

    Raises BadMessage if the data is damaged, gives another number of bytes, or the compression is
    unknown.
    """
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
        raise BadMessage(f"a chunk does not decompress to the {size} bytes it declares")
    return out


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def unpacked(payload: bytes | memoryview, encoding: str, limit: int) -> bytes | memoryview:
    """Return a message, decompressed where rosbag2 compressed each message of its own.

    Args:
        payload: the message as it is stored.
        encoding: of the message; one in CDR never begins with the mark of zstd.
        limit: largest message that is decompressed [bytes].

    Raises:
        BadMessage: it cannot be decompressed, or is over the limit.
    """
    if encoding != "cdr" or bytes(payload[:4]) != ZSTD_MAGIC:
        return payload
    import zstandard

    try:
        size = zstandard.get_frame_parameters(payload).content_size
    except zstandard.ZstdError as error:
        raise BadMessage(f"a message that cannot be decompressed: {error}") from None
    if size in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR) or size > limit:
        raise BadMessage(f"a compressed message without a size, or over the limit of {limit} bytes")
    return inflate(bytes(payload), "zstd", size)


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        declared = zstandard.get_frame_parameters(data).content_size
        # The library allocates the size in the frame header, whatever limit it is given.
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise BadMessage(f"a chunk does not decompress to the {size} bytes it declares")
        if not hasattr(_PER_THREAD, "zstd"):
            _PER_THREAD.zstd = zstandard.ZstdDecompressor()
        out: bytes = _PER_THREAD.zstd.decompress(data, max_output_size=max(size, 1))
        return out
    except (zstandard.ZstdError, MemoryError) as error:
        raise BadMessage(f"a chunk cannot be decompressed: {error}") from None


def _lz4(data: bytes, size: int) -> bytes:
    import lz4.frame

    try:
        frame: Any = lz4.frame
        out: bytes = frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise BadMessage(f"a chunk cannot be decompressed: {error}") from None
    return out


def _bz2(data: bytes, size: int) -> bytes:
    import bz2

    try:
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    except (OSError, EOFError, ValueError, MemoryError) as error:
        raise BadMessage(f"a chunk cannot be decompressed: {error}") from None
