"""Every value that needs ground truth: errors, NEES and errors of plans. ``pipeline.step`` has no
access to ground truth.

The reference is the truth in the log, or a motion fitted to all healthy poses of the log
(``run.fit_reference``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.chart import nearest_permutation, nees_by_block
from avsreplay.estimate.events.smoothing import PoseStore, Smoothed, smoothed
from avsreplay.estimate.plugged import AnyEstimator
from avsreplay.estimate.reference import healthy_pose
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import CaptureError, Outcome, PoseError, Score
from avsreplay.pipeline import PipelineState, planned_segment
from avsreplay.plan.flights import Motion, interpolated, miss
from avsreplay.plan.guidance import Segment
from avsreplay.records import Belief, State, Truth
from avsreplay.tables import RowTable


class Scorer:
    """Scores the outcomes of a replay in their order.

    Attributes:
        motion: interpolation of the true poses, None where plans cannot be scored.
    """

    def __init__(
        self,
        estimator: AnyEstimator,
        poses: Sequence[tuple[int, Pose]],
        reference: str,
        *,
        growing: bool = False,
    ) -> None:
        """Interpolate the true poses.

        Args:
            estimator: predicts the attitude at the end of a planned flight.
            poses: true poses T_ac by instant, ascending; with fewer than four, plans are not
                scored.
            reference: what the errors are taken against, "truth" or "fit".
            growing: keep the flights for ``rescore``, because true poses are recorded after them.
        """
        self._estimator, self._reference = estimator, reference
        self._interpolate(poses)
        self._segment: Segment | None = None
        self._planned: CaptureError | None = None
        self._captured_ns: int | None = None
        self._flights: list[tuple[int, Segment, Array | None]] | None = [] if growing else None
        self._captures: list[tuple[int, int]] = []  # scan, number of flights that had begun before
        self._count = 0

    def _interpolate(self, poses: Sequence[tuple[int, Pose]]) -> None:
        self._epoch_ns = poses[0][0] if poses else 0
        self.motion: Motion | None = None
        if len(poses) >= 4:
            times = np.array([(t_ns - self._epoch_ns) * 1e-9 for t_ns, _ in poses])
            self.motion = interpolated(times, [pose for _, pose in poses])

    def since_s(self, t_ns: int) -> float:
        """Return an instant on the clock of ``motion`` [s].

        Args:
            t_ns: the instant.
        """
        return (t_ns - self._epoch_ns) * 1e-9

    def rescore(self, rows: RowTable, poses: Sequence[tuple[int, Pose]]) -> list[int]:
        """Compare the flights of a log that grew with all its true poses.

        Args:
            rows: all rows; those whose errors of planned or flown captures change are replaced.
            poses: true poses T_ac by instant, ascending.

        Returns:
            Indices of the rows that have changed.
        """
        self._interpolate(poses)
        flights = self._flights or []
        errors = [self._error_of(segment, attitude) for _, segment, attitude in flights]
        planned = {at: error for (at, _, _), error in zip(flights, errors, strict=True)}
        captured = {at: errors[number - 1] for at, number in self._captures if number}
        scores = {
            at: Score(planned=planned.get(at), captured=captured.get(at))
            for at in {*planned, *captured}
        }
        found = {at: rows[at].rescored(score) for at, score in sorted(scores.items())}
        changed = [at for at, row in found.items() if row != rows[at]]
        for at in changed:
            rows[at] = found[at]
        return changed

    def score(self, state: PipelineState, outcome: Outcome, truth: Truth) -> Score:
        """Compare an outcome with the truth at its scan.

        Args:
            state: state of the pipeline after the scan.
            outcome: outcome of the scan.
            truth: ground truth at the scan.
        """
        captured = self._planned if state.captured_ns != self._captured_ns else None
        if self._flights is not None and state.captured_ns != self._captured_ns:
            self._captures.append((self._count, len(self._flights)))
        self._captured_ns = state.captured_ns
        planned = self._new_plan(state)
        self._count += 1
        if truth.pose is None:
            return Score(fault=truth.fault, planned=planned, captured=captured)
        total, blocks = _nees(outcome, truth.state)
        return Score(
            fault=truth.fault,
            reference=self._reference,
            estimate=pose_error(outcome.pose, truth.pose),
            registration=pose_error(outcome.alignment.T_ac, truth.pose)
            if outcome.alignment.measured
            else None,
            nees=total,
            nees_blocks=blocks,
            planned=planned,
            captured=captured,
        )

    def _new_plan(self, state: PipelineState) -> CaptureError | None:
        """The error of the capture plan whose flight began at this scan, None where none did."""
        segment = planned_segment(state)
        if segment is None or segment is self._segment:
            return None
        attitude = None
        if state.track is not None and (self.motion is not None or self._flights is not None):
            attitude = self._estimator.predict(state.track, segment.end_ns).belief.x.T_ac.q
        if self._flights is not None:
            self._flights.append((self._count, segment, attitude))
        self._segment, self._planned = segment, self._error_of(segment, attitude)
        return self._planned

    def _error_of(self, segment: Segment, attitude: Array | None) -> CaptureError | None:
        """The error of a flight whose attitude at its end is predicted as ``attitude`` (4,)."""
        if self.motion is None or segment.path is None or attitude is None:
            return None
        found = miss(segment.path, (segment.t_ns - self._epoch_ns) * 1e-9, self.motion, attitude)
        if not np.isfinite(found.distance_m):
            return None
        return CaptureError(found.distance_m, found.speed_mps, found.angle_deg)


@value_class
class Reference:
    """The motion that is fitted to all healthy poses of a log, in {A}.

    Attributes:
        smoothed: it, in the coordinates of the estimator.
        epoch_ns, end_ns: instants of the first and the last pose.
        at: instant [ns] between these -> state.
    """

    smoothed: Smoothed
    epoch_ns: int
    end_ns: int
    at: Callable[[int], State]


class HealthyPoses:
    """Collects the healthy poses of a run, for a fit to all of them."""

    def __init__(self, estimator: AnyEstimator) -> None:
        """Start without poses.

        Args:
            estimator: that of the run.
        """
        self._estimator, self.store = estimator, PoseStore()

    def add(self, state: PipelineState, outcome: Outcome) -> None:
        """Take the outcome of one scan; a pose that is not healthy is ignored.

        Args:
            state: state of the pipeline after the scan.
            outcome: outcome of the scan.
        """
        if outcome.verdict.gamma and state.track is not None and state.last_pose is not None:
            t_ns, T_ac = outcome.scan.t_ns, state.last_pose
            T_ac = self._estimator.frame.pose_into(T_ac, t_ns)
            self.store.append(healthy_pose(state.track, t_ns, T_ac, self._estimator.params))

    def reference(self) -> Reference:
        """Fit one motion to all of them. Raises UsageError where they are too few."""
        frame, found = self._estimator.frame, smoothed(self.store.fixes(), self._estimator.params)
        return Reference(
            found, found.epoch_ns, found.end_ns, lambda t_ns: frame.state_out(found.at(t_ns), t_ns)
        )


def pose_error(pose: Pose, truth: Pose) -> PoseError:
    """Return the distance [m] and the angle [deg] between two poses.

    Args:
        pose: estimated or measured pose T_ac.
        truth: true pose T_ac.
    """
    return PoseError(
        float(np.linalg.norm(pose.t - truth.t)),
        float(np.degrees(geometry.angle_between(truth.q, pose.q))),
    )


def matched_truth(belief: Belief, truth: State) -> State:
    """Return the true state with its principal axes in the order that is nearest to that of the
    estimate.

    Args:
        belief: the estimate and its covariance.
        truth: true state at the same instant.
    """
    return nearest_permutation(belief, truth)[0]


def _nees(outcome: Outcome, truth: State | None) -> tuple[float | None, Mapping[str, float]]:
    """NEES of all states and of each block. A cold start's first poses have none: their
    belief is not normal.
    """
    if truth is None or outcome.estimator == "start":
        return None, {}
    return nees_by_block(outcome.belief, truth)
