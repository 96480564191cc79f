"""One base error, one exit code each. Only the command line prints or exits."""

from __future__ import annotations

__all__ = [
    "AvsError",
    "CheckFailed",
    "DataLost",
    "MissingBackend",
    "UnreadableInput",
    "UsageError",
]


class AvsError(Exception):
    """A trouble the user can mend: one line saying what, where and what to do.

    Args:
        what: what is wrong, in one sentence without a full stop.
        where: the file, key, topic or place it was found at.
        hint: what to do about it.
    """

    exit_code = 2

    def __init__(self, what: str, *, where: str | None = None, hint: str | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.hint = hint

    def __str__(self) -> str:
        """The one line a person reads."""
        line = f"{self.where}: {self.what}" if self.where else self.what
        return f"{line}; {self.hint}" if self.hint else line


class CheckFailed(AvsError):
    """The check that was asked for (a golden file, a gate) did not hold. Exit code 1."""

    exit_code = 1


class UsageError(AvsError):
    """A flag, key or value that cannot be right. Exit code 2."""

    exit_code = 2


class MissingBackend(UsageError):
    """A back end or optional extra that is not installed. Exit code 2."""


class UnreadableInput(AvsError):
    """A file that is not there, is not what it says, or cannot be read. Exit code 3."""

    exit_code = 3


class DataLost(AvsError):
    """The work was finished, but part of the input could not be read. Exit code 4."""

    exit_code = 4
