"""Planning from a saved result, without replaying it: one plan, its spread, its hindsight, and the flight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import geometry, plan, toml_document
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.estimate.dynamics import grasp_trajectory, propagate
from avsreplay.estimate.error_state import boxplus
from avsreplay.geometry import Array
from avsreplay.plan import (
    Execution,
    Limits,
    Miss,
    Motion,
    PlannerInput,
    PlanParams,
    Scene,
    Spread,
    SupervisorParams,
    Tolerance,
)
from avsreplay.plan.limits import margin
from avsreplay.records import Belief, Plan, State
from avsreplay.report.result import Result, load_result
from avsreplay.result_dir import read_beliefs
from avsreplay.rows import Row

__all__ = ["Replanning", "Saved", "load_saved"]

SIGMA_BOUND = 0.99  # draws of the inertia ratios stay inside what a body can have


@dataclass(frozen=True, slots=True, eq=False)
class Saved:
    """A result directory as the planner needs it.

    Attributes:
        rows, beliefs: one each a scan.  truth: the recorded true motion, None where there is none.
        estimator: with the run's own settings.  plan, supervisor: the run's settings.
        axis_c: (3,) outward axis of the fixture in {C}.  extent_m: bounding diagonal of the target.
        warnings: what is known against the result: not verified, or made from a damaged log.
    """

    name: str
    rows: Sequence[Row]
    beliefs: Sequence[Belief]
    truth: Motion | None
    estimator: Estimator
    plan: PlanParams
    supervisor: SupervisorParams
    axis_c: Array
    extent_m: float
    warnings: Sequence[str] = ()

    @property
    def since_ns(self) -> int:
        """Instant of the first scan."""
        return self.rows[0].t_ns

    def index_at(self, at_s: float | None) -> int:
        """The last scan not after ``at_s``; None: the first converged one. Raises UsageError where there is none."""
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

    Raises:
        UnreadableInput: it is none.  UsageError: a setting in it cannot be right, or the target's size is not known.
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
        axis_c=np.asarray(config.get("fixture_axis_c", (1.0, 0.0, 0.0)), dtype=np.float64),
        extent_m=extent,
        warnings=result.warnings,
    )


def _table(cls: Any, config: Mapping[str, Any], name: str) -> Any:
    known = {k: v for k, v in config.get(name, {}).items() if v is not None}
    return toml_document.build(cls, toml_document.Document("run.json", {name: known}), (name,))


def _extent(result: Result, path: Path) -> float:
    stated = result.header.get("model", {}).get("extent_m")
    if stated is not None:
        return float(stated)
    if result.view is None or not len(result.view.vertices):
        raise UsageError("the target's size is not known", where=str(path), hint="give it with --extent METRES")
    return float(np.linalg.norm(np.ptp(result.view.vertices, axis=0)))


@dataclass(frozen=True, slots=True, eq=False)
class Replanning:
    """Plans from a saved result under settings of one's own."""

    saved: Saved
    params: PlanParams
    limits: Limits
    supervisor: SupervisorParams

    @property
    def start(self) -> tuple[Array, Array]:
        """Position and velocity (3,) of the robot at the instant of planning."""
        return np.array(self.params.robot_position_m), np.array(self.params.robot_velocity_mps)

    @property
    def tolerance(self) -> Tolerance:
        """What counts as a capture: the supervisor's tolerances."""
        s = self.supervisor
        return Tolerance(s.capture_pos_m or 0.0, s.capture_speed_mps or 0.0, s.capture_angle_deg)

    def scene(self, x: State) -> Scene:
        """The target after a belief's instant: grasp point, fixture axis and mass centre."""
        goal = grasp_trajectory(x)
        tip = grasp_trajectory(_moved(x, self.saved.axis_c))
        return Scene(
            goal,
            lambda t: tip(t)[0] - goal(t)[0],
            lambda t: x.r_a + np.asarray(t)[:, None] * x.v_a,  # rigid: unit long
        )

    def plan_at(self, index: int) -> Plan:
        """Plan from the belief after a scan, under the limits where there are any."""
        belief = self.saved.beliefs[index]
        scene = self.scene(belief.x)
        if not self.limits.any:
            return plan.rendezvous(scene.goal, *self.start, self.params, belief.t_ns)
        return plan.constrained(scene, *self.start, self.params, self.limits, belief.t_ns, self.saved.extent_m)

    def path(self, made: Plan) -> plan.RobotPath:
        """What a plan flies from the start."""
        return plan.path_of(made, *self.start)

    def attitude(self, belief: Belief, after_s: float) -> Array:
        """(4,) predicted q_ac a time after a belief."""
        return _attitude(belief, after_s)

    def spread_at(self, index: int, made: Plan, count: int, seed: int) -> Spread:
        """The plan over draws from the belief it was made from."""
        belief = self.saved.beliefs[index]
        offsets = plan.draws(belief.P, count, np.random.Generator(np.random.PCG64(seed)))
        futures = [_future(_bounded(boxplus(belief.x, d)), belief) for d in offsets]
        aimed = self.attitude(belief, made.t_go_s)
        return plan.spread(self.path(made), futures, self.start, self.params, self.tolerance, aimed)

    def miss_at(self, index: int, made: Plan) -> Miss | None:
        """The plan against the truth at its end; None without truth, or where it ends after the log."""
        if self.saved.truth is None or not made.found:
            return None
        belief = self.saved.beliefs[index]
        begin_s = (belief.t_ns - self.saved.since_ns) * 1e-9
        found = plan.miss(self.path(made), begin_s, self.saved.truth, self.attitude(belief, made.t_go_s))
        return found if np.isfinite(found.distance_m) else None

    def hindsight(self, period_s: float) -> list[tuple[float, Plan, Miss | None]]:
        """A plan every ``period_s`` from convergence on, each from the start: (made at [s], plan, miss)."""
        out: list[tuple[float, Plan, Miss | None]] = []
        due_s = 0.0
        for k, row in enumerate(self.saved.rows):
            if row.converged and row.t_s >= due_s - 1e-6:
                made = self.plan_at(k)
                out.append((row.t_s, made, self.miss_at(k, made)))
                due_s = row.t_s + period_s
        return out

    def execute(self) -> Execution | None:
        """Fly the log under the supervisor; None without truth."""
        if self.saved.truth is None:
            return None
        guidance = plan.Guidance(self.params, plan.Supervisor(self.supervisor), self._planner)
        beliefs = {belief.t_ns: belief for belief in self.saved.beliefs}
        sights = (self.sight(k) for k in range(len(self.saved.rows)))
        turned = lambda sight, after_s: self.attitude(beliefs[sight.t_ns], after_s)  # noqa: E731
        return plan.execute(guidance, sights, self.saved.truth, turned, self.saved.since_ns)

    def _planner(self, goal: Any, r0: Array, v0: Array, params: PlanParams, t_ns: int) -> Plan:
        if not self.limits.any:
            return plan.rendezvous(goal, r0, v0, params, t_ns)
        index = int(np.searchsorted([b.t_ns for b in self.saved.beliefs], t_ns))
        scene = self.scene(self.saved.beliefs[index].x)
        wait = self.params.latency_s
        axis, centre = scene.axis, scene.centre
        shifted = Scene(goal, axis and (lambda t: axis(t + wait)), centre and (lambda t: centre(t + wait)))
        return plan.constrained(shifted, r0, v0, params, self.limits, t_ns, self.saved.extent_m)

    def sight(self, index: int) -> PlannerInput:
        """What the pilot may know after a scan."""
        belief, row = self.saved.beliefs[index], self.saved.rows[index]
        away = _moved(belief.x, (self.supervisor.standoff_m or 0.0) * self.saved.axis_c)
        return PlannerInput(
            t_ns=belief.t_ns,
            gamma=row.gamma,
            converged=row.converged,
            goal=grasp_trajectory(belief.x),
            forecast=lambda times: self.saved.estimator.forecast(belief, times),
            standoff=grasp_trajectory(away),
            margin=self._margin(belief.x) if self.limits.any else None,
        )

    def _margin(self, x: State) -> Callable[[Array, Array], float]:
        scene, limits = self.scene(x), self.limits.resolved(self.saved.extent_m)
        return lambda r, v: margin(scene, limits, r, v)


def _moved(x: State, by_c: Array) -> State:
    """The same body with another grasp point, ``by_c`` (3,) away in {C}."""
    return replace(x, c_b=x.c_b + geometry.matrix(x.q_bc) @ by_c)


def _attitude(belief: Belief, after_s: float) -> Array:
    later, _ = propagate(belief, belief.t_ns + round(after_s * 1e9), 0.0, 0.0)
    return later.x.T_ac.q


def _future(x: State, belief: Belief) -> plan.Future:
    drawn = Belief(belief.t_ns, x, belief.P)
    return plan.Future(grasp_trajectory(x), lambda after_s: _attitude(drawn, after_s))


def _bounded(x: State) -> State:
    return replace(x, sigma=np.clip(x.sigma, -SIGMA_BOUND, SIGMA_BOUND))
