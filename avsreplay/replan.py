"""Planning from the saved beliefs of a result: one plan, its distribution over the belief,
its errors, the approach.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from avsreplay import geometry
from avsreplay.build import target_geometry
from avsreplay.errors import UsageError
from avsreplay.estimate import Estimator
from avsreplay.estimate.driven import DrivenBelief
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.params import NoiseSource
from avsreplay.geometry import Array, Pose
from avsreplay.outcome import Plan
from avsreplay.pipeline import Forecaster, planner_input, target_scene
from avsreplay.plan.arm import Arm
from avsreplay.plan.attitude import Turn, turn_time, with_turn, without_turn
from avsreplay.plan.constrained import constrained
from avsreplay.plan.flights import Execution, Flights, Miss, closed_loop, miss
from avsreplay.plan.flights import execute as plan_execute
from avsreplay.plan.guidance import Guidance, PlannerInput
from avsreplay.plan.joint_path import JointPath
from avsreplay.plan.limits import (
    CONSTRAINTS,
    Scene,
    TargetGeometry,
    in_fixture_axes,
    margin,
    margins,
)
from avsreplay.plan.path import RobotPath, path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, slowed
from avsreplay.plan.supervisor import Supervisor, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance, Spread, Tolerance, draws, spread
from avsreplay.records import Alignment, AlignStatus, Belief, State
from avsreplay.report.page import Flight
from avsreplay.saved_result import Saved

FLIGHT_INSTANTS = 401  # instants of the flight on its page
SIGMA_BOUND = 0.99  # inertia ratios of the draws are limited to the physical range


class Replanning:
    """Planner for a saved result with other settings."""

    def __init__(
        self,
        saved: Saved,
        params: PlanParams,
        limits: Limits,
        supervisor: SupervisorParams,
        arm: Arm | None = None,
    ) -> None:
        """Create the planning.

        Args:
            saved: The saved result.
            params: Parameters of robot and planner.
            limits: Constraints of every capture plan.
            supervisor: Resolved parameters of the supervisor.
            arm: Manipulator that must be able to fly the last metres; None without.

        Raises:
            UsageError: A clearance is required and the result contains no model.
        """
        self.saved, self.supervisor, self.robot, self.arm = saved, supervisor, saved.robot, arm
        self.params = self.robot.applied(params)
        self.robot_line = self.robot.described(params, limits)
        self._radius = self.robot.radius_m
        limits = self.robot.limited(limits)
        self.limits = limits.resolved(saved.extent_m)
        if saved.surface is not None:
            self._target = target_geometry(saved.surface, saved.axis_c)
        elif limits.clearance_m is None:
            self._target = TargetGeometry(np.array(saved.axis_c), np.zeros((1, 3)))
        else:
            raise UsageError(
                "the result contains no model", where=saved.name, hint="plan without a clearance"
            )

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

    def start_margin(self, index: int) -> float:
        """Return the margin of the limits at the start [m or m/s]: negative where one is violated,
        infinite without.

        Args:
            index: index of the scan from which is planned.
        """
        return margin(self._scene(self.saved.beliefs[index]), self.limits, *self.start)

    def _forecast(self, belief: Belief) -> Forecaster:
        return partial(self.saved.estimator.forecast, belief)

    def _scene(self, belief: Belief) -> Scene:
        return target_scene(self.saved.estimator, belief, self._target, self._forecast(belief))

    def _planned(self, scene: Scene, t_ns: int, warm: RobotPath | None = None) -> Plan:
        turn_s = turn_time(scene.attitude, self.robot.gripper, self.params, t_ns)
        if turn_s is not None and math.isinf(turn_s):
            assert scene.attitude is not None
            assert self.robot.gripper is not None
            rest = Turn(t_ns, self.robot.gripper[0])
            return without_turn(rest, scene.attitude, self.robot.gripper[1], self.params, t_ns)
        begin, extent_m = None if warm is None else (warm, 0.0), self.saved.extent_m

        def make(earliest_s: float, share: float) -> Plan:
            params, limits = slowed(self.params, self.limits, share)
            return constrained(
                scene, *self.start, params, limits, t_ns, extent_m, begin, earliest_s
            )

        first_s = turn_s or 0.0
        if self.arm is None:
            return with_turn(make(first_s, 1.0), turn_s)
        fitted = self.arm.fitted(
            make, self.path, scene, self.limits, first_s, self.params.horizon_s
        )
        return with_turn(fitted[0], turn_s)

    def joints(self, index: int, made: Plan) -> JointPath | None:
        """Return the joints of the arm during the last metres of a plan; None without arm or plan.

        Args:
            index: index of the scan from which the plan was made.
            made: the plan.
        """
        if self.arm is None or not made.found:
            return None
        belief, estimator = self.saved.beliefs[index], self.saved.estimator
        scene = Scene(estimator.motion(belief), estimator.attitude(belief))
        return self.arm.last_metres(self.path(made), scene, self.limits)

    def path(self, made: Plan) -> RobotPath:
        """Return the path of a plan from the start.

        Args:
            made: a plan that was found.
        """
        return path_of(made, *self.start)

    def flight(self, index: int, made: Plan) -> Flight:
        """Return the flight of a plan in the fixture's frame {C}, as the belief predicts the
        fixture.

        Args:
            index: index of the scan from which the plan was made.
            made: the plan; it must have been found.
        """
        scene, path = self._scene(self.saved.beliefs[index]), self.path(made)
        times = np.linspace(0.0, made.t_go_s, FLIGHT_INSTANTS)
        r, v = path.at(times)
        rho, rate = scene.goal(times)
        assert scene.attitude is not None
        y = in_fixture_axes(geometry.matrix(scene.attitude(times)), r - rho)
        figures = {
            "distance_m": np.linalg.norm(y, axis=1),
            "speed_mps": np.linalg.norm(v - rate, axis=1),
            **{f"u{axis}_mps2": u for axis, u in zip("xyz", path.thrust(times).T, strict=True)},
        }
        for name, least in zip(
            CONSTRAINTS, margins(scene, self.limits, y, r).values.T, strict=True
        ):
            if np.isfinite(least).all():
                figures[f"margin_{name}_m"] = least
        limits, surface = self.limits, self.saved.surface
        return Flight(
            times,
            y,
            figures,
            np.array(self.saved.axis_c),
            limits.cones,
            limits.mouth_m or 0.0,
            surface,
        )

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
        drawn = _draws(belief, count, np.random.Generator(np.random.PCG64(seed)))
        path, aimed = self.path(made), self.attitude(belief, made.t_go_s)

        def planner(scene: Scene) -> Plan:
            return self._planned(scene, belief.t_ns, path)

        futures = [self._scene(b) for b in drawn]
        noise = self.robot.thrust_noise * self.params.a_max_mps2
        disturbance = Disturbance(noise, np.random.Generator(np.random.PCG64([seed, 1])))
        return spread(path, futures, planner, self.tolerance, aimed, disturbance, self._body)

    @property
    def _body(self) -> Limits | None:
        """The limits for contact: that of the end-effector itself, without the margin of the
        plan.
        """
        return (
            None
            if self.limits.clearance_m is None
            else replace(self.limits, clearance_m=max(self._radius, 1e-9))
        )

    def miss_at(self, index: int, made: Plan) -> Miss | None:
        """Return the error of a plan made at scan ``index`` against the truth; None without
        truth or after the log.
        """
        if self.saved.truth is None or not made.found:
            return None
        belief, begin_s = self.saved.beliefs[index], self.saved.rows[index].t_s
        found = miss(self.path(made), begin_s, self.saved.truth, self.attitude(belief, made.t_go_s))
        return found if np.isfinite(found.distance_m) else None

    def hindsight(self, period_s: float) -> list[tuple[float, Plan, Miss | None]]:
        """Plan at regular intervals from convergence on, each time from the start.

        Args:
            period_s: shortest time between two plans [s].

        Returns:
            For each plan: time of planning [s after the first scan], the plan, and its error (see
                ``miss_at``).
        """
        out: list[tuple[float, Plan, Miss | None]] = []
        due_s = 0.0
        for k, row in enumerate(self.saved.rows):
            if row.converged and row.t_s >= due_s - 1e-6:
                made = self.plan_at(k)
                out.append((row.t_s, made, self.miss_at(k, made)))
                due_s = row.t_s + period_s
        return out

    def flights(self, index: int, count: int, seed: int) -> Flights:
        """Fly approaches with replanning, measured scans, thrust errors and delay against draws
        from a belief.

        Args:
            index: scan at which the approach begins.
            count: number of flights.
            seed: of draws and errors.
        """
        belief, rng = self.saved.beliefs[index], np.random.Generator(np.random.PCG64([seed, 2]))
        noise, ended = self.robot.thrust_noise * self.params.a_max_mps2, []
        for drawn in _draws(belief, count, rng):
            flight = self._guidance(), self._measured(belief, drawn, rng), self._scene(drawn)
            ended.append(closed_loop(*flight, belief.t_ns, self.tolerance, noise, rng, self._body))
        numbers = {
            name: sum(end == name for end, _ in ended) for name in ("captured", "outside", "abort")
        }
        touched = sum(hit for _, hit in ended)
        return Flights(count, numbers["captured"], numbers["outside"], numbers["abort"], touched)

    def _measured(
        self, belief: Belief, drawn: Belief, rng: np.random.Generator
    ) -> Iterator[PlannerInput]:
        """Inputs of guidance for a drawn target after each scan: the filter with poses that
        have its own noise.
        """
        params = replace(
            self.saved.estimator.params, noise=NoiseSource.R0
        )  # there is no registration
        estimator = Estimator(params, belief, self.saved.extent_m, self.saved.since_ns)
        motion, attitude = estimator.motion(drawn), estimator.attitude(drawn)
        track = estimator.initial(belief.t_ns, belief.x.T_ac)
        step_ns = int(np.median(np.diff([row.t_ns for row in self.saved.rows])))
        R = estimator.params.resolved(self.saved.extent_m).R0
        for t_ns in range(
            belief.t_ns + step_ns, belief.t_ns + round(self.params.horizon_s * 2e9), step_ns
        ):
            dt = np.array([(t_ns - belief.t_ns) * 1e-9])
            error = np.sqrt(np.diag(R)) * rng.standard_normal(6)
            pose = Pose(
                geometry.multiply(attitude(dt)[0], geometry.exp(2.0 * error[3:])),
                motion(dt)[0][0] + error[:3],
            )
            seen = Alignment(pose, 1, True, 1000, 1000, 0.0, np.eye(6), AlignStatus.ALIGNED)
            prior = estimator.predict(track, t_ns)
            track = estimator.update(track, prior, estimator.innovate(prior, seen), 1)
            forecast = partial(estimator.forecast, track.belief)
            yield planner_input(estimator, track.belief, self._target, 1, True, forecast)

    def _guidance(self) -> Guidance:
        supervisor, extent_m = Supervisor(self.supervisor), self.saved.extent_m
        return Guidance(
            self.params, supervisor, self.limits, extent_m, self.robot.gripper, self.arm
        )

    def execute(self) -> Execution | None:
        """Simulate the approach over the whole log under the supervisor; None without truth."""
        if self.saved.truth is None:
            return None
        beliefs = {belief.t_ns: belief for belief in self.saved.beliefs}
        inputs = (
            planner_input(
                self.saved.estimator,
                belief,
                self._target,
                row.gamma,
                row.converged,
                self._forecast(belief),
            )
            for belief, row in zip(self.saved.beliefs, self.saved.rows, strict=True)
        )
        turned = lambda known, after_s: self.attitude(beliefs[known.t_ns], after_s)  # noqa: E731
        return plan_execute(self._guidance(), inputs, self.saved.truth, turned, self.saved.since_ns)


def _draws(belief: Belief, count: int, rng: np.random.Generator) -> list[Belief]:
    """Draws from a belief; those of one with a constant acceleration have different
    accelerations.
    """
    if not isinstance(belief, DrivenBelief):
        return [
            replace(belief, x=_bounded(boxplus(belief.x, d))) for d in draws(belief.P, count, rng)
        ]
    P, n = np.block([[belief.P, belief.cross], [belief.cross.T, belief.P_u]]), len(belief.P)
    return [
        replace(belief, x=_bounded(boxplus(belief.x, d[:n])), u=belief.u + d[n:])
        for d in draws(P, count, rng)
    ]


def _bounded(x: State) -> State:
    return replace(x, sigma=np.clip(x.sigma, -SIGMA_BOUND, SIGMA_BOUND))
