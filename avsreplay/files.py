"""Outputs that are complete or absent: a regular file is written beside its place and renamed when
it is complete.

A symbolic link is followed and never replaced. A device, a FIFO and ``-`` (standard output) are
written directly. Names that cannot be written raise an error in ``check_output``, before any work
is done.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import shutil
import stat
import sys
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.locks import PART, check_alone, lock

STDOUT = Path("-")
_MAX_NAME_BYTES = 255  # of the name of a file, the limit of common file systems
_CLEANED = set[Path]()
_COUNTER = itertools.count()


def is_stream(path: Path) -> bool:
    """Return whether an output is written directly: ``-``, a device or a FIFO, also behind a
    symbolic link.

    Args:
        path: the output.
    """
    if path == STDOUT:
        return True
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or stat.S_ISBLK(mode)


_POINTER = b"version https://git-lfs.github.com/spec"


def refuse_pointer(data: bytes, where: str) -> None:
    """Raise UnreadableInput if the bytes of a file are a git-LFS pointer in place of its content.

    Args:
        data: the file, or its begin.
        where: its name, for the message.
    """
    if data.startswith(_POINTER):
        hint = "fetch the content: git lfs pull"
        raise UnreadableInput("a git-LFS pointer, not the file itself", where=where, hint=hint)


def check_output(
    path: Path, *, overwrite: bool = True, folder: bool = False, inputs: Iterable[Path] = ()
) -> None:
    """Raise an error for an output that cannot be written, before any work is done.

    Args:
        path: the output.
        overwrite: whether an existing file or folder may be replaced.
        folder: whether the output is a folder; its parents are created.
        inputs: files and folders that are read; the output must be none of them and no file of such
            a folder.

    Raises:
        UsageError: the name is unusable, the output exists, is an input, or its folder does not
            exist.
        UnreadableInput: its folder cannot be written.
    """
    name = os.fsencode(path)
    if not path.name or path.name == ".." or b"\0" in name:
        raise UsageError("is not the name of an output", where=repr(str(path)), hint="name a file")
    if str(path).encode("utf-8", "replace") != name:
        raise UsageError("is not a UTF-8 name", where=ascii(str(path)), hint="name another output")
    if len(os.fsencode(path.name)) > _MAX_NAME_BYTES:
        where = f"{path.name[:40]}..."
        raise UsageError(
            f"the name is longer than {_MAX_NAME_BYTES} bytes",
            where=where,
            hint="name another output",
        )
    try:
        if (
            path.resolve().is_symlink()
        ):  # from Python 3.13 on, ``resolve`` returns a loop of links as it is
            raise RuntimeError("a loop of symbolic links")
        _check_place(path, overwrite, folder)
        if not is_stream(path) and any(
            _replaces(path.resolve(), each.resolve()) for each in inputs
        ):
            what = "is an input, a part of one, or another output"
            raise UsageError(what, where=str(path), hint="name another output")
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of symbolic links
        what = (
            f"cannot be written: {getattr(error, 'strerror', None) or 'a loop of symbolic links'}"
        )
        raise UsageError(what, where=str(path)[:200], hint="name another output") from None


def _replaces(place: Path, source: Path) -> bool:
    """Whether an output replaces an input, a scan in a folder that is read, or a file that its
    run.json lists.
    """
    if place == source or place.parent != source or not place.is_file():
        return place == source
    manifest = source / "run.json"
    if manifest.is_file() and place != manifest:
        return (
            manifest.stat().st_size > 64 << 20
            or os.fsencode(f'"{place.name}"') in manifest.read_bytes()
        )
    return place.suffix != ".html"


def _check_replaced(path: Path, mode: int, overwrite: bool, folder: bool) -> None:
    """Raise UsageError where what is at the place of an output cannot be replaced by it."""
    if stat.S_ISDIR(mode) != folder:
        what = "is not a folder" if folder else "is a folder"
        raise UsageError(what, where=str(path), hint="name another output")
    if not folder and not stat.S_ISREG(mode):
        raise UsageError("is not a regular file", where=str(path), hint="name another output")
    if not overwrite:
        raise UsageError(
            "already exists", where=str(path), hint="choose another name, or add --overwrite"
        )


def _check_place(path: Path, overwrite: bool, folder: bool) -> None:
    if path == STDOUT:
        if folder:
            raise UsageError(
                "a folder cannot be written to standard output", where="-", hint="name a folder"
            )
        return
    place = path.resolve()
    if place.exists():
        if not folder and is_stream(place):
            return
        _check_replaced(path, place.stat().st_mode, overwrite, folder)
    parent = place.parent
    while folder and not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise UsageError("no such folder", where=str(path.parent), hint="create it first")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise UnreadableInput(
            "cannot be written: Permission denied",
            where=str(path),
            hint="check the folder's rights",
        )


@contextmanager
def output_path(path: str | Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a path to write to; on success its content replaces ``path``, on failure ``path`` is
    unchanged.

    Args:
        path: the output.
        overwrite: whether a file that appears meanwhile may be replaced.

    Yields:
        A temporary path beside the output, or the output itself if it is a device or a FIFO.

    Raises:
        UsageError: the output cannot be written (see ``check_output``).
        UnreadableInput: writing failed; the text states why.
    """
    path = Path(path)
    check_output(path, overwrite=overwrite)
    if path == STDOUT:
        raise UsageError("this output needs a file", where="-", hint="name a file")
    place = path.resolve()
    try:
        if is_stream(place):
            yield place
            return
        with _part(place) as part:
            yield part
            _publish(part, place, overwrite)
    except OSError as error:
        raise _unwritable(path, error) from None


