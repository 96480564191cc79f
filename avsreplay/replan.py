"""Planning from the saved beliefs of a result: a plan, the distribution of its errors over the
belief, its errors against the truth, and the simulated approach.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from avsreplay import geometry
from avsreplay.assess import (
    SIMULATED_FLIGHTS,
    FlightLog,
    ScanErrors,
    Setup,
    assess,
    drawn_beliefs,
    simulated,
)
from avsreplay.assessment import Assessment
from avsreplay.build import target_geometry
from avsreplay.errors import UsageError
from avsreplay.estimate.grasp_point import at_grasp
from avsreplay.geometry import Array
from avsreplay.monitor.convergence import Convergence, ConvergenceTrack
from avsreplay.outcome import Plan
from avsreplay.pipeline import Forecaster, planner_input, target_scene
from avsreplay.plan.arm import Arm
from avsreplay.plan.attitude import Turn, turn_time, with_turn, without_turn
from avsreplay.plan.constrained import constrained, linearised_s, with_safety
from avsreplay.plan.flights import Decided, Ended, Miss, changes_of, miss
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
from avsreplay.plan.path import RobotPath, StepPath, path_of
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, slowed
from avsreplay.plan.supervisor import Supervisor, SupervisorParams
from avsreplay.plan.uncertainty import Disturbance, Spread, Tolerance, spread
from avsreplay.records import Belief, Surface
from avsreplay.report.page import Flight
from avsreplay.rows import Row
from avsreplay.saved_result import Saved
from avsreplay.tables import column_of
from avsreplay.task import target_at, task_of

FLIGHT_INSTANTS = 401  # instants of the flight on its page
_NO_MODEL = Surface(np.zeros((1, 3)), np.zeros((0, 3), np.int32), "", "")


class Replanning:
    """The planner for a saved result, with settings that may differ from those of the run."""

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
        self.saved, self.arm = saved, arm
        self.robot = saved.task.with_gripper(saved.robot)
        self.supervisor = saved.task.with_tolerance(supervisor).resolved(saved.extent_m)
        self.params = self.robot.applied(params)
        self.robot_line = self.robot.described(params, limits)
        if saved.surface is None and limits.clearance_m is not None:
            raise UsageError(
                "the result contains no model", where=saved.name, hint="plan without a clearance"
            )
        surface, axis = saved.surface or _NO_MODEL, saved.task.axis or (1.0, 0.0, 0.0)
        target = (
            target_geometry(surface, axis)
            if saved.surface is not None
            else TargetGeometry(np.array(axis), np.zeros((1, 3)))
        )
        closest = target.surface or (lambda y: (y, np.zeros(len(y))))
        self.task = task_of(
            saved.task,
            *(supervisor, saved.robot, axis, surface, closest, limits, saved.extent_m),
        )
        self.limits = self.robot.limited(self.task.corridor(limits)).resolved(saved.extent_m)
        target = replace(target, axis_c=self.task.axis_c)
        self._target = target_at(target, self.task.grasp_c)
        self.truth = saved.truth(self.task.grasp_c)

    @property
    def start(self) -> tuple[Array, Array]:
        """Position and velocity (3,) of the robot at the instant of planning."""
        return self.params.start

    @property
    def tolerance(self) -> Tolerance:
        """Largest errors of a capture: the supervisor's tolerances."""
        return self.task.tolerance

    def belief(self, index: int) -> Belief:
        """Return the belief after a scan, about the grasp point.

        Args:
            index: index of the scan.
        """
        return at_grasp(self.saved.beliefs[index], self.task.grasp_c)

    def plan_at(self, index: int) -> Plan:
        """Plan from the belief after a scan, under the limits.

        Args:
            index: index of the scan.
        """
        belief = self.belief(index)
        return self._planned(self._scene(belief), belief.t_ns)

    def stated(self, index: int, made: Plan) -> Plan:
        """Return a plan with the margins of a robot that withdraws or coasts from any of its
        instants.

        Args:
            index: index of the scan from which the plan was made.
            made: the plan.
        """
        if not made.found:
            return made
        scene, own = self._scene(self.belief(index)), (self.params, self.limits)
        return with_safety(scene, made, self.path(made), *own, self.saved.extent_m)

    def start_margin(self, index: int) -> float:
        """Return the margin of the limits at the start [m or m/s]: negative where one is violated,
        infinite without.

        Args:
            index: index of the scan from which is planned.
        """
        return margin(self._scene(self.belief(index)), self.limits, *self.start)

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
        belief, estimator = self.belief(index), self.saved.estimator
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
        scene, path = self._scene(self.belief(index)), self.path(made)
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
            self.task.axis_c,
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
        belief = self.belief(index)
        _, drawn = drawn_beliefs(belief, count, np.random.Generator(np.random.PCG64(seed)))
        path, aimed = self.path(made), self.attitude(belief, made.t_go_s)

        time_to_go = self._time_to_go(belief, made, path)
        futures = [self._scene(b) for b in drawn]
        noise = self.robot.thrust_noise * self.params.a_max_mps2
        disturbance = Disturbance(noise, np.random.Generator(np.random.PCG64([seed, 1])))
        return spread(
            path, futures, time_to_go, self.tolerance, aimed, disturbance, self._setup(0, 0).contact
        )

    def _time_to_go(self, belief: Belief, made: Plan, path: RobotPath) -> Callable[[Scene], float]:
        """Return the time to go to a target that was drawn from a belief: by the linearised
        problem about a plan under constraints, else by a plan of its own.
        """
        if not isinstance(path, StepPath) or self.arm is not None or made.delayed_by:
            return lambda scene: self._planned(scene, belief.t_ns, path).t_go_s
        own = path, self.params, self.limits, self.saved.extent_m
        mean_s = linearised_s(self._scene(belief), *own)
        return lambda scene: made.t_go_s + linearised_s(scene, *own) - mean_s

    def miss_at(self, index: int, made: Plan) -> Miss | None:
        """Return the error of a plan made at scan ``index`` against the truth; None without
        truth or after the log.
        """
        if self.truth is None or not made.found:
            return None
        belief, begin_s = self.belief(index), self.saved.rows[index].t_s
        found = miss(self.path(made), begin_s, self.truth, self.attitude(belief, made.t_go_s))
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
        rows = self.saved.rows
        known = zip(column_of(rows, "t_s"), column_of(rows, "converged"), strict=True)
        for k, (t_s, converged) in enumerate(known):
            if converged and t_s >= due_s - 1e-6:
                made = self.plan_at(k)
                out.append((t_s, made, self.miss_at(k, made)))
                due_s = t_s + period_s
        return out

    def flights(self, index: int, count: int, seed: int) -> list[tuple[Ended, bool]]:
        """Fly approaches with replanning, measured scans, thrust errors and delay against draws
        from a belief.

        Args:
            index: scan at which the approach begins.
            count: number of flights.
            seed: of draws and errors.

        Returns:
            The end of each flight, and whether the end-effector touched the body outside the grasp.
        """
        log, _ = self._flown()
        log.convergence, log.errors = self._known(self.saved.rows[index])
        setup = self._setup(count, seed)
        flown = simulated(setup, log, None, self.belief(index))
        return [(each, bool(setup.touched(each.path))) for each in flown]

    def recorded(self) -> tuple[Assessment | None, tuple[Decided, ...]]:
        """Return the assessment of the run, None where the result has none, and the changes of the
        supervisor's decision.
        """
        rows = self.saved.rows
        columns = (column_of(rows, name) for name in ("t_s", "action", "supervisor_rule"))
        return self.saved.assessment, changes_of(zip(*columns, strict=True))

    def assess(
        self, index: int, flights: int = SIMULATED_FLIGHTS, seed: int = 0
    ) -> tuple[Assessment, tuple[Decided, ...]]:
        """Return whether the robot would capture if its approach began at a scan, and the changes
        of the supervisor's decision.

        Args:
            index: the scan.
            flights: number of simulated flights where the result ends before the capture.
            seed: of all draws.
        """
        log, decisions = self._flown(index)
        return assess(self._setup(flights, seed), log, self.truth), changes_of(decisions)

    def _flown(self, index: int | None = None) -> tuple[FlightLog, list[Decided]]:
        """The flight over the result that begins at a scan, and its decisions; None: the robot
        stays at its start.
        """
        log, state, guidance = FlightLog(), None, self._guidance()
        decisions: list[Decided] = []
        for k, (known, row) in enumerate(zip(self._inputs(), self.saved.rows, strict=True)):
            if index is not None and k >= index and not log.ended:
                state = guidance.step(state or guidance.initial(known.t_ns), known)
                decisions.append((row.t_s, state.decision.action.value, state.decision.rule))
            log.take(self.belief(k), state, known.gamma, *self._known(row))
        return log, decisions

    def _known(self, row: Row) -> tuple[ConvergenceTrack, ScanErrors]:
        """The test of convergence and what is known of errors after a scan; where the test holds,
        it does so since the first scan.
        """
        converged = bool(row.converged)
        held = ConvergenceTrack(converged, since_ns=self.saved.since_ns if converged else None)
        torque, force = row.torque_noise_radps15, row.force_noise_mps15
        known = None if torque is None or force is None else (torque, force)
        return held, ScanErrors(self.saved.noise, known)

    def _setup(self, flights: int, seed: int) -> Setup:
        surface = self.saved.surface
        return Setup(
            task=self.task,
            estimator=self.saved.estimator,
            guidance=self._guidance(),
            convergence=Convergence(
                self.saved.convergence,
                self.saved.extent_m,
                self.task.tolerance.in_si,
                self.supervisor.sigmas,
            ),
            target=self._target,
            solid=surface is not None and len(surface.faces) > 0,
            extent_m=self.saved.extent_m,
            since_ns=self.saved.since_ns,
            thrust_noise_mps2=self.robot.thrust_noise * self.params.a_max_mps2,
            flights=flights,
            seed=seed,
        )

    def _inputs(self) -> Iterator[PlannerInput]:
        """What was known after each scan of the result."""
        rows = self.saved.rows
        known = zip(column_of(rows, "gamma"), column_of(rows, "converged"), strict=True)
        for k, (gamma, converged) in enumerate(known):
            belief = self.belief(k)
            yield planner_input(
                self.saved.estimator,
                belief,
                self._target,
                gamma,
                converged,
                self._forecast(belief),
            )

    def _guidance(self) -> Guidance:
        supervisor, extent_m = Supervisor(self.supervisor), self.saved.extent_m
        return Guidance(
            self.params, supervisor, self.limits, extent_m, self.robot.gripper, self.arm
        )
