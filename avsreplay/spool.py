"""Arrays that grow record by record and keep only their last records in memory.

The memory of a spool is one block, whatever its length; the blocks before it are in a temporary
file without a name, which the system removes with the process. Nothing is written to disk before
the first block is full.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from avsreplay.errors import UnreadableInput

# records of a spool that are kept in memory and written at once [bytes]
SPOOL_BLOCK_BYTES = 1 << 20
LARGEST_STORED = 1e15  # magnitude of the numbers of a result


class SpoolFile:
    """The temporary file of one or more spools; it is created with the first block."""

    def __init__(self) -> None:
        self._stream: io.FileIO | None = None

    def add(self, data: memoryview) -> int:
        """Append bytes and return their offset.

        Args:
            data: the bytes.

        Raises:
            UnreadableInput: the temporary folder cannot be written.
        """
        try:
            if self._stream is None:
                # buffered data would be flushed later, outside of this error handling
                self._stream = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
            offset = self._stream.seek(0, 2)
            self._put(offset, data)
        except OSError as error:
            raise _unwritable(error) from None
        return offset

    def read(self, offset: int, out: NDArray[Any]) -> None:
        """Fill an array with the bytes from ``offset`` on, which have been added before.

        Args:
            offset: of the first byte.
            out: the array, contiguous.

        Raises:
            UnreadableInput: the temporary file was truncated.
        """
        assert self._stream is not None
        self._stream.seek(offset)
        left = _bytes_of(out)
        while left:
            count = self._stream.readinto(left)
            if not count:
                raise UnreadableInput("was truncated", where="temporary file", hint="run again")
            left = left[count:]

    def replace(self, offset: int, data: memoryview) -> None:
        """Replace bytes that have been added before.

        Args:
            offset: of the first byte.
            data: the new bytes.

        Raises:
            UnreadableInput: the temporary folder cannot be written.
        """
        try:
            self._put(offset, data)
        except OSError as error:
            raise _unwritable(error) from None

    def _put(self, offset: int, data: memoryview) -> None:
        assert self._stream is not None
        self._stream.seek(offset)
        while data:
            data = data[self._stream.write(data) :]


def _unwritable(error: OSError) -> UnreadableInput:
    where = tempfile.gettempdir()
    hint = "free space there, or name another folder for temporary files with TMPDIR"
    return UnreadableInput(f"cannot be written: {error.strerror or error}", where=where, hint=hint)


class Spool:
    """A growing array of records of one type and shape.

    Attributes:
        dtype: type of the numbers, or a structured type.
        shape: shape of a record.
    """

    def __init__(
        self, dtype: DTypeLike, shape: tuple[int, ...] = (), file: SpoolFile | None = None
    ) -> None:
        """Start without records.

        Args:
            dtype: type of the numbers, or a structured type.
            shape: shape of a record.
            file: temporary file that other spools use as well; None: one of its own.
        """
        self.dtype, self.shape = np.dtype(dtype), shape
        self._file = file or SpoolFile()
        size = self.dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        self._each = max(SPOOL_BLOCK_BYTES // size, 1)  # records of a block
        self._size = size
        self._block: NDArray[Any] = np.empty((self._each, *shape), self.dtype)
        self._fill = 0
        self._offsets: list[int] = []  # of the full blocks in the file

    def __len__(self) -> int:
        return len(self._offsets) * self._each + self._fill

    def append(self, record: Any) -> None:
        """Append one record.

        Args:
            record: what numpy converts to one.
        """
        self._block[self._fill] = record
        self._filled(1)

    def extend(self, records: NDArray[Any]) -> None:
        """Append records.

        Args:
            records: (n, ...) array of them.
        """
        while len(records):
            part = records[: self._each - self._fill]
            self._block[self._fill : self._fill + len(part)] = part
            records = records[len(part) :]
            self._filled(len(part))

    def _filled(self, count: int) -> None:
        self._fill += count
        if self._fill == self._each:
            self._offsets.append(self._file.add(_bytes_of(self._block)))
            self._fill = 0

    def __getitem__(self, place: int) -> Any:
        """Return a copy of the record at a place; from the end, if it is negative."""
        at = self._at(place)
        return self.read(at, at + 1)[0]

    def __setitem__(self, place: int, record: Any) -> None:
        number, within = divmod(self._at(place), self._each)
        if number == len(self._offsets):
            self._block[within] = record
            return
        one = np.empty((1, *self.shape), self.dtype)
        one[0] = record
        self._file.replace(self._offsets[number] + within * self._size, _bytes_of(one))

    def _at(self, place: int) -> int:
        at = place + len(self) if place < 0 else place
        if not 0 <= at < len(self):
            raise IndexError(place)
        return at

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return a copy of the records from ``first`` up to ``last``, which is not one of them.

        Args:
            first: place of the first one.
            last: place after the last one.
        """
        parts = list(self._parts(max(first, 0), min(last, len(self))))
        if len(parts) == 1:
            return parts[0]
        return np.concatenate([np.empty((0, *self.shape), self.dtype), *parts])

    def blocks(self) -> Iterator[NDArray[Any]]:
        """Yield copies of all records, block by block."""
        return self._parts(0, len(self))

    def _parts(self, first: int, last: int) -> Iterator[NDArray[Any]]:
        while first < last:
            number, begin = divmod(first, self._each)
            end = min(begin + last - first, self._each)
            first += end - begin
            if number == len(self._offsets):
                yield self._block[begin:end].copy()
                continue
            part = np.empty((end - begin, *self.shape), self.dtype)
            self._file.read(self._offsets[number] + begin * self._size, part)
            yield part


def _bytes_of(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any] | Spool]) -> None:
    """Write an archive with the same bytes as ``numpy.savez``, spools block by block.

    Args:
        path: the file.
        arrays: its arrays by name.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if isinstance(values, Spool):
                    _write_spool(member, values)
                else:
                    np.lib.format.write_array(member, values, allow_pickle=False)


def _write_spool(member: IO[bytes], values: Spool) -> None:
    header = {
        "descr": np.lib.format.dtype_to_descr(values.dtype),
        "fortran_order": False,
        "shape": (len(values), *values.shape),
    }
    np.lib.format.write_array_header_1_0(member, header)
    for block in values.blocks():
        member.write(_bytes_of(block))
