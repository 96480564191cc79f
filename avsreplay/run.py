"""One run, for command line, Python and sweeps: opens the log, builds the stages, processes scan
after scan and computes the errors.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from avsreplay import arithmetic, geometry, pipeline, settings
from avsreplay.assess import FlightLog, ScanErrors, Setup, assess
from avsreplay.assessment import Assessment
from avsreplay.build import (
    first_state,
    grasp_advice,
    stages,
    target_geometry,
    task_and_target,
)
from avsreplay.checkpoint import pack, unpack
from avsreplay.config import Against, RunConfig, load_config, pose_text, with_acceleration
from avsreplay.errors import UnreadableInput, UsageError, value_class
from avsreplay.estimate import Estimator
from avsreplay.estimate.acceleration import AccelerationFit, acceleration_text, fit_acceleration
from avsreplay.estimate.events.naming import Cause
from avsreplay.estimate.grasp_point import at_grasp
from avsreplay.estimate.measurement import in_fixture
from avsreplay.geometry import Array, Pose
from avsreplay.log import GrowingLog, Source, SourceOptions, open_source
from avsreplay.log.streams import ahead
from avsreplay.outcome import Outcome
from avsreplay.pipeline import PipelineState, Stages
from avsreplay.plan.flights import Motion
from avsreplay.plan.robot import Limits
from avsreplay.records import Belief, LogHeader, Moves, Scan, ScanStatus, State, Surface, Truth
from avsreplay.register.backend import POSES
from avsreplay.register.interrupt import shielded
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.registrar import Registrar
from avsreplay.report.summary import Summary
from avsreplay.rows import Row
from avsreplay.score import HealthyPoses, Reference, Scorer, matched_truth, pose_error
from avsreplay.tables import RowTable
from avsreplay.toml_document import own_settings

if TYPE_CHECKING:
    from avsreplay.reconstruct.model import Reconstruction

RECONSTRUCTED = Path("auto")  # a model built from the log
MAX_LISTED_LOSSES = 100  # in run.json
_EQUAL_POSE_DEG = 3.0  # an error below this is not that of another one of equal poses


@value_class
class ReplayedScan:
    """One scan of a run: the pipeline's outcome and state after it, the truth, and the row."""

    outcome: Outcome
    state: PipelineState
    truth: Truth
    row: Row


Listener = Callable[[ReplayedScan], None]
"""Called after each scan; listeners keep what is written beside the rows."""

