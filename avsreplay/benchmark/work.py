"""One run of the benchmark: an entry over a scenario, and what is scored of it.

A used pose is *wrong* where it is farther from the truth than WRONG_DEG or WRONG_OF_EXTENT of the
target's extent, in addition to the accuracy of the truth. A scan that determines only some
directions (status ``degenerate``) is not counted. A *wrong claim* is a scan at which the estimate
is said to be converged and is beyond the tolerance of the capture.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import avsreplay
from avsreplay import settings
from avsreplay.assessment import Assessment, Chance
from avsreplay.benchmark.entries import Entry
from avsreplay.benchmark.prepared import Prepared
from avsreplay.errors import AvsError
from avsreplay.estimate.measurement import innovation_vector, measurement_jacobian
from avsreplay.geometry import Pose
from avsreplay.records import Belief, Label, ScanStatus
from avsreplay.report.summary import Summary
from avsreplay.run import Job, ReplayedScan, Run
from avsreplay.sweep.campaign import RunResult

FORMAT = 1  # of a run's result; one with another format is made again
# error of a wrong pose, as in docs/registration-results.md
WRONG_POSE_DEG = 2.0
WRONG_POSE_OF_EXTENT = 0.02
SETTLED_SHARE = 0.5  # share of a log after which the errors of the estimate count
# a reported change is that of a push if it is this near, or nearer
PUSH_NEAR_S = 1.0
PUSH_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class BenchmarkTask:
    """What a worker needs for one run.

    Attributes:
        id: hash of everything below except folder names.
        entry: the row of the table.
        log: the scenario.
        n_scans: largest number of scans; None: all.
    """

    id: str
    entry: Entry
    log: Prepared
    n_scans: int | None = None


def task_of(entry: Entry, log: Prepared, n_scans: int | None = None) -> BenchmarkTask:
    """Return the run of an entry over a scenario.

    Args:
        entry: the row of the table.
        log: the scenario.
        n_scans: largest number of scans.
    """
    options = {k: v for k, v in settings.dump(log.options).items() if k not in _FILES}
    content = [
        FORMAT,
        avsreplay.__version__,
        _assignments(entry, log),
        [
            log.scenario,
            log.repeat,
            log.sha256,
            log.pushes_s,
            log.loaded,
            log.truth_m,
            log.truth_deg,
        ],
        options,
        n_scans,
    ]
    digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:24]
    return BenchmarkTask(digest, entry, log, n_scans)


_FILES = ("model", "truth_file")  # named by folders; their content is in the hash of the log


def _assignments(entry: Entry, log: Prepared) -> tuple[str, ...]:
    thin: tuple[str, ...] = ()
    if entry.variant.thinned and log.thin_m:
        thin = (f"register.subsample_m={log.thin_m}",)
    last = ('register.backend="poses"',) if log.poses else ()
    return (*entry.assignments, *thin, *log.assignments, *last)


def run_benchmark_task(task: BenchmarkTask) -> RunResult:
    """Make one run; equal tasks give equal results but for the time.

    Args:
        task: what to run.
    """
    options = replace(task.log.options, n_scans=task.n_scans)
    job = Job(
        source=Path(task.log.source),
        options=options,
        assignments=_assignments(task.entry, task.log),
        prefetch=0,
    )
    begin = time.perf_counter()
    try:
        with Run(job) as run:
            scorer = RunScorer(run, task.log)
            for _ in run.rows([scorer.take]):
                pass
            spent_s = time.perf_counter() - begin
            found = scorer.result(run.summary())
    except AvsError as error:
        return RunResult(task.id, "failed", error.what)
    found["ms_per_scan"] = 1e3 * spent_s / max(1, found["scans"])
    return RunResult(task.id, "ok", None, found)


class RunScorer:
    """Counts scan by scan what a run is scored by.

    Args:
        run: its header, target, task and truth.
        log: the scenario.
    """

    def __init__(self, run: Run, log: Prepared) -> None:
        self._log, self._run = log, run
        self._labels = run.header.labels
        self._extent_m, self._tolerance = run.surface.extent, run.task.tolerance
        self._counts = dict.fromkeys(
            ("scans", "usable", "used", "used_usable", "judged", "wrong", "claims", "wrong_claims"),
            0,
        )
        self._errors: list[tuple[float, float]] = []
        self._nees: list[float] = []

    def take(self, scan: ReplayedScan) -> None:
        """Take one scan."""
        row, counts = scan.row, self._counts
        usable = scan.outcome.scan.status is ScanStatus.OK and not _harmful(
            self._labels, scan.outcome.scan.log_ns
        )
        used = row.gamma == 1
        counts["scans"] += 1
        counts["usable"] += usable
        counts["used"] += used
        counts["used_usable"] += used and usable
        if used and row.reg_pos_err_m is not None and row.reg_rot_err_deg is not None:
            judged = row.status != "degenerate"
            counts["judged"] += judged
            counts["wrong"] += judged and self._wrong(row.reg_pos_err_m, row.reg_rot_err_deg)
        if row.pos_err_m is None or row.rot_err_deg is None or scan.truth.pose is None:
            return
        counts["claims"] += row.converged
        counts["wrong_claims"] += row.converged and self._outside(row.pos_err_m, row.rot_err_deg)
        self._errors.append((row.pos_err_m, row.rot_err_deg))
        self._nees.append(pose_nees(scan.outcome.belief, scan.truth.pose))

    def _wrong(self, pos_m: float, rot_deg: float) -> bool:
        limit_m = WRONG_POSE_OF_EXTENT * self._extent_m + self._log.truth_m
        return pos_m > limit_m or rot_deg > WRONG_POSE_DEG + self._log.truth_deg

    def _outside(self, pos_m: float, rot_deg: float) -> bool:
        limits = self._tolerance.position_m, self._tolerance.angle_deg
        return pos_m > limits[0] + self._log.truth_m or rot_deg > limits[1] + self._log.truth_deg

    def result(self, summary: Summary) -> dict[str, Any]:
        """Return the scores of the run by name."""
        last = slice(int(SETTLED_SHARE * len(self._errors)), None)
        errors = np.array(self._errors[last], dtype=np.float64).reshape(-1, 2)
        rms = np.sqrt(np.mean(np.square(errors), axis=0)).tolist() if len(errors) else [None, None]
        nees = self._nees[last]
        return {
            **self._counts,
            **events_of(summary, self._log),
            **capture_of(summary.assessment if self._run.truth is not None else None),
            "position_permille": None if rms[0] is None else 1e3 * rms[0] / self._extent_m,
            "attitude_deg": rms[1],
            "nees": float(np.median(nees)) / 6.0 if nees and not self._log.truth_m else None,
        }


def _harmful(labels: Sequence[Label], log_ns: int) -> bool:
    return any(each.harmful and each.start_ns <= log_ns < each.end_ns for each in labels)


def pose_nees(belief: Belief, truth: Pose) -> float:
    """Return the NEES (6 degrees of freedom) of the pose of the fixture in a belief.

    Args:
        belief: the estimate.
        truth: true pose T_ac.
    """
    H = measurement_jacobian(belief.x)
    alpha, S = innovation_vector(belief.x, truth), H @ belief.P @ H.T
    return float(alpha @ np.linalg.lstsq(S, alpha, rcond=None)[0])


def events_of(summary: Summary, log: Prepared) -> dict[str, int]:
    """Return how many events of a log there were, were named, and were named without a cause.

    Pushes are named by a reported change of velocity or rate near their instants, a constant torque
    or force by a reported one, a harmful fault by a flagged scan or a gap.

    Args:
        summary: of the run.
        log: the scenario.
    """
    faults = [each for each in summary.faults.episodes if each.harmful]
    changes = list(summary.velocity_changes)
    named = 0
    for at_s in log.pushes_s:
        near = [c for c in changes if abs(c.t_s - at_s) <= max(PUSH_NEAR_S, PUSH_SIGMAS * c.t_1s_s)]
        if near:
            changes.remove(min(near, key=lambda c: abs(c.t_s - at_s)))
            named += 1
    drift = summary.drift is not None
    return {
        "events": len(faults) + len(log.pushes_s) + log.loaded,
        "named": sum(each.detected for each in faults) + named + (log.loaded and drift),
        "invented": 0 if log.poses else len(changes) + (drift and not log.loaded),
    }


def capture_of(found: Assessment | None) -> dict[str, Any]:
    """Return whether the target was captured in fact within the log, and the predicted probability.

    A robot that does not close its gripper has not captured. Where its flight goes on after the
    log, what happens is not known, and the probability is not compared.

    Args:
        found: the assessment; None where the true motion is not that of a free body.
    """
    if found is None or found.chance is Chance.NOT_ASSESSED:
        return {"captured": None, "touched": None, "probability": None, "brier": None}
    fact = found.in_fact
    captured = fact is not None and fact.captured
    known = fact is not None or found.chance is Chance.NONE
    probability = found.probability
    brier = (probability - captured) ** 2 if known and probability is not None else None
    touched = None if fact is None else fact.touched
    return {"captured": captured, "touched": touched, "probability": probability, "brier": brier}
