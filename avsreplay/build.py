"""Creates the stages from configuration and log header: the only place where names become
objects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from avsreplay.config import RunConfig, parse_pose
from avsreplay.errors import UsageError
from avsreplay.estimate.params import Start
from avsreplay.estimate.plugged import estimator_of
from avsreplay.geometry import Array, Pose
from avsreplay.monitor.convergence import Consistency, Convergence
from avsreplay.monitor.fault_detection import FaultDetector
from avsreplay.parts import OWN
from avsreplay.pipeline import Monitors, PipelineState, Stages
from avsreplay.plan._cone import Body
from avsreplay.plan.arm import with_arm
from avsreplay.plan.guidance import Guidance
from avsreplay.plan.limits import TargetGeometry
from avsreplay.plan.supervisor import Supervisor
from avsreplay.records import LogHeader, Scan, Surface, Truth
from avsreplay.region import Region
from avsreplay.register.backend import POSES
from avsreplay.register.registrar import Registrar
from avsreplay.settings import SettingError
from avsreplay.task import Patch, Task, patches, target_at, task_of
from avsreplay.tracker import Tracker


def stages(
    config: RunConfig,
    header: LogHeader,
    surface: Surface,
    registrar: Registrar,
    truth_of: Callable[[Scan], Truth],
    goal: tuple[Task, TargetGeometry],
    clock: tuple[int, float] = (0, 0.0),
) -> Stages:
    """Create the chain for one log.

    Args:
        config: effective configuration.
        header: of the log.
        surface: model of the target.
        registrar: of that model; one may serve several chains.
        truth_of: truth at a scan; used for the first pose alone, where the configuration starts
            from the truth.
        goal: the task and the geometry of the target about its grasp point.
        clock: instant of the first scan [ns], where a known acceleration begins, and interval of
            the scans [s].

    Raises:
        UsageError: the configuration requires the start of the log, and the log contains none.
    """
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    start = header.start if config.init == "log" or config.estimator.start is Start.NEAR else None
    estimator = config.estimator
    if config.register.backend == POSES:
        estimator = estimator.at_interval(clock[1], surface.extent)
    task, target = goal
    robot, arm = with_arm(config.task.with_gripper(config.robot))
    limits = robot.limited(task.corridor(config.limits))
    supervision = config.task.with_tolerance(config.supervisor).resolved(surface.extent)
    return Stages(
        registrar=registrar,
        estimator=estimator_of(estimator, start, surface.extent, clock[0], 0.5 * (low + high)),
        faults=FaultDetector(config.faults, surface.extent),
        monitors=Monitors(
            Consistency(config.consistency),
            Convergence(
                config.convergence, surface.extent, task.tolerance.in_si, supervision.sigmas
            ),
        ),
        guidance=Guidance(
            robot.applied(config.plan),
            Supervisor(supervision),
            limits,
            surface.extent,
            robot.gripper,
            arm,
        ),
        target=target,
        grasp_c=task.grasp_c,
        guess=config.guess,
        deskew=config.deskew,
        reacquire=config.reacquire,
        initialise=first_pose_source(config, header, truth_of),
        region=Region(np.array(config.region_start()), low, high) if config.region else None,
        tracker=_tracker(config, 0.5 * (low + high), surface.extent),
    )


def _tracker(config: RunConfig, middle: Array, extent_m: float) -> Tracker | None:
    """The tracker of a model; None with the method of the paper and with a plug-in."""
    own = config.estimator.method == OWN and config.estimator.start is not Start.PAPER
    return Tracker(middle, extent_m) if own and config.estimator.robust else None


def task_and_target(
    config: RunConfig, surface: Surface, geometry_c: TargetGeometry
) -> tuple[Task, TargetGeometry]:
    """Return the task, compared with the model, and the geometry of the target about its grasp
    point.

    Args:
        config: effective configuration.
        surface: model of the target.
        geometry_c: that of the model about the origin of {C}.

    Raises:
        UsageError: the task names a patch that the model does not have.
    """
    assert geometry_c.surface is not None
    settings = config.supervisor, config.robot, config.fixture_axis_c
    try:
        task = task_of(config.task, *settings, surface, geometry_c.surface, config.limits)
    except SettingError as error:
        raise UsageError(
            str(error), where=f"task.{error.name}", hint="'avsreplay info' lists the patches"
        ) from None
    return task, target_at(replace(geometry_c, axis_c=task.axis_c), task.grasp_c)


def target_geometry(surface: Surface, axis_c: tuple[float, float, float]) -> TargetGeometry:
    """Return the geometry of the target for guidance.

    Args:
        surface: model of the target in {C} [m]; it is indexed at the first distance that is needed
            for.
        axis_c: outward axis of the fixture in {C}.
    """
    return TargetGeometry(
        np.array(axis_c),
        surface.vertices,
        Body(
            np.ascontiguousarray(surface.vertices, float),
            np.ascontiguousarray(surface.faces, np.int32).reshape(-1, 3),
        ),
    )


def grasp_patches(surface: Surface, geometry_c: TargetGeometry) -> tuple[Patch, ...]:
    """Return flat patches of a model that a straight approach reaches, the largest first.

    Args:
        surface: model of the target in {C}.
        geometry_c: that of the model about the origin of {C}.
    """
    assert geometry_c.surface is not None
    return patches(surface, geometry_c.surface)


def grasp_advice(task: Task, surface: Surface, geometry_c: TargetGeometry) -> str:
    """Return in words which grasp points could be used in place of one that cannot.

    Args:
        task: compared with the model.
        surface: model of the target.
        geometry_c: that of the model about the origin of {C}.
    """
    if not task.problem:
        return ""
    found = grasp_patches(surface, geometry_c)
    if not found:
        return "name one with task.grasp_m and task.axis"
    return f"patches that can be reached: {', '.join(patch.option for patch in found)}"


def first_state(ready: Stages) -> PipelineState:
    """Return the state before the first scan.

    Args:
        ready: the stages of the run; their prior standard deviations scale the observability
            Gramian.
    """
    start = ready.estimator.start
    prior_1s = ready.estimator.params.start_1s if start is None else np.sqrt(np.diag(start.P))
    return PipelineState(ready.monitors.initial(prior_1s))


def first_pose_source(
    config: RunConfig, header: LogHeader, truth_of: Callable[[Scan], Truth]
) -> Callable[[Scan], tuple[Pose | None, str]]:
    """Return where the first pose of a replay comes from.

    Args:
        config: the configuration; ``init`` names the source.
        header: the header of the log, which may hold an initial state.
        truth_of: the ground truth of a scan; called only with ``init`` "truth".

    Returns:
        A function that gives for the first scan the pose of {C} in {A} (None: search without a
        guess) and the name of its source. It raises UsageError where there is no true pose.
    """
    start = header.start
    if config.init == "truth":
        return lambda scan: (_true_pose(truth_of(scan)), "truth")
    if config.init == "log" and start is not None:
        return lambda _scan: (start.x.T_ac, "start")
    if config.init in ("log", "auto") and config.register.backend == POSES:
        return lambda scan: (Pose.identity() if scan.pose is None else scan.pose.T_ac, "measured")
    if config.init in ("log", "auto"):
        return lambda _scan: (None, "acquired")
    pose = parse_pose(config.init)
    return lambda _scan: (pose, "given")


def _true_pose(truth: Truth) -> Pose:
    if truth.pose is None:
        hint = "name its truth with --truth-topic or --truth, or use --init auto"
        raise UsageError(
            "the log has no true pose at its first scan", where="--init truth", hint=hint
        )
    return truth.pose
