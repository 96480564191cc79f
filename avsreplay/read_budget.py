"""What the reading of one input may use: one object that is passed to every reader.

Bytes, records, depth of nesting and work of parsing are counted, never time, so that the same file
is accepted or rejected on every machine. Before a reader allocates, what the file declares is
compared with what its bytes can hold and with what is left of the budget.
"""

from __future__ import annotations

LEAST_BUDGET_BYTES = 16 << 20  # memory that the content of any file may take [bytes]
BYTES_PER_BYTE = 32  # memory for each byte of a file; compressed clouds take up to 20
LEAST_BUDGET_RECORDS = 10_000  # records of any file: members, properties, lines
RECORDS_PER_BYTE = 1  # no format has records without bytes
MAX_DEPTH = 32  # levels of nesting; the deepest format of this program has six
LEAST_BUDGET_WORK = 50_000_000  # elementary steps, about one second of Python
WORK_PER_BYTE = 200  # the slowest reader of text takes 50


class BadFile(ValueError):
    """A file whose bytes do not match its header or its name."""


class OverBudget(BadFile):
    """A file whose content would take more than the budget of its reading."""


class ReadBudget:
    """The budget of one input; every method that takes from it may raise OverBudget.

    Attributes:
        bytes: memory that is left [bytes].
        records: number of records that is left.
        depth: largest depth of nesting.
        work: elementary steps of parsing that are left.
    """

    __slots__ = ("bytes", "depth", "records", "work")

    def __init__(
        self,
        size: int,
        *,
        most_bytes: int | None = None,
        records: int | None = None,
        depth: int = MAX_DEPTH,
        per_byte: int = BYTES_PER_BYTE,
    ) -> None:
        """Create the budget of an input.

        Args:
            size: size of the input [bytes]; what its content may take grows with it.
            most_bytes: largest memory of its content [bytes], None for the default.
            records: largest number of its records, None for the default.
            depth: largest depth of nesting.
            per_byte: memory of its content for each of its bytes [bytes].
        """
        allowed = LEAST_BUDGET_BYTES + per_byte * size
        self.bytes = allowed if most_bytes is None else min(allowed, most_bytes)
        self.records = (
            LEAST_BUDGET_RECORDS + RECORDS_PER_BYTE * size if records is None else records
        )
        self.depth = depth
        self.work = LEAST_BUDGET_WORK + WORK_PER_BYTE * size

    def take_bytes(self, count: int, what: str) -> None:
        """Take memory; call it before the memory is allocated.

        Args:
            count: number of bytes.
            what: what they are for, in the plural, for the message.

        Raises:
            OverBudget: the file needs more than its size allows.
        """
        if count > self.bytes:
            raise OverBudget(f"{what} of {_mib(count)}; {_mib(self.bytes)} are left for this file")
        self.bytes -= count

    def take_records(self, count: int, what: str) -> None:
        """Take records.

        Args:
            count: number of records.
            what: what they are, in the plural, for the message.

        Raises:
            OverBudget: the file has more than its size allows.
        """
        if count > self.records:
            raise OverBudget(f"{count} {what}; at most {self.records} are read")
        self.records -= count

    def take_work(self, count: int, what: str) -> None:
        """Take elementary steps of parsing.

        Args:
            count: number of steps, about one for each value that is touched.
            what: what is parsed, for the message.

        Raises:
            OverBudget: the file needs more than its size allows.
        """
        if count > self.work:
            raise OverBudget(f"{what} would take more than {self.work} steps to read")
        self.work -= count

    def check_depth(self, depth: int, what: str) -> None:
        """Raise OverBudget if a nesting is too deep.

        Args:
            depth: levels of nesting.
            what: what is nested, in the plural, for the message.
        """
        if depth > self.depth:
            raise OverBudget(f"{what} nested {depth} deep; at most {self.depth} levels are read")


def check_declared(count: int, each: int, available: int, what: str) -> None:
    """Raise BadFile if a file declares more than its bytes can hold.

    Args:
        count: number of items that the file declares.
        each: least size of an item in the file [bytes].
        available: bytes of the file in which they must lie.
        what: what the items are, in the plural, for the message.
    """
    if count < 0 or count * each > available:
        raise BadFile(f"declares {count} {what}, which {available} bytes cannot hold")


def _mib(count: int) -> str:
    return f"{count / (1 << 20):.1f} MiB"
