"""Rules that a run must satisfy, read from a TOML file, and their outcomes as JUnit XML and GitHub
annotations.
"""

from __future__ import annotations

import difflib
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from avsreplay.errors import CheckFailed, UsageError, value_class
from avsreplay.report.compare import METRICS
from avsreplay.report.table import Table, TableCell, number
from avsreplay.settings import Settings, setting
from avsreplay.toml_document import build, load

# The lowest and the highest value that each limit of a rule allows, from the limit and the value of
# the baseline.
_BOUNDS: Mapping[str, Callable[[float, float], tuple[float, float]]] = {
    "min": lambda limit, _: (limit, math.inf),
    "max": lambda limit, _: (-math.inf, limit),
    "min_ratio": lambda limit, reference: (limit * reference, math.inf),
    "max_ratio": lambda limit, reference: (-math.inf, limit * reference),
    "max_increase": lambda limit, reference: (-math.inf, reference + limit),
    "max_decrease": lambda limit, reference: (reference - limit, math.inf),
}
_RELATIVE = frozenset(_BOUNDS) - {"min", "max"}


@dataclass(frozen=True, slots=True)
class GateRule(Settings):
    """One rule on one metric; all given limits must hold.

    A run without a value breaks the rule, unless it is ``optional`` and the baseline has no value
    either.
    """

    metric: str = setting(doc="The metric that is limited.")
    min: float | None = setting(None, "Smallest allowed value.")
    max: float | None = setting(None, "Largest allowed value.")
    min_ratio: float | None = setting(None, "Smallest allowed multiple of the baseline's value.")
    max_ratio: float | None = setting(None, "Largest allowed multiple of the baseline's value.")
    max_increase: float | None = setting(
        None, "Largest allowed increase over the baseline's value."
    )
    max_decrease: float | None = setting(
        None, "Largest allowed decrease below the baseline's value."
    )
    optional: bool = setting(
        False, "Whether the rule holds for a run without a value if the baseline has none either."
    )
    note: str = setting("", "The reason, printed with the outcome.")

    def check(self) -> None:
        """Raise ValueError for an unknown metric or a rule without a limit."""
        known = [m.name for m in METRICS]
        if self.metric not in known:
            near = difflib.get_close_matches(self.metric, known, 1, 0.0)[0]
            meant = f"did you mean '{near}'? 'avsreplay compare --metrics' lists all"
            raise ValueError(f"unknown metric '{ascii(self.metric)[1:-1][:40]}'; {meant}")
        if not self.limits:
            raise ValueError(
                f"the rule on '{self.metric}' has no limit; give one of {', '.join(_BOUNDS)}"
            )

    @property
    def limits(self) -> dict[str, float]:
        """Return the limits that the rule has, by name."""
        return {name: getattr(self, name) for name in _BOUNDS if getattr(self, name) is not None}

    @property
    def relative(self) -> bool:
        """Whether the rule needs a baseline."""
        return any(name in _RELATIVE for name in self.limits)

    @property
    def text(self) -> str:
        """The rule in one line."""
        return f"{self.metric}: " + ", ".join(
            f"{name} {value:g}" for name, value in self.limits.items()
        )


@dataclass(frozen=True, slots=True)
class GateRules(Settings):
    """The content of a file of rules, its tables ``[[rule]]``."""

    rule: tuple[GateRule, ...] = setting((), "The rules.")

    def check(self) -> None:
        """Raise ValueError where there is no rule."""
        if not self.rule:
            raise ValueError("no [[rule]] in the file")


@value_class(eq=True)
class RuleOutcome:
    """The outcome of one rule on one run; ``why`` states the limit that is broken, with both
    numbers.
    """

    run: str
    rule: GateRule
    value: float | None
    ok: bool
    why: str = ""


def load_rules(path: str | Path) -> tuple[GateRule, ...]:
    """Read the rules of a TOML file.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file cannot be read.
        UsageError: it is not valid; the message names the line.
    """
    return build(GateRules, load(path)).rule


def judge(
    rules: Sequence[GateRule],
    runs: Sequence[tuple[str, Mapping[str, float | None]]],
    *,
    baseline: bool = True,
) -> list[RuleOutcome]:
    """Apply every rule to every run except the baseline, which is the first; a run that used no
    scan always fails.

    Args:
        rules: the rules.
        runs: name and metrics of each run.
        baseline: False applies rules without a baseline to all runs; so does a single run.

    Raises:
        UsageError: a relative rule has no baseline.
    """
    if not baseline or len(runs) == 1:
        needy = next((rule for rule in rules if rule.relative), None)
        if needy is not None:
            raise UsageError(
                f"'{needy.text}' needs a baseline", where="--gate", hint="name the baseline first"
            )
        return [
            outcome for name, figures in runs for outcome in _outcomes(rules, name, figures, {})
        ]
    base = runs[0][1]
    return [
        outcome for name, figures in runs[1:] for outcome in _outcomes(rules, name, figures, base)
    ]