Progress = Callable[[Iterable[Scan], int, str], Iterable[Scan]]
"""Shows progress: (scans, how many there are, what is done with them) -> the same scans."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """The definition of a run.

    Attributes:
        source: log, bag or folder of scans.
        options: how to read it.
        config_file: TOML file with settings, see docs/settings.md.
        assignments: settings ``a.b=value`` that replace those of the file.
        prefetch: number of scans that are decoded ahead on a thread; the pipeline then has a
            thread, too. 0 uses one thread; the result is the same.
        growing: the log, if it is still written; a scan is replayed as soon as it is there.
    """

    source: Path
    options: SourceOptions = field(default_factory=SourceOptions)
    config_file: Path | None = None
    assignments: tuple[str, ...] = ()
    prefetch: int = 0
    growing: GrowingLog | None = None


class Run:
    """An open run, which is a context manager. ``rows`` may be iterated once.

    Attributes:
        config: the effective configuration.
        surface: the model of the target.
        registrar: registers scans against that model.
        stages: the stages of the pipeline.
        model_check: result of the check of the model by the rows so far.
        done: number of scans processed so far.
        taken: the rows of these scans.
        task: the task of the gripper, compared with the model.
        flight: the flight of guidance so far, for the assessment of the capture.
        acceleration: acceleration of the target that was fitted to the poses; None where it is
            given.
    """

    def __init__(self, job: Job) -> None:
        """Open the log and index the model.

        Args:
            job: the log, its reading options and the settings of the run.

        Raises:
            UnreadableInput: the log or the model cannot be read.
            UsageError: a key, flag or topic is wrong.
            MissingBackend: the back end is not installed.
        """
        self.job = job
        unknown = job.options.model == RECONSTRUCTED
        poses = load_config(job.config_file, {}, job.assignments).register.backend == POSES
        if poses and unknown:
            raise UsageError(
                "poses contain no model",
                where="--model auto",
                hint="leave out --model, or name a file",
            )
        options = replace(job.options, poses=poses, model=None if unknown else job.options.model)
        self._opened = (
            job.growing.open(options) if job.growing else open_source(job.source, options)
        )
        self._made: Reconstruction | None = None
        try:
            header = self.header = self._without_model() if unknown else self.source.header
            own = own_settings(header.scenario, str(job.source))
            self.config: RunConfig = load_config(
                job.config_file, own, job.assignments, job.source.parent
            )
            if (
                self._made is not None
                and self.config.init == "log"
                and self._made.poses[0][0] == self._first_ns
            ):
                self.config = replace(self.config, init=pose_text(self._made.poses[0][1]))
            self.surface: Surface = self._model()
            self.registrar = Registrar(self.surface, self.config.register)
            self.model_check = ModelCheck(self.registrar, self.surface)
            self._shape = target_geometry(self.surface, self.config.fixture_axis_c)
            self.task, self._target = task_and_target(self.config, self.surface, self._shape)
            self.acceleration = self._fitted_acceleration()
            self.stages = self._new_stages()
            self.estimator = self.stages.estimator
        except BaseException:
            self.source.close()
            raise
        labelled = bool(header.labels) or header.seed is not None
        self._labels = header.labels if labelled else None
        self.taken = RowTable()
        self._reference: Reference | None = None
        self._healthy = HealthyPoses(self.estimator)
        self._fitted = HealthyPoses(self.estimator)  # poses of the reference motion
        self._smoothed: tuple[int, Reference | None] | None = None
        self._cause = Cause()
        self._reference_instants: list[int] = []
        self._state, self.done = first_state(self.stages), 0
        self._scored: Scorer | None = None
        self._image: Pose | None = None  # of {C}, which the run follows
        self._end: tuple[Belief, State] | None = None
        self.flight = FlightLog()
        self._assessed: tuple[int, Assessment] | None = None

    def __enter__(self) -> Run:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.source.close()

    @property
    def source(self) -> Source:
        """The open log; of one that grows, as it was opened last."""
        return self.job.growing.source if self.job.growing else self._opened

    def __len__(self) -> int:
        """Return the number of selected scans."""
        return len(self.source)

    def fit_reference(self, progress: Progress | None = None) -> Reference:
        """Replay the log once and fit one motion to all healthy poses; errors are then computed
        against this motion.

        ``rows`` calls this method if ``reference`` is "fit" and it was not called before.

        Args:
            progress: shows the progress of this replay.

        Returns:
            The fitted motion.

        Raises:
            UsageError: there are fewer than four healthy poses.
        """
        ready = self._new_stages(plans=False)
        poses, instants = HealthyPoses(ready.estimator), set[int]()
        for state, outcome in self._outcomes(ready, progress, "fitting", first_state(ready)):
            poses.add(state, outcome)
            if outcome.scan.status is not ScanStatus.CLOCK:
                instants.add(outcome.scan.t_ns)
        self._reference, self._fitted = poses.reference(), poses
        self._reference_instants = sorted(instants)
        return self._reference

    def rows(
        self, listeners: Iterable[Listener] = (), progress: Progress | None = None
    ) -> Generator[Row]:
        """Replay the log row by row, after ``restore`` from the first scan that was not processed.

        Args:
            listeners: called with each scan, in this order, before its row is yielded.
            progress: shows the progress of the replay.

        Yields:
            One row per selected scan; a scan that could not be used has a status with the reason.

        Raises:
            UnreadableInput: no scan is selected.
            UsageError: the first pose or the reference motion cannot be determined.
        """
        if not len(self.source):
            hint = "widen the selection, or see 'avsreplay info'"
            raise UnreadableInput("no scan to replay", where=str(self.job.source), hint=hint)
        if self.config.reference is Against.FIT and self._reference is None:
            self.fit_reference(progress)
        listeners, self._scored = tuple(listeners), self._scored or self._scorer()
        outcomes = self._outcomes(self.stages, progress, "replaying", self._state, self.done)
        if (
            self.job.prefetch
        ):  # the pipeline has a thread of its own; scoring and writing stay in this one
            outcomes = ahead(outcomes, self.job.prefetch)
        for state, outcome in outcomes:
            with shielded():
                row = self._take(state, outcome, listeners)
            yield row

    def _take(self, state: PipelineState, outcome: Outcome, listeners: Sequence[Listener]) -> Row:
        """Score a processed scan and hand it to everything that collects scans; the state of the
        run is then that after this scan.
        """
        if self._image is None and outcome.verdict.gamma:
            self._follow(outcome)
        self._healthy.add(state, outcome)
        self._cause = self._cause.after(
            outcome.moves is not Moves.FREE or bool(outcome.manoeuvres),
            self._healthy.store,
            self.estimator.params,
            outcome.start_ns,
            outcome.scan.t_ns,
        )
        outcome = replace(outcome, cause=self._cause.words)
        assert self._scored is not None
        truth = self._truth_of(outcome.scan)
        if self.job.growing:
            self.job.growing.take(outcome.scan, self._true(outcome.scan))
        self.model_check.add(outcome.scan, outcome.alignment)
        row = Row.of(outcome, self._scored.score(state, outcome, truth))
        if truth.state is not None:
            self._end = outcome.belief, truth.state
        scan = ReplayedScan(outcome, state, truth, row)
        for listener in listeners:
            listener(scan)
        self.flight.take(
            at_grasp(outcome.belief, self.task.grasp_c),
            state.guidance,
            outcome.verdict.gamma,
            state.monitors.convergence,
            ScanErrors(
                self._noise_of(outcome), outcome.disturbances, outcome.monitors.forecast.lasting
            ),
        )
        self.taken.append(row)
        self._state, self.done = state, self.done + 1
        return row

    def smoothed(self) -> Reference | None:
        """The best motion of all scans so far and its events; None with fewer than four healthy
        poses. It is computed once.
        """
        if self._smoothed is None or self._smoothed[0] != self.done:
            try:
                self._smoothed = self.done, self._healthy.reference()
            except UsageError:
                self._smoothed = self.done, None
        return self._smoothed[1]

    def cause_names(self, kind: str, t_ns: int) -> bool:
        """Return whether the column ``cause`` names an event of a kind.

        Args:
            kind: name of the kind of events.
            t_ns: instant of the scan [ns].
        """
        return self._cause.names(kind, t_ns)

    def rescore(self) -> list[int]:
        """Score the plans of a log that grew with all its true poses; replace the rows that change
        and return their indices.
        """
        return [] if self._scored is None else self._scored.rescore(self.taken, self._true_poses())

    def checkpoint(self, more: Any) -> bytes:
        """Return the state after the last row, from which ``restore`` continues with the same bits.

        Args:
            more: further state to store with it, such as what listeners have collected.
        """
        own = (
            *(self._state, self.done, self.model_check, self._end, self._image),
            *(self._scored, self.flight, self._cause),
        )
        motion = None if self._scored is None else self._scored.motion
        poses = *self._fitted.store.arrays(), *self._healthy.store.arrays()
        return pack((*own, *poses, self._reference_instants, more), self._named(motion))

    def restore(self, path: Path, rows: RowTable, more: Any = None) -> Any:
        """Continue from a checkpoint; returns what was stored with it.

        Args:
            path: file with the bytes of ``checkpoint``.
            rows: of the scans processed before.
            more: what is stored with it must have the structure of this.

        Raises:
            UnreadableInput: the file is missing or damaged.
        """
        scored = self._scorer()
        motion, scored.motion = scored.motion, None  # it is named and not stored
        judged = self.model_check, None, None, scored, self.flight, self._cause
        empty = (*self._fitted.store.arrays(), *self._healthy.store.arrays())
        like: Any = (self._state, 0, *judged, *empty, [], more)
        found = unpack(path, self._named(None), like)
        self._state, self.done, self.model_check, self._end, *rest = found
        self.taken = rows
        self._image, self._scored, self.flight, self._cause, *rest = rest
        *arrays, self._reference_instants, stored = rest
        self._fitted.store.extend(*arrays[:2])
        self._healthy.store.extend(*arrays[2:])
        if len(self._fitted.store):
            self._reference = self._fitted.reference()
        self._scored.motion = self._scorer().motion if self._reference else motion
        return stored

    def _named(self, motion: Motion | None) -> dict[str, object]:
        """Objects that a checkpoint refers to by name; the interpolation of the truth is made
        again.
        """
        return {
            "surface": self.surface,
            "registrar": self.registrar,
            "estimator": self.estimator,
            "motion": motion,
        }

    @property
    def truth(self) -> State | None:
        """True state at the last scan that has one, its principal axes in the order of the
        estimate's.
        """
        return self.header.truth if self._end is None else matched_truth(*self._end)

    @property
    def approach(self) -> Limits:
        """Constraints of every plan of this run, with all lengths."""
        return self.stages.guidance.limits

    def summary(self) -> Summary:
        """Summarise the rows taken so far."""
        clock, losses = self.source.clock, self.source.losses
        counts = {
            "losses": len(losses),
            "lost_messages": sum(loss.messages or 0 for loss in losses),
        }
        stamps = {
            "unset": clock.unset,
            "jumped": clock.jumps,
            "equal": clock.equal,
            "back": clock.back,
        }
        counts |= {f"stamps_{name}": count for name, count in stamps.items()}
        text = acceleration_text(self.config.estimator, self.acceleration)
        truth = self.truth or self.header.truth
        found = Summary.fold(self.taken, labels=self._labels, truth=truth, counts=counts)
        return replace(found, acceleration=text, assessment=self.assessment)

    @property
    def assessment(self) -> Assessment:
        """Whether the robot would have captured the target, by the scans so far; it is computed
        once.
        """
        if self._assessed is None or self._assessed[0] != self.done:
            self._assessed = self.done, self._assess()
        return self._assessed[1]

    def _assess(self) -> Assessment:
        surface, robot = self.surface, self.config.task.with_gripper(self.config.robot)
        motion = None if self._scored is None else self._scored.motion
        first_ns = self.flight.stamps[0] if self.flight.stamps else 0
        setup = Setup(
            task=self.task,
            estimator=self._predictor(),
            guidance=self.stages.guidance,
            convergence=self.stages.monitors.convergence,
            target=self._target,
            solid=len(surface.faces) > 0,
            extent_m=surface.extent,
            since_ns=first_ns,
            thrust_noise_mps2=robot.thrust_noise * self.stages.guidance.params.a_max_mps2,
            advice=grasp_advice(self.task, surface, self._shape),
        )
        since_s = 0.0 if self._scored is None else self._scored.since_s(first_ns)
        given = None if motion is None else (lambda times: motion(times + since_s))
        return assess(setup, self.flight, given)

    def _noise_of(self, outcome: Outcome) -> Array | None:
        """Covariance (6, 6) of the error of a measured pose in {C} [rad, m]."""
        if outcome.innovation is None or outcome.alignment is None:
            return None
        C = in_fixture(outcome.innovation.R, outcome.alignment.T_ac.q, outcome.belief.x.q_bc)
        if not isinstance(self.estimator, Estimator):
            return C
        return geometry.covariance_about(C, np.array(self.estimator.frame.origin_c))

    def _predictor(self) -> Estimator:
        """The estimator that predicts targets from a belief; a plug-in only predicts its own."""
        if isinstance(self.estimator, Estimator):
            return self.estimator
        first_ns = self.flight.stamps[0] if self.flight.stamps else 0
        return Estimator(self.config.estimator, None, self.surface.extent, first_ns)

    def facts(self) -> dict[str, Any]:
        """Return what ``run.json`` holds besides versions: effective configuration and hashes
        of what was read.
        """
        surface, losses = self.surface, self.source.losses
        return {
            "arithmetic": arithmetic.state(),
            "log": {
                "name": self.job.source.name,
                "sha256": self.source.sha256,
                "scans": len(self.source),
            },
            "model": {
                "name": Path(surface.name).name,
                "sha256": surface.sha256,
                "extent_m": surface.extent,
            },
            "clock": settings.dump(self.source.clock),
            "clouds": self.source.meaning.record(),
            "acceleration": None if self.acceleration is None else self.acceleration.record(),
            "losses": {"count": len(losses), "first": settings.dump(losses[:MAX_LISTED_LOSSES])},
            "selection": settings.dump(self.job.options),
            "robot": self.config.robot_line,
            "approach": settings.dump(self.approach),
            "task": self.task.record(),
            "config": settings.dump(
                replace(
                    self.config,
                    register=self.config.register.with_own(),
                    estimator=self.config.estimator.with_own(),
                )
            ),
        }

    def _new_stages(self, plans: bool = True) -> Stages:
        clock = self.source.first_ns, self.source.clock.period_s * self.source.options.every
        plan = replace(self.config.plan, enabled=plans and self.config.plan.enabled)
        config = replace(self.config, plan=plan)
        goal = self.task, self._target
        return stages(config, self.header, self.surface, self.registrar, self._true, goal, clock)

    def _fitted_acceleration(self) -> AccelerationFit | None:
        """Fit the acceleration to the measured poses of a first pass if this is set, and use it."""
        if not self.config.estimator.fit_acceleration:
            return None
        self.config = with_acceleration(self.config, (0.0, 0.0, 0.0))
        ready = self._new_stages(plans=False)
        outcomes = [
            outcome for _, outcome in self._outcomes(ready, None, "fitting", first_state(ready))
        ]
        measured = [(o.scan.t_ns, o.alignment) for o in outcomes if o.scan.status is ScanStatus.OK]
        found = fit_acceleration(measured, ready.estimator.params)
        self.config = with_acceleration(self.config, found.mean.tolist())
        return found

    def _outcomes(
        self,
        ready: Stages,
        progress: Progress | None,
        what: str,
        state: PipelineState,
        first: int = 0,
    ) -> Iterator[tuple[PipelineState, Outcome]]:
        """The pipeline over the scans, which are decoded ahead on a thread that ends with this
        generator.
        """
        growing, prefetch = self.job.growing, self.job.prefetch
        scans = (
            ahead(growing.scans(), prefetch or 1) if growing else self.source.scans(prefetch, first)
        )
        try:
            shown = (
                progress(scans, 0 if growing else len(self.source) - first, what)
                if progress
                else scans
            )
            yield from pipeline.fold(ready, state, shown)
        finally:
            scans.close()

    def _scorer(self) -> Scorer:
        return Scorer(
            self.estimator,
            self._true_poses(),
            self.config.reference.value,
            growing=bool(self.job.growing),
        )

    def _follow(self, outcome: Outcome) -> None:
        """Take the truth as that of the pose that the run follows, where exact symmetries of the
        model make several poses equal.
        """
        truth = self._truth_of(outcome.scan).pose
        if truth is None:
            return
        found, best = outcome.alignment.T_ac, truth
        if pose_error(found, truth).angle_deg > _EQUAL_POSE_DEG:
            images = self.registrar.images(truth)
            best = min(images, key=lambda pose: pose_error(found, pose).angle_deg)
        self._image = truth.inverse() @ best
        if best is not truth:
            self._scored = self._scorer()

    def _true_poses(self) -> list[tuple[int, Pose]]:
        """True poses of the log, or of the reference within its span, about the grasp point."""
        reference, poses = self._reference, list(self.source.truth_poses())
        if self._made is not None:
            poses = (
                [] if self._T_cr is None else [(t_ns, pose @ self._T_cr) for t_ns, pose in poses]
            )
        if reference is not None:
            inside = [
                t for t in self._reference_instants if reference.epoch_ns <= t <= reference.end_ns
            ]
            poses = [(t_ns, reference.at(t_ns).T_ac) for t_ns in inside]
        point = (self._image or Pose.identity()) @ Pose(Pose.identity().q, self.task.grasp_c)
        return [(t_ns, pose @ point) for t_ns, pose in poses]

    def _truth_of(self, scan: Scan) -> Truth:
        """Return the truth at a scan; the pose is that of the reference motion if one was
        fitted.
        """
        truth, fitted = self._true(scan), self._reference
        if fitted is None:
            return truth if self._image is None else truth.at_image(self._image)
        inside = (
            fitted.epoch_ns <= scan.t_ns <= fitted.end_ns
        )  # from the first to the last healthy pose
        return replace(truth, pose=fitted.at(scan.t_ns).T_ac if inside else None, state=None)

    def _without_model(self) -> LogHeader:
        """Reconstruct the model; start and true state of the log refer to another frame {C}
        and are dropped.
        """
        from avsreplay.reconstruct.model import at_grasp, surface_of
        from avsreplay.reconstruct.reconstruction import reconstruct, true_frame

        self._first_ns = self.source.scan_at(0).t_ns if len(self.source) else 0
        self._made = at_grasp(reconstruct(self.source.scans))
        self._T_cr = true_frame(self._made, self.source.truth_poses())
        return replace(self.source.header, surface=surface_of(self._made), start=None, truth=None)

    def _true(self, scan: Scan) -> Truth:
        """The truth of the log; with a reconstructed model its pose, as that of the
        reconstructed frame.
        """
        truth = self.source.truth_of(scan)
        if self._made is None:
            return truth
        pose = None if truth.pose is None or self._T_cr is None else truth.pose @ self._T_cr
        return replace(truth, pose=pose, state=None)

    def _model(self) -> Surface:
        if (surface := self.header.surface) is None:
            hint = "name one with --model FILE, or build it with --model auto"
            raise UsageError("the log holds no model", where=str(self.job.source), hint=hint)
        return surface
