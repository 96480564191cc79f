"""The configuration of a run: the parameter classes of all stages, one TOML table each.

Precedence: option, environment variable, ``--config`` file, the log's own ``[run]`` table, default.
The effective configuration is saved with every result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from avsreplay.estimate import EstimatorParams
from avsreplay.geometry import Pose
from avsreplay.log.returns import MAX_COORDINATE_M
from avsreplay.monitor.convergence import ConsistencyParams, ConvergenceParams
from avsreplay.monitor.fault_detection import FaultParams
from avsreplay.plan.rendezvous import PlanParams
from avsreplay.plan.robot import Limits, RobotParams
from avsreplay.plan.supervisor import SupervisorParams
from avsreplay.register.params import RegisterParams
from avsreplay.settings import SettingError, Settings, is_unit, setting
from avsreplay.task import TaskParams
from avsreplay.toml_document import Document, build, load, override, toml_value


class Guess(Enum):
    """The source of the initial guess of the registration."""

    PREDICTED = "predicted"  # closed loop: the filter's prior
    LAST = "last"  # open loop: the last healthy pose


class Against(Enum):
    """The motion against which errors are computed."""

    TRUTH = "truth"
    FIT = "fit"


@dataclass(frozen=True, slots=True)
class RunConfig(Settings):
    """All settings of a replay."""

    guess: Guess = setting(
        Guess.PREDICTED,
        "Initial guess of registration: the filter's prediction (closed loop) or the last healthy"
        " pose (open loop).",
    )
    init: str = setting(
        "log",
        "Initial pose: the initial state in the log, else a global search (log); the true pose"
        " (truth); a global search (auto); or the pose of {C} in {A} as x,y,z,qx,qy,qz,qw.",
    )
    region: str = setting(
        "",
        "Point on the target at the first scan as x,y,z in {A} [m]. A region of the size of the"
        " model then follows the target, and ground, walls and neighbours around it are removed;"
        " empty: all points are used.",
    )
    deskew: bool = setting(
        True,
        "Transform points that have their own times to the instant of the scan, along the predicted"
        " motion.",
    )
    reacquire: bool = setting(
        True,
        "Search globally when a scan is faulty and the prediction is too uncertain to be a guess.",
    )
    reference: Against = setting(
        Against.TRUTH,
        "Reference of the errors: the log's true poses (truth), or one motion fitted to all healthy"
        " poses of a first pass (fit).",
    )
    register: RegisterParams = setting(RegisterParams, "Registration.")
    estimator: EstimatorParams = setting(EstimatorParams, "Estimation.")
    faults: FaultParams = setting(FaultParams, "Fault detection.")
    consistency: ConsistencyParams = setting(ConsistencyParams, "Consistency of the innovations.")
    convergence: ConvergenceParams = setting(ConvergenceParams, "Convergence.")
    task: TaskParams = setting(TaskParams, "The task of the capture.")
    plan: PlanParams = setting(PlanParams, "Planning.")
    robot: RobotParams = setting(RobotParams, "The robot.")
    limits: Limits = setting(Limits, "Constraints of every capture plan.")
    supervisor: SupervisorParams = setting(SupervisorParams, "Supervision.")
    fixture_axis_c: tuple[float, float, float] = setting(
        (1.0, 0.0, 0.0),
        "Unit vector of the fixture's outward axis in {C}, along which the robot approaches.",
    )

    @property
    def robot_line(self) -> str:
        """The assumed robot in one line."""
        return self.task.with_gripper(self.robot).described(self.plan, self.limits)

    def region_start(self) -> tuple[float, ...]:
        """Return the point at which the region begins (3,) in {A} [m].

        Raises:
            SettingError: the setting is no point.
        """
        try:
            at = tuple(float(word) for word in self.region.split(","))
        except ValueError:
            at = ()
        if len(at) != 3 or not all(abs(v) < MAX_COORDINATE_M for v in at):
            raise SettingError("region", f"region is '{self.region}', not three numbers x,y,z")
        return at

    def check(self) -> None:
        """Raise ValueError for an invalid initial pose or region, an axis that is not a unit
        vector, or an impossible robot.
        """
        if self.init not in ("log", "truth", "auto"):
            try:
                parse_pose(self.init)
            except ValueError as error:
                raise SettingError("init", str(error)) from None
        if self.region:
            self.region_start()
        if not is_unit(self.fixture_axis_c, 1e-6):
            raise SettingError(
                "fixture_axis_c", f"fixture_axis_c is {self.fixture_axis_c}, must be of unit length"
            )
        check_robot(self.robot, self.plan, self.limits)


PAPER = (
    "estimator.start=paper",
    "estimator.constraint=gain",
    "estimator.noise=r0",
    "estimator.adapt=matrix",
    "estimator.robust=false",
    "estimator.audit_poses=0",
    "faults.policy=all",
    "faults.sigmas=1e-9",
    "convergence.criterion=covariance",
    "task.approach=free",
    "deskew=false",
    "reacquire=false",
)
"""Settings of the method as printed: start, noise adaptation, gain constraint, fault rule and
convergence.
"""


def parse_pose(text: str) -> Pose:
    """Return the pose T_ac that a text states.

    Args:
        text: ``x,y,z,qx,qy,qz,qw``: position of {C} in {A} [m] and quaternion q_ac, of unit length
            within 0.5 %.

    Raises:
        ValueError: the text does not contain seven finite numbers, or the quaternion is not of unit
            length.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 7 or not all(abs(v) < float("inf") for v in values):
        raise ValueError(
            f"init is '{text}', not log, truth, auto or seven numbers x,y,z,qx,qy,qz,qw"
        )
    if abs(sum(v * v for v in values[3:]) - 1.0) > 1e-2:
        raise ValueError(
            f"init is '{text}', its quaternion (last four numbers) is not of unit length"
        )
    return Pose(values[3:], values[:3])  # type: ignore[arg-type]