def _outcomes(
    rules: Sequence[GateRule],
    run: str,
    figures: Mapping[str, float | None],
    base: Mapping[str, float | None],
) -> list[RuleOutcome]:
    """The outcome of every rule, and a broken rule on the healthy scans where the run has none."""
    outcomes = [_outcome(rule, run, figures, base) for rule in rules]
    if not figures.get("healthy"):
        outcomes.append(
            RuleOutcome(run, GateRule("healthy", min=1.0), 0.0, False, "the run used no scan")
        )
    return outcomes


def _outcome(
    rule: GateRule, run: str, figures: Mapping[str, float | None], base: Mapping[str, float | None]
) -> RuleOutcome:
    value, reference = figures.get(rule.metric), base.get(rule.metric)
    if value is None and reference is not None:
        return RuleOutcome(
            run, rule, None, False, f"the run has lost the value (baseline {reference:.6g})"
        )
    if value is None or (rule.relative and reference is None):
        whose = "the run" if value is None else "the baseline"
        return RuleOutcome(
            run, rule, value, rule.optional, "" if rule.optional else f"{whose} has no value"
        )
    why = next(_broken(rule, value, reference), "")
    return RuleOutcome(run, rule, value, not why, why)


def _broken(rule: GateRule, value: float, reference: float | None) -> Iterator[str]:
    """The limits that a value breaks, each in a sentence with both numbers."""
    for name, limit in rule.limits.items():
        low, high = _BOUNDS[name](limit, reference or 0.0)
        if not low <= value <= high:
            bound = high if value > high else low
            sign = ">" if value > high else "<"
            from_base = f" (baseline {reference:.6g})" if name in _RELATIVE else ""
            yield f"{value:.6g} {sign} {bound:.6g}, {name} {limit:g}{from_base}"


def check_gate(outcomes: Sequence[RuleOutcome]) -> None:
    """Raise CheckFailed with the first broken rule, if there is one.

    Args:
        outcomes: the outcomes of all rules.
    """
    broken = [o for o in outcomes if not o.ok]
    if broken:
        o = broken[0]
        what = (
            f"{len(broken)} of {len(outcomes)} rules broken, the first by {o.run}: {o.rule.metric}:"
            f" {o.why}"
        )
        raise CheckFailed(what, where="--gate", hint=o.rule.note or None)


def junit(outcomes: Sequence[RuleOutcome]) -> str:
    """Return the outcomes as JUnit XML with a suite for each run and a case for each rule; the same
    outcomes give the same bytes.
    """
    root = ET.Element("testsuites", name="avsreplay gate")
    for run in dict.fromkeys(o.run for o in outcomes):
        mine = [o for o in outcomes if o.run == run]
        failures = sum(not o.ok for o in mine)
        suite = ET.SubElement(
            root, "testsuite", name=run, tests=str(len(mine)), failures=str(failures)
        )
        for o in mine:
            case = ET.SubElement(suite, "testcase", classname=run, name=o.rule.text)
            if not o.ok:
                ET.SubElement(case, "failure", message=o.why).text = o.rule.note
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=False) + "\n"


def github_lines(outcomes: Sequence[RuleOutcome]) -> list[str]:
    """Return the outcomes as GitHub workflow commands: an error for each broken rule, or one notice
    where all hold.
    """
    broken = [o for o in outcomes if not o.ok]
    if not broken:
        return [f"::notice title=avsreplay gate::{len(outcomes)} rules hold"]
    return [
        "::error"
        f" title={_property(f'avsreplay gate: {o.run}')}::{_message(f'{o.rule.metric}: {o.why}')}"
        for o in broken
    ]


def _message(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _message(text).replace(":", "%3A").replace(",", "%2C")


def gate_table(outcomes: Sequence[RuleOutcome]) -> Table:
    """Return the table of the rules and their outcomes."""
    rows = tuple(
        (
            TableCell("holds", "good") if o.ok else TableCell("broken", "bad"),
            o.run,
            o.rule.text,
            number(o.value),
            o.why,
        )
        for o in outcomes
    )
    return Table("Gate", ("outcome", "run", "rule", "value", "why"), rows, align="lllrl")
