"""Planning from the saved beliefs of a result: one plan, its distribution over the belief, its errors, the approach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import plan, settings, toml_document
from avsreplay.build import target_geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.error_state import boxplus
from avsreplay.geometry import Array
from avsreplay.outcome import Plan
from avsreplay.pipeline import Forecaster, planner_input, target_scene
from avsreplay.plan import (
    Execution,
    Limits,
    Miss,
    Motion,
    PlanParams,
    RobotParams,
    Scene,
    Spread,
    SupervisorParams,
    TargetGeometry,
    Tolerance,
)
from avsreplay.records import Belief, State, Surface
from avsreplay.report.result import Result, load_result
from avsreplay.result_dir import read_beliefs
from avsreplay.rows import Row
from avsreplay.settings import Settings, setting

SIGMA_BOUND = 0.99  # inertia ratios of the draws are limited to the physical range


@dataclass(frozen=True, slots=True)
class PlanningConfig(Settings):
    """The settings of a run that planning from its result may change."""

    plan: PlanParams = setting(PlanParams, "Planning.")
    robot: RobotParams = setting(RobotParams, "The robot.")
    limits: Limits = setting(Limits, "Constraints of every capture plan.")
    supervisor: SupervisorParams = setting(SupervisorParams, "Supervision.")


@dataclass(frozen=True, slots=True, eq=False)
class Saved:
    """The part of a result directory that planning uses.

    Attributes:
        name: Name of the directory, for messages.
        rows, beliefs: One per scan.
        truth: Recorded true motion, None where there is none.
        estimator: Estimator with the settings of the run.
        plan, supervisor, limits, robot: Settings of the run.
        axis_c: Outward axis of the fixture in {C}.
        extent_m: Diagonal of the target's bounding box [m].
        surface: Thinned model of the target, None where the result has none.
        warnings: Known defects of the result: not verified, or made from a damaged log.
    """

    name: str
    rows: Sequence[Row]
    beliefs: Sequence[Belief]
    truth: Motion | None
    estimator: Estimator
    plan: PlanParams
    supervisor: SupervisorParams
    limits: Limits
    robot: RobotParams
    axis_c: tuple[float, float, float]
    extent_m: float
    surface: Surface | None
    warnings: Sequence[str] = ()

    @property
    def since_ns(self) -> int:
        """Instant of the first scan."""
        return self.rows[0].t_ns

    def index_at(self, at_s: float | None) -> int:
        """Return the index of the scan from which to plan.

        Args:
            at_s: the last scan not after this time is taken [s after the first scan]; None: the first converged scan.

        Raises:
            UsageError: the time is outside the result, or the estimate never converged.
        """
        if at_s is None:
            converged = [k for k, row in enumerate(self.rows) if row.converged]
            if not converged:
                raise UsageError("the estimate never converged", where=self.name, hint="plan all the same with --at T")
            return converged[0]
        before = [k for k, row in enumerate(self.rows) if row.t_s <= at_s + 1e-9]
        if not before or at_s > self.rows[-1].t_s + 1e-9:
            last = self.rows[-1].t_s
            raise UsageError(f"{at_s} s is outside the result", where="--at", hint=f"it runs from 0 to {last:.2f} s")
        return before[-1]


def load_saved(path: Path, extent_m: float | None = None) -> Saved:
    """Read a result directory.

    Args:
        path: the directory.
        extent_m: diagonal of the target's bounding box [m]; that of the result if None.

    Raises:
        UnreadableInput: the path is not a complete result directory.
        UsageError: a setting in it is invalid, or the size of the target is not known.
    """
    result = load_result(path)
    beliefs = read_beliefs(path / "beliefs.npz")
    if not result.rows or len(beliefs) != len(result.rows):
        what = f"{len(result.rows)} rows and {len(beliefs)} beliefs"
        raise UnreadableInput(what, where=str(path), hint="run again")
    config = result.header.get("config", {})
    extent = extent_m or _extent(result, path)
    since_ns = result.rows[0].t_ns
    truth = None
    if len(result.poses) >= 4:
        times = np.array([(t_ns - since_ns) * 1e-9 for t_ns, _ in result.poses])
        truth = plan.interpolated(times, [pose for _, pose in result.poses])
    return Saved(
        name=str(path),
        rows=result.rows,
        beliefs=beliefs,
        truth=truth,
        estimator=Estimator(_table(EstimatorParams, config, "estimator"), None, extent),
        plan=_table(PlanParams, config, "plan"),
        supervisor=_table(SupervisorParams, config, "supervisor").resolved(extent),
        limits=_table(Limits, config, "limits"),
        robot=_table(RobotParams, config, "robot"),
        axis_c=tuple(config.get("fixture_axis_c", (1.0, 0.0, 0.0))),
        extent_m=extent,
        surface=_surface(result),
        warnings=result.warnings,
    )


def _table(cls: Any, config: Mapping[str, Any], name: str) -> Any:
    known = {k: v for k, v in config.get(name, {}).items() if v is not None}
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
    for name, values in (("plan", saved.plan), ("limits", saved.limits), ("robot", saved.robot)):
        tables[name] = {k: v for k, v in settings.dump(values).items() if v is not None}
    tables["supervisor"] = {k: v for k, v in settings.dump(saved.supervisor).items() if v is not None}
    changed = toml_document.override(toml_document.Document("run.json", tables), assignments)
    made = toml_document.build(PlanningConfig, changed)
    return replace(
        saved,
        plan=made.plan,
        limits=made.limits,
        robot=made.robot,
        supervisor=made.supervisor.resolved(saved.extent_m),
    )


def _surface(result: Result) -> Surface | None:
    if result.view is None or not len(result.view.vertices):
        return None
    vertices = np.asarray(result.view.vertices, dtype=np.float64)
    return Surface(vertices, np.asarray(result.view.faces, dtype=np.int32), "view.npz", "")


def _extent(result: Result, path: Path) -> float:
    stated = result.header.get("model", {}).get("extent_m")
    if stated is not None:
        return float(stated)
    if result.view is None or not len(result.view.vertices):
        raise UsageError("the target's size is not known", where=str(path), hint="give it with --extent METRES")
    return float(np.linalg.norm(np.ptp(result.view.vertices, axis=0)))


class Replanning:
    """Planner for a saved result with other settings."""

    def __init__(
        self,
        saved: Saved,
        params: PlanParams,
        limits: Limits,
        supervisor: SupervisorParams,
        robot: RobotParams | None = None,
    ) -> None:
        """Create the planning.

        Args:
            saved: The saved result.
            params: Parameters of robot and planner.
            limits: Constraints of every capture plan.
            supervisor: Resolved parameters of the supervisor.
            robot: The robot; that of the run where None.

        Raises:
            UsageError: A clearance is required and the result contains no model.
        """
        self.saved, self.supervisor, self.robot = saved, supervisor, robot or saved.robot
        self.params = self.robot.applied(params)
        self.robot_line = self.robot.described(params, limits)
        self._radius = self.robot.radius_m
        limits = self.robot.limited(limits)
        self.limits = limits.resolved(saved.extent_m)
        if saved.surface is not None:
            self._target = target_geometry(saved.surface, saved.axis_c, limits.clearance_m is not None)
        elif limits.clearance_m is None:
            self._target = TargetGeometry(np.array(saved.axis_c), np.zeros((1, 3)))
        else:
            raise UsageError("the result contains no model", where=saved.name, hint="plan without a clearance")

    @property
    def start(self) -> tuple[Array, Array]:
        """Position and velocity (3,) of the robot at the instant of planning."""
        return np.array(self.params.robot_position_m), np.array(self.params.robot_velocity_mps)

    @property
    def tolerance(self) -> Tolerance:
        """Largest errors of a capture: the supervisor's tolerances."""
        s = self.supervisor
        return Tolerance(s.capture_pos_m or 0.0, s.capture_speed_mps or 0.0, s.capture_angle_deg)

    def plan_at(self, index: int) -> Plan:
        """Plan from the belief after a scan, under the limits.

        Args:
            index: index of the scan.
        """
        belief = self.saved.beliefs[index]
        return self._planned(self._scene(belief), belief.t_ns)

    def _forecast(self, belief: Belief) -> Forecaster:
        return partial(self.saved.estimator.forecast, belief)

    def _scene(self, belief: Belief) -> Scene:
        return target_scene(self.saved.estimator, belief, self._target, self._forecast(belief))

    def _planned(self, scene: Scene, t_ns: int, warm: plan.RobotPath | None = None) -> Plan:
        turn_s = plan.turn_time(scene.attitude, self.robot.gripper, self.params, t_ns)
        start, extent_m = None if warm is None else (warm, 0.0), self.saved.extent_m
        problem = scene, *self.start, self.params, self.limits, t_ns, extent_m, start, turn_s or 0.0
        return plan.with_turn(plan.constrained(*problem), turn_s)

    def path(self, made: Plan) -> plan.RobotPath:
        """Return the path of a plan from the start.

        Args:
            made: a plan that was found.
        """
        return plan.path_of(made, *self.start)

    def attitude(self, belief: Belief, after_s: float) -> Array:
        """Return the predicted q_ac (4,) a time after a belief.

        Args:
            belief: the belief.
            after_s: the time [s].
        """
        return np.asarray(self.saved.estimator.attitude(belief)(np.array([after_s]))[0])

    def spread_at(self, index: int, made: Plan, count: int, seed: int) -> Spread:
        """Return the distribution of a plan over draws from the belief from which it was made.

        Args:
            index: index of the scan at which the plan was made.
            made: the plan; it must have been found.
            count: number of draws.
            seed: seed of the draws.
        """
        belief = self.saved.beliefs[index]
        offsets = plan.draws(belief.P, count, np.random.Generator(np.random.PCG64(seed)))
        drawn = [replace(belief, x=_bounded(boxplus(belief.x, d))) for d in offsets]
        scenes = [self._scene(b) for b in drawn]
        path, aimed = self.path(made), self.attitude(belief, made.t_go_s)

        def planner(scene: Scene) -> Plan:
            return self._planned(scene, belief.t_ns, path)

        futures = [plan.Future(scene) for scene in scenes]
        noise = self.robot.thrust_noise * self.params.a_max_mps2
        disturbance = plan.Disturbance(noise, np.random.Generator(np.random.PCG64([seed, 1])))
        # contact is measured with the end-effector itself, without the margin of the plan
        body = None if self.limits.clearance_m is None else replace(self.limits, clearance_m=max(self._radius, 1e-9))
        return plan.spread(path, futures, planner, self.tolerance, aimed, disturbance, body)

    def miss_at(self, index: int, made: Plan) -> Miss | None:
        """Return the error of a plan made at scan ``index`` against the truth; None without truth or after the log."""
        if self.saved.truth is None or not made.found:
            return None
        belief = self.saved.beliefs[index]
        begin_s = (belief.t_ns - self.saved.since_ns) * 1e-9
        found = plan.miss(self.path(made), begin_s, self.saved.truth, self.attitude(belief, made.t_go_s))
        return found if np.isfinite(found.distance_m) else None

    def hindsight(self, period_s: float) -> list[tuple[float, Plan, Miss | None]]:
        """Plan at regular intervals from convergence on, each time from the start.

        Args:
            period_s: shortest time between two plans [s].

        Returns:
            For each plan: time of planning [s after the first scan], the plan, and its error (see ``miss_at``).
        """
        out: list[tuple[float, Plan, Miss | None]] = []
        due_s = 0.0
        for k, row in enumerate(self.saved.rows):
            if row.converged and row.t_s >= due_s - 1e-6:
                made = self.plan_at(k)
                out.append((row.t_s, made, self.miss_at(k, made)))
                due_s = row.t_s + period_s
        return out

    def execute(self) -> Execution | None:
        """Simulate the approach over the whole log under the supervisor; None without truth."""
        if self.saved.truth is None:
            return None
        guidance = plan.Guidance(
            self.params, plan.Supervisor(self.supervisor), self.limits, self.saved.extent_m, self.robot.gripper
        )
        beliefs = {belief.t_ns: belief for belief in self.saved.beliefs}
        inputs = (
            planner_input(self.saved.estimator, belief, self._target, row.gamma, row.converged, self._forecast(belief))
            for belief, row in zip(self.saved.beliefs, self.saved.rows, strict=True)
        )
        turned = lambda known, after_s: self.attitude(beliefs[known.t_ns], after_s)  # noqa: E731
        return plan.execute(guidance, inputs, self.saved.truth, turned, self.saved.since_ns)


def _bounded(x: State) -> State:
    return replace(x, sigma=np.clip(x.sigma, -SIGMA_BOUND, SIGMA_BOUND))