def with_acceleration(config: RunConfig, acceleration: Sequence[float]) -> RunConfig:
    """Return a configuration with a known acceleration (3,) of the target [m/s2] in {A}.

    Args:
        config: the configuration.
        acceleration: of the centre of mass.
    """
    x, y, z = (float(v) for v in acceleration)
    return replace(config, estimator=replace(config.estimator, acceleration_mps2=(x, y, z)))


def pose_text(pose: Pose) -> str:
    """Return the text that ``parse_pose`` reads as a pose.

    Args:
        pose: the pose T_ac.
    """
    return ",".join(repr(float(v)) for v in (*pose.t, *pose.q))


def load_config(
    file: Path | None,
    log_table: Mapping[str, Any],
    assignments: Sequence[str],
    log_folder: Path | None = None,
) -> RunConfig:
    """Return the effective configuration.

    Args:
        file: TOML file, or None.
        log_table: The log's own ``[run]`` table.
        log_folder: Folder of the log, to which relative paths in its table refer; None: the folder
            of the command.
        assignments: ``a.b=value`` from options.

    Raises:
        UnreadableInput: The file cannot be read.
        UsageError: A key or value is wrong; the message names file and line, or the option.
    """
    of_log = Document("the log's [run] table", log_table)
    build(RunConfig, of_log)
    of_file = load(file) if file else Document("configuration", {})
    build(RunConfig, of_file)
    folders = log_folder or Path(), file.parent if file else Path()
    below, above = (
        with_task_robot(with_robot_path(table, folder), folder)
        for table, folder in zip((log_table, of_file.table), folders, strict=True)
    )
    merged = override(Document(of_file.name, _over(below, above), of_file.text), assignments)
    table = with_task_robot(merged.table, Path())
    return build(RunConfig, replace(merged, table=table))


def with_robot_path(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a table of settings in which the path ``robot.urdf`` refers to the folder of the
    command.

    Args:
        table: Settings, with a table ``robot`` or without.
        folder: Folder of the file that states them, to which a relative path in it refers.
    """
    robot = table.get("robot")
    urdf = robot.get("urdf") if isinstance(robot, Mapping) else None
    if not isinstance(urdf, str):
        return dict(table)
    return {**table, "robot": {**table["robot"], "urdf": str(folder / urdf)}}


@dataclass(frozen=True, slots=True)
class RobotFile(Settings):
    """A file that describes a robot."""

    robot: RobotParams = setting(doc="The robot.")


def robot_settings(file: Path) -> tuple[str, ...]:
    """Return the assignments ``robot.key=value`` that a file states in its table ``[robot]``.

    Args:
        file: TOML file.

    Raises:
        UnreadableInput: The file cannot be read.
        UsageError: A key or value is wrong; the message names file and line.
    """
    document = load(file)
    build(RobotFile, document)
    robot = with_robot_path(document.table, file.parent)["robot"]
    return tuple(f"robot.{key}={toml_value(value)}" for key, value in robot.items())


@dataclass(frozen=True, slots=True)
class TaskFile(Settings):
    """A file that describes a task, and perhaps the robot."""

    task: TaskParams = setting(doc="The task of the capture.")
    robot: RobotParams = setting(RobotParams, "The robot.")


def task_settings(file: Path) -> tuple[str, ...]:
    """Return the assignments that a file states in its tables ``[task]`` and ``[robot]``.

    Args:
        file: TOML file.

    Raises:
        UnreadableInput: The file, or the file of the robot that it names, cannot be read.
        UsageError: A key or value is wrong; the message names file and line.
    """
    document = load(file)
    build(TaskFile, document)
    tables = with_task_robot(with_robot_path(document.table, file.parent), file.parent)
    return tuple(
        f"{table}.{key}={toml_value(value)}"
        for table, values in tables.items()
        for key, value in values.items()
    )


def with_task_robot(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a table of settings with the robot of the file that ``task.robot`` names.

    Args:
        table: Settings; those of its own table ``robot`` take precedence.
        folder: Folder of the file that states them.
    """
    task = table.get("task")
    named = task.get("robot") if isinstance(task, Mapping) else None
    if not isinstance(named, str):
        return dict(table)
    path = folder / named
    build(RobotFile, load(path))
    robot = with_robot_path(load(path).table, path.parent)["robot"]
    own = {key: value for key, value in table["task"].items() if key != "robot"}
    return _over({"robot": robot}, {**table, "task": own})


def check_robot(robot: RobotParams, plan: PlanParams, limits: Limits) -> None:
    """Raise ValueError where the robot does not fit to the other settings of a plan.

    Args:
        robot: the robot.
        plan: parameters of the planner, some of which the robot replaces.
        limits: constraints, some of which the robot replaces.
    """
    try:
        robot.applied(plan)
        robot.limited(limits)
    except ValueError as error:
        raise ValueError(f"with the values of [robot], {error}") from None


def _over(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = (
            _over(below, value)
            if isinstance(below, Mapping) and isinstance(value, Mapping)
            else value
        )
    return merged