@contextmanager
def output_text(path: str | Path, *, overwrite: bool = True) -> Iterator[IO[str]]:
    """Open an output as UTF-8 text with Unix line ends; see ``output_path`` for the errors.

    Args:
        path: the output; ``-`` is standard output.
        overwrite: whether an existing file may be replaced.
    """
    if Path(path) == STDOUT:
        yield sys.stdout
        sys.stdout.flush()
        return
    with (
        output_path(path, overwrite=overwrite) as part,
        part.open("w", encoding="utf-8", newline="\n", errors="backslashreplace") as stream,
    ):
        yield stream


@contextmanager
def output_folder(path: Path, own: Collection[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder; on success it replaces the folder ``path``, on failure ``path`` is
    unchanged.

    Args:
        path: the folder.
        own: names that may be in such a folder; everything else in the former folder is kept in the
            new one.

    Raises:
        UsageError: the folder cannot be written (see ``check_output``), or another process writes
            it.
        UnreadableInput: writing failed; the text states why.
    """
    check_output(path, folder=True)
    place = path.resolve()
    try:
        with kept_if_used(place.parent), _part(place, folder=True) as part:
            yield part
            _keep_others(place, part, own)
            _swap(part, place)
    except OSError as error:
        raise _unwritable(path, error) from None


@contextmanager
def kept_if_used(folder: Path) -> Iterator[None]:
    """Create a folder and its parents; those created here that are empty at the end are removed.

    Args:
        folder: the folder.

    Raises:
        OSError: it cannot be created.
    """
    place = folder.resolve()
    missing = [each for each in (place, *place.parents) if not each.exists()]
    try:
        place.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with contextlib.suppress(OSError):  # it is in use
            for each in missing:
                each.rmdir()


def _swap(part: Path, place: Path) -> None:
    """Put ``part`` in the place of an existing folder, in one step where the system has one
    (Linux).
    """
    old = _beside(place)
    if place.exists():
        if _exchange(part, place):  # the former folder is removed with the temporary name
            return
        place.rename(old)
    try:
        part.rename(place)
    except OSError:
        if old.exists():
            old.rename(place)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step; return False if the system or the file system cannot."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):  # macOS; Windows
        return False
    return (
        int(rename(-100, os.fsencode(one), -100, os.fsencode(other), 2)) == 0
    )  # AT_FDCWD, RENAME_EXCHANGE


def _keep_others(place: Path, part: Path, own: Collection[str]) -> None:
    """Link everything in the former folder that is not its own into the new one."""
    for entry in place.iterdir() if place.is_dir() else ():
        if entry.name in own or PART.fullmatch(entry.name) or (part / entry.name).exists():
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, part / entry.name, symlinks=True, copy_function=_link)
        else:
            _link(entry, part / entry.name)


def _link(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a file system without hard links
        shutil.copy2(source, target, follow_symlinks=False)


def _publish(part: Path, place: Path, overwrite: bool) -> None:
    with contextlib.suppress(OSError):
        shutil.copymode(place, part)
    if not overwrite:
        try:
            os.link(part, place)  # fails if another process has created the file meanwhile
            return
        except FileExistsError:
            raise UsageError(
                "appeared while it was written", where=str(place), hint="add --overwrite"
            ) from None
        except OSError:  # a file system without hard links
            pass
    for left in range(40 if os.name == "nt" else 1, 0, -1):
        try:
            part.replace(place)
            return
        except PermissionError:  # Windows replaces no file that a program has open
            if left == 1:
                raise
        time.sleep(0.05)


def _unwritable(path: Path, error: OSError) -> UnreadableInput:
    if PART.fullmatch(path.parent.name):  # the final name of a folder, not the temporary one
        path = path.parent.with_name(path.parent.name[1:].rsplit(".", 3)[0]) / path.name
    hint = "nothing was changed; check the folder, its rights and its space"
    return UnreadableInput(
        f"cannot be written: {error.strerror or error}", where=str(path), hint=hint
    )


def _beside(place: Path) -> Path:
    """Return a name beside ``place`` that no other process or thread uses."""
    return place.with_name(
        f".{os.fsdecode(os.fsencode(place.name)[:200])}.{os.getpid()}.{next(_COUNTER)}.part"
    )


@contextmanager
def _part(place: Path, *, folder: bool = False) -> Iterator[Path]:
    """Create a locked temporary file or folder beside ``place`` and remove it at the end if it is
    still there.
    """
    _remove_stale(place.parent)
    part, held = _beside(place), None
    # between its creation and its lock, another process may take it for a leftover and remove it
    while True:
        if folder:
            part.mkdir()
        else:
            part.touch(exist_ok=False)
        with contextlib.suppress(FileNotFoundError):
            held = lock(part, wait=True)
        if part.exists():
            break
        if held is not None:
            os.close(held)
            held = None
    try:
        if folder and held is not None:
            check_alone(part, place)
        yield part
    finally:
        if held is not None:
            os.close(held)
        _remove(part)


def _remove_stale(folder: Path) -> None:
    """Remove the temporary files in a folder whose process has ended (their lock is free), once in
    this process.
    """
    if folder in _CLEANED:
        return
    _CLEANED.add(folder)
    with contextlib.suppress(OSError):
        for entry in folder.iterdir():
            if PART.fullmatch(entry.name):
                held = lock(entry)
                if held is not None or (
                    os.name == "nt" and entry.is_file()
                ):  # it cannot remove a file that is open
                    _remove(entry)
                if held is not None:
                    os.close(held)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)  # without effect on a file or a link
    with contextlib.suppress(OSError):
        path.unlink()
