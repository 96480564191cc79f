"""The part of a saved result from which planning starts again: rows, beliefs, ground truth
and settings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from avsreplay import settings, toml_document
from avsreplay.assessment import Assessment
from avsreplay.errors import UnreadableInput, UsageError, value_class
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import ConvergenceParams
from avsreplay.plan.flights import Motion, interpolated
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import SupervisorParams
from avsreplay.records import Belief, Surface
from avsreplay.report.result import load_result, motion_samples, result_path
from avsreplay.result_dir import read_beliefs
from avsreplay.rows import Row
from avsreplay.settings import Settings, setting
from avsreplay.tables import column_of
from avsreplay.task import Approach, TaskParams

if TYPE_CHECKING:
    from avsreplay.run import Run


@dataclass(frozen=True, slots=True)
class PlanningConfig(Settings):
    """The settings of a run that planning from its result may change."""

    plan: PlanParams = setting(PlanParams, "Planning.")
    robot: RobotParams = setting(RobotParams, "The robot.")
    task: TaskParams = setting(TaskParams, "The task of the capture.")
    limits: Limits = setting(Limits, "Constraints of every capture plan.")
    supervisor: SupervisorParams = setting(SupervisorParams, "Supervision.")


@value_class
class Saved:
    """The part of a result directory that planning uses.

    Attributes:
        name: name of the directory, for messages.
        rows, beliefs: one of each per scan.
        times_s, poses: recorded true poses of {C} in {A} and their times after the first scan [s].
        estimator: estimator with the settings of the run.
        plan, supervisor, limits, robot, task, convergence: settings of the run.
        noise: (6, 6) covariance of the error of a measured pose in {C} [rad, m]; None where it is
            not known.
        assessment: the assessment of the run; None where the result has none.
        extent_m: diagonal of the target's bounding box [m].
        surface: thinned model of the target, None where the result has none.
        warnings: known defects of the result: not verified, or made from a damaged log.
    """

    name: str
    rows: Sequence[Row]
    beliefs: Sequence[Belief]
    times_s: Array
    poses: Sequence[Pose]
    estimator: Estimator
    plan: PlanParams
    supervisor: SupervisorParams
    limits: Limits
    robot: RobotParams
    task: TaskParams
    convergence: ConvergenceParams
    extent_m: float
    surface: Surface | None
    noise: Array | None = None
    assessment: Assessment | None = None
    warnings: Sequence[str] = ()

    def truth(self, grasp_c: Array) -> Motion | None:
        """Return the true motion of the grasp point; None where it is not known.

        Args:
            grasp_c: (3,) grasp point in {C} [m].
        """
        if len(self.poses) < 4:
            return None
        point = Pose(np.array([0.0, 0.0, 0.0, 1.0]), grasp_c)
        return interpolated(self.times_s, [pose @ point for pose in self.poses])

    @property
    def since_ns(self) -> int:
        """Instant of the first scan."""
        return self.rows[0].t_ns

    def index_at(self, at_s: float | None) -> int:
        """Return the index of the scan from which to plan.

        Args:
            at_s: the last scan not after this time is taken [s after the first scan]; None: the
                first converged scan.

        Raises:
            UsageError: the time is outside the result, or the estimate never converged.
        """
        if at_s is None:
            converged = [k for k, flag in enumerate(column_of(self.rows, "converged")) if flag]
            if not converged:
                raise UsageError(
                    "the estimate never converged",
                    where=self.name,
                    hint="plan all the same with --at T",
                )
            return converged[0]
        before = [k for k, t_s in enumerate(column_of(self.rows, "t_s")) if t_s <= at_s + 1e-9]
        if not before or at_s > self.rows[-1].t_s + 1e-9:
            last = self.rows[-1].t_s
            raise UsageError(
                f"{at_s} s is outside the result",
                where="--at",
                hint=f"it runs from 0 to {last:.2f} s",
            )
        return before[-1]


def load_saved(path: Path, extent_m: float | None = None) -> Saved:
    """Read a result directory.

    Args:
        path: the directory, or one of its files.
        extent_m: diagonal of the target's bounding box [m]; that of the result if None.

    Raises:
        UnreadableInput: the path is not a complete result directory.
        UsageError: a setting in it is invalid, or the size of the target is not known.
    """
    path = path.parent if path.name == "rows.jsonl" and path.is_file() else result_path(path)
    result = load_result(path)
    beliefs = read_beliefs(path / "beliefs.npz")
    if not result.rows or len(beliefs) != len(result.rows):
        what = f"{len(result.rows)} rows and {len(beliefs)} beliefs"
        raise UnreadableInput(what, where=str(path), hint="run again")
    config = result.header.get("config", {})
    extent = extent_m or result.extent_m(path)
    since_ns = result.rows[0].t_ns
    times, poses = motion_samples(result.poses, since_ns)
    return Saved(
        name=str(path),
        rows=result.rows,
        beliefs=beliefs,
        times_s=times,
        poses=poses,
        estimator=Estimator(_table(EstimatorParams, config, "estimator"), None, extent, since_ns),
        plan=_table(PlanParams, config, "plan"),
        supervisor=_table(SupervisorParams, config, "supervisor").resolved(extent),
        limits=_table(Limits, config, "limits"),
        robot=_table(RobotParams, config, "robot"),
        task=_task(result.header),
        convergence=_table(ConvergenceParams, config, "convergence"),
        noise=_noise(result.header),
        assessment=result.summary.assessment,
        extent_m=extent,
        surface=result.surface,
        warnings=result.warnings,
    )


def of_run(run: Run, rows: Sequence[Row], beliefs: Sequence[Belief]) -> Saved:
    """Return what planning needs of a run that was not saved; without its truth.

    Args:
        run: the run.
        rows: its rows.
        beliefs: its belief at each of them.
    """
    config, extent_m = run.config, run.surface.extent
    return Saved(
        name=run.job.source.name,
        rows=rows,
        beliefs=beliefs,
        times_s=np.zeros(0),
        poses=(),
        estimator=Estimator(config.estimator, None, extent_m, rows[0].t_ns),
        plan=config.plan,
        supervisor=config.supervisor.resolved(extent_m),
        limits=config.limits,
        robot=config.robot,
        task=task_settings(run.task.record()),
        convergence=config.convergence,
        noise=run.flight.noise,
        extent_m=extent_m,
        surface=run.surface,
    )


def _task(header: Mapping[str, Any]) -> TaskParams:
    record = header.get("task") or {"axis": header.get("config", {}).get("fixture_axis_c")}
    try:
        return task_settings(record)
    except (ValueError, TypeError, AttributeError) as error:
        raise UsageError(f"the task in run.json: {error}", hint="run again") from None


def task_settings(record: Mapping[str, Any]) -> TaskParams:
    """Return the settings of a task from its record.

    Args:
        record: as ``Task.record`` makes it.
    """
    names = {f.name for f in dataclasses.fields(TaskParams)}
    known: dict[str, Any] = {k: v for k, v in record.items() if k in names and v is not None}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in known.items()}
    approach = Approach(values.pop("approach", Approach.FREE.value))
    return TaskParams(approach=approach, **values)


def _noise(header: Mapping[str, Any]) -> Array | None:
    try:
        found = np.array(header.get("measured_covariance"), np.float64)
    except (TypeError, ValueError):
        return None
    good = found.shape == (6, 6) and bool(np.isfinite(found).all())
    return found if good and float(np.linalg.eigvalsh(found)[0]) > 0.0 else None


def _table(cls: Any, config: Mapping[str, Any], name: str) -> Any:
    known: dict[str, Any] = {k: v for k, v in config.get(name, {}).items() if v is not None}
    return toml_document.build(cls, toml_document.Document("run.json", {name: known}), (name,))


def with_settings(saved: Saved, assignments: Sequence[str]) -> Saved:
    """Return the saved result with changed settings of the planner.

    Args:
        saved: the saved result.
        assignments: settings such as ``supervisor.sigmas=2``.

    Raises:
        UsageError: an assignment has another form, an unknown key or a wrong value.
    """
    tables: dict[str, Any] = {}
    for name, values in (
        *(("plan", saved.plan), ("limits", saved.limits), ("robot", saved.robot)),
        ("task", saved.task),
    ):
        tables[name] = {k: v for k, v in settings.dump(values).items() if v is not None}
    tables["supervisor"] = {
        k: v for k, v in settings.dump(saved.supervisor).items() if v is not None
    }
    changed = toml_document.override(toml_document.Document("run.json", tables), assignments)
    made = toml_document.build(PlanningConfig, changed)
    return replace(
        saved,
        plan=made.plan,
        limits=made.limits,
        robot=made.robot,
        task=made.task,
        supervisor=made.supervisor.resolved(saved.extent_m),
    )
