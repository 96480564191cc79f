"""``avsreplay info`` tries what it advises: a few scans are replayed with the options that it
prints.
"""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avsreplay.errors import AvsError, value_class

if TYPE_CHECKING:
    from avsreplay.model_size import Advice
    from avsreplay.rows import Row
    from avsreplay.run import Job

TRIAL_SCANS = 10  # scans that are replayed


@value_class(eq=True)
class Trial:
    """The result of a replay of a few scans.

    Attributes:
        scans: number of scans.
        used: number of scans that the estimate used.
        inlier_ratio: median share of the points on the model, None where no scan is registered.
        pos_err_m, rot_err_deg: median errors of the registered pose [m, deg], None without truth.
        extent_m: size of the model [m].
        broken: why the replay ended, "" if it did not.
        reason: most frequent reason why scans were not used, "" if all were.
    """

    scans: int
    used: int = 0
    inlier_ratio: float | None = None
    pos_err_m: float | None = None
    rot_err_deg: float | None = None
    extent_m: float = 0.0
    broken: str = ""
    reason: str = ""

    @property
    def sound(self) -> bool:
        """Whether most scans are used, at the true poses where these are known."""
        return 2 * self.used >= self.scans and not self._elsewhere

    @property
    def _elsewhere(self) -> bool:
        from avsreplay.report.verdict import POSITION_ERROR_FAIL_OF_EXTENT

        return (
            self.pos_err_m is not None
            and self.pos_err_m > POSITION_ERROR_FAIL_OF_EXTENT * self.extent_m
        )

    @property
    def result(self) -> str:
        """What the replay gave, in words."""
        if self.broken:
            return self.broken
        parts = [f"{self.used} of the first {self.scans} scans are used"]
        if self.inlier_ratio is not None:
            parts.append(f"{100 * self.inlier_ratio:.0f} % of the points on the model")
        if self.pos_err_m is not None and self.rot_err_deg is not None:
            parts.append(
                f"registration within {1e3 * self.pos_err_m:.2g} mm and {self.rot_err_deg:.2g} deg"
                " of the truth (medians)"
            )
        if self.reason:
            parts.append(f"the others: {self.reason}")
        if self._elsewhere:
            parts.append("are the true poses in another frame, or of another model?")
        return ", ".join(parts)

    @property
    def advice(self) -> Advice:
        """Return the result as a finding."""
        from avsreplay.model_size import Advice

        if self.broken:
            return Advice("fail", "replay", f"a run with these options ends: {self.broken}")
        return Advice("ok" if self.sound else "check", "replay", self.result)


def advised_words(found: Sequence[Advice]) -> dict[str, str]:
    """Return the options of findings that can be added as they are, each with its reason.

    Args:
        found: the findings; an option with a placeholder, an alternative, or of a finding that
            requires nothing (but true poses) is left out.
    """
    out = dict[str, str]()
    for each in found:
        words = each.option.split()
        wanted = each.grade != "ok" or each.option.startswith("--truth-")
        if words and wanted and not any(map(_is_placeholder, words)):
            out.setdefault(each.option, f"{each.about}: {each.text}")
    return out


def _is_placeholder(word: str) -> bool:
    """Whether a word of an option is to be replaced by a value, as FILE and X,Y,Z are."""
    return word == "or" or (word.replace(",", "").replace(":", "").isalpha() and word.isupper())


def job_with(source: Path, reading: Mapping[str, Any], options: Sequence[str]) -> Job:
    """Return the run of a log with options that ``info`` prints.

    Args:
        source: the log.
        reading: options of the ``info`` command by the names of their parameters; None: not given.
        options: texts of further options, such as "--model-unit mm".

    Raises:
        UsageError: an option does not exist.
    """
    from avsreplay.cli.run import job_of, run_command

    words = [word for option in options for word in shlex.split(option)]
    given = {name: value for name, value in reading.items() if value is not None}
    with run_command.make_context("run", [str(source), *words]) as context:
        flags = dict(context.params)
        for name, value in given.items():
            if name == "poses":
                flags["backend"] = "poses" if value else flags["backend"]
            elif flags.get(name) is None:
                flags[name] = value
        return job_of(Path(flags.pop("log")), flags)


def tried(job: Job) -> Trial:
    """Replay the first scans of a run.

    Args:
        job: the run.
    """
    from avsreplay.run import Run

    n = min(job.options.n_scans or TRIAL_SCANS, TRIAL_SCANS)
    try:
        with Run(
            dataclasses.replace(job, options=dataclasses.replace(job.options, n_scans=n))
        ) as run:
            return _of_rows(list(run.rows()), run.surface.extent)
    except AvsError as error:
        return Trial(n, broken=str(error))


def try_advice(
    source: Path, reading: Mapping[str, Any], found: Sequence[Advice]
) -> tuple[list[Advice], list[str]]:
    """Try the advised options, and without a fixed frame where the scans are not used in it or are
    not at the true poses.

    Args:
        source: the log.
        reading: options of the command by the names of their parameters.
        found: the findings.

    Returns:
        The findings about the options, and the options that remain.
    """
    from avsreplay.model_size import Advice

    options = list(advised_words(found))
    first = tried(job_with(source, reading, options))
    frames = [option for option in options if option.startswith("--fixed-frame ")]
    if not frames or first.sound:
        return [first.advice], options
    rest = [option for option in options if option not in frames]
    second = tried(job_with(source, reading, rest))
    if (second.sound, second.used) <= (first.sound, first.used):
        return [first.advice], options
    text = f"{frames[0]} is left out, because with it {first.result}"
    return [Advice("check", "transforms", text), second.advice], rest


def _of_rows(rows: Sequence[Row], extent_m: float) -> Trial:
    unused = [row.reason or row.status for row in rows if not row.gamma]
    reason = max(sorted(set(unused)), key=unused.count) if unused else ""
    return Trial(
        len(rows),
        sum(row.gamma for row in rows),
        _median([row.inlier_ratio for row in rows]),
        _median([row.reg_pos_err_m for row in rows]),
        _median([row.reg_rot_err_deg for row in rows]),
        extent_m,
        reason=str(reason),
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = sorted(value for value in values if value is not None)
    return known[len(known) // 2] if known else None
