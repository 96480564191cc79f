"""Job files: one short TOML file with a log and the options with which it is replayed.

``avsreplay info LOG --write job.toml`` writes one, with the reason of each option as a comment, and
``avsreplay run job.toml`` replays it. Options on the command line win.

    log = "drive.bag"
    set = ["register.camera=none"]

    [input]
    model = "target.stl"
    scan_unit = "mm"  # the scans measure 1090 m, the model 1.17 m

The keys of ``[input]`` are the settings of how a log is read (docs/settings.md); paths are relative
to the job file.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avsreplay.errors import UsageError, value_class

if TYPE_CHECKING:
    from avsreplay.log import SourceOptions

_KEYS = ("log", "set", "config", "golden", "input")
_PATHS = ("model", "truth_file")  # keys of [input] that are files


@value_class(kw_only=True, eq=True)
class JobFile:
    """The content of a job file.

    Attributes:
        log: the log, bag or folder of scans.
        given: settings of how the log is read, by the names of their fields.
        assignments: settings ``a.b=value`` of the run.
        config: TOML file with further settings of the run, or None.
        golden: golden file with which the rows are compared, or None.
    """

    log: Path
    given: Mapping[str, Any]
    assignments: tuple[str, ...] = ()
    config: Path | None = None
    golden: Path | None = None

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files and folders on which the result of the job depends, without those that its
        settings name.
        """
        named = [self.given.get(key) for key in _PATHS]
        return (self.log, *(p for p in (*named, self.config) if p and p != Path("auto")))


def read_job(path: Path) -> JobFile | None:
    """Read a job file.

    Args:
        path: the file, or a log.

    Returns:
        Its content; None if it is no TOML file or names no log, and so is no job.

    Raises:
        UnreadableInput: it cannot be read.
        UsageError: it is not TOML, or has an unknown key or a value of a wrong type.
    """
    from avsreplay.log import SourceOptions
    from avsreplay.toml_document import build, load

    if path.suffix != ".toml" or not path.is_file():
        return None
    document = load(path)
    if not isinstance(document.table.get("log"), str):
        return None
    for key in document.table:
        if key not in _KEYS:
            hint = f"a job file has {', '.join(_KEYS)}"
            raise UsageError(f"unknown key '{key}'", where=document.where((key,)), hint=hint)
    texts = document.table.get("set", [])
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise UsageError(
            "is not a list of texts", where=document.where(("set",)), hint='set = ["a.b=value"]'
        )
    options = build(SourceOptions, document, ("input",)) if "input" in document.table else None
    named = document.table.get("input", {})
    given = {key: getattr(options, key) for key in named}
    for key in _PATHS:
        if given.get(key) is not None and given[key] != Path("auto"):
            given[key] = path.parent / given[key]
    others = [document.table.get(key) for key in ("config", "golden")]
    config, golden = (None if other is None else path.parent / str(other) for other in others)
    return JobFile(
        log=path.parent / document.table["log"],
        given=given,
        assignments=tuple(texts),
        config=config,
        golden=golden,
    )


def job_text(
    log: Path,
    options: SourceOptions,
    assignments: Sequence[str],
    reasons: Mapping[str, str],
    folder: Path,
) -> str:
    """Return the text of a job file.

    Args:
        log: the log.
        options: how it is read; what is not the default is written.
        assignments: settings of the run.
        reasons: why an option is given, by the name of its field, or by its assignment.
        folder: folder of the job file, to which paths are relative.
    """
    from avsreplay.log import SourceOptions
    from avsreplay.settings import dump
    from avsreplay.toml_document import toml_value

    lines = [f"log = {toml_value(_relative(log, folder))}"]
    if assignments:
        lines.append("set = [")
        lines += [f"    {toml_value(a)},{_comment(reasons.get(a, ''))}" for a in assignments]
        lines.append("]")
    heading = len(lines)
    usual = SourceOptions()
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if value == getattr(usual, field.name) or field.name == "poses":
            continue
        if isinstance(value, Path) and value != Path("auto"):
            value = _relative(value, folder)
        reason = _comment(reasons.get(field.name, ""))
        lines.append(f"{field.name} = {toml_value(dump(value))}{reason}")
    if lines[heading:]:
        lines[heading:heading] = ["", "[input]"]
    return "\n".join(lines) + "\n"


def _relative(path: Path, folder: Path) -> str:
    """The path as it is written in a file of ``folder``."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return path.resolve().as_posix()


def _comment(reason: str) -> str:
    one_line = " ".join(reason.split())
    return f"  # {one_line}" if one_line else ""
