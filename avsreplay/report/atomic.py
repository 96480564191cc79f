"""Files that are written completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from avsreplay.errors import UnreadableInput


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path; its file replaces ``path`` on success and is removed on any failure.

    Raises:
        UnreadableInput: the folder is missing or cannot be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        what = error.strerror or "cannot be written"
        raise UnreadableInput(what, where=str(path), hint="check the folder and its permissions") from None
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_text(path: str | Path) -> Iterator[IO[str]]:
    """Yield an open UTF-8 text file with Unix line ends that replaces ``path`` when it is closed."""
    with atomic_path(path) as part, part.open("w", encoding="utf-8", newline="\n") as stream:
        yield stream
