"""Listeners that show a run in viewers: ``result.mcap`` for Foxglove, Lichtblick and rosbags,
and Rerun.
"""

from __future__ import annotations

import json
import math
import os
import socket
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import __version__, geometry
from avsreplay.errors import MissingBackend, UsageError
from avsreplay.files import check_output
from avsreplay.geometry import Array, Pose
from avsreplay.log.result_log import ResultFrame, ResultLog
from avsreplay.outcome import Outcome
from avsreplay.pipeline import PipelineState, planned_segment
from avsreplay.plan.guidance import Segment
from avsreplay.report.export import row_poses
from avsreplay.report.view import CloudView, cone_lines, thin_cloud
from avsreplay.rows import Row
from avsreplay.run import ReplayedScan, Run
from avsreplay.settings import dump

PATH_POINTS = 41
# most points of a scan that a viewer gets; the log of the scans has all of them
MAX_SHOWN_POINTS = 2000
MAX_RESIDUAL_OF_EXTENT = 0.05  # largest residual that is shown, over the model's extent
_LOGGED_COLUMNS = ("rms_m", "inlier_ratio", "nis", "pos_1s_m", "rot_1s_deg", "ogm_rank", "t_go_s")
_ROW_POSE_COLUMNS = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_IN_MESSAGES = {
    "seq",
    "t_ns",
    *_ROW_POSE_COLUMNS,
    *(f"reg_{name}" for name in _ROW_POSE_COLUMNS),
}  # what other messages hold
_NUMBER_TYPES = ("float", "int", "bool")  # types of columns, as declared, without "| None"
_NUMBER_COLUMNS = tuple(
    f.name
    for f in fields(Row)
    if str(f.type).split()[0] in _NUMBER_TYPES and f.name not in _IN_MESSAGES
)
_NUMBER_VALUES = attrgetter(*_NUMBER_COLUMNS)
RERUN_PORT = 9876  # port of a Rerun viewer


def message_covariance(outcome: Outcome) -> Array:
    """Return the (6, 6) covariance of the pose of {C}: position in {A} [m], rotation vector in {A}
    [rad].

    Args:
        outcome: result of a scan, with the covariance of its pose in metres and half angles in {B}.
    """
    to_a = np.eye(6)
    to_a[3:, 3:] = 2.0 * geometry.matrix(
        outcome.belief.x.q_ab
    )  # half angle in {B} -> full angle in {A}
    return np.asarray(to_a @ outcome.pose_covariance @ to_a.T)


def shown_cloud(run: Run, scan: ReplayedScan) -> CloudView:
    """Return at most 2000 points of a scan with their distances to the model at the estimate.

    The points have an even stride in their order, and the distances are at most 5 % of the model's
    extent.

    Args:
        run: the open run.
        scan: one of its scans.
    """
    source, pose = scan.outcome.scan, scan.outcome.pose
    cloud = thin_cloud(source.seq, source.points, None, source.intensities, most=MAX_SHOWN_POINTS)
    distances = run.registrar.distance(
        cloud.points, pose, MAX_RESIDUAL_OF_EXTENT * run.registrar.index.extent_m
    )
    return CloudView(cloud.seq, cloud.points, np.asarray(distances, np.float32), cloud.intensity)


class NewPaths:
    """Samples the flight of each capture plan once, at the scan at which it was made."""

    def __init__(self) -> None:
        self._known: Segment | None = None

    def of(self, state: PipelineState) -> tuple[Array, Array] | None:
        """Times (n,) [s] and positions (n, 3) [m] of a flight not seen before, None where there is
        none.

        Args:
            state: the state after a scan.
        """
        segment = planned_segment(state)
        if segment is None or segment is self._known or segment.path is None:
            return None
        self._known = segment
        times = np.linspace(0.0, segment.path.t_go_s, PATH_POINTS)
        return times, segment.path.at(times)[0]


class ResultLogWriter:
    """Writes each scan's outcome to ``result.mcap``; ``close`` completes the file."""

    def __init__(self, path: Path, run: Run) -> None:
        settings = dump(run.config)
        del settings["register"]["threads"]  # the file is the same for any number of threads
        facts = {"configuration": json.dumps(settings, sort_keys=True), "version": __version__}
        self._log = ResultLog(path, run.surface, facts, approach_cones(run), _NUMBER_COLUMNS)

    def take_over(self, written: Path, rows: Sequence[Row], changed: Iterable[int] = ()) -> None:
        """Take over the messages of an earlier log of the same run, with the columns of the rows
        that have changed.

        Args:
            written: the earlier log.
            rows: the rows so far.
            changed: numbers of the rows that have changed.
        """
        self._log.copy(written, rows[-1].reason, {k: _numbers(rows[k]) for k in changed})

    def close(self) -> None:
        """Complete the file."""
        self._log.close()

    def take(self, scan: ReplayedScan, cloud: CloudView, path: tuple[Array, Array] | None) -> None:
        """Take one scan: the points that are shown; times and positions of a new flight, if any.

        Args:
            scan: the scan with its row.
            cloud: the points of the scan that are shown, with their residuals.
            path: times (n,) [s] and positions (n, 3) in {A} [m] of a new flight; None where there
                is none.
        """
        row, outcome = scan.row, scan.outcome
        values = {
            name: value for name in _LOGGED_COLUMNS if (value := getattr(row, name)) is not None
        }
        self._log.write(
            ResultFrame(
                t_ns=row.t_ns,
                points=cloud.points,
                estimate=outcome.pose,
                covariance=message_covariance(outcome),
                registration=next((pose for _, pose in row_poses([row], "registration")), None),
                truth=scan.truth.pose,
                path=path,
                healthy=row.gamma == 1,
                message=row.reason,
                values=values,
                residuals=cloud.residual_m,
                intensities=cloud.intensity,
                columns=_numbers(row),
            )
        )


def _numbers(row: Row) -> list[float]:
    """The numeric columns of a row; NaN without a value."""
    return [math.nan if value is None else value for value in _NUMBER_VALUES(row)]


def approach_cones(run: Run) -> Array | None:
    """Return the ends (m, 3) of line pieces in {C} [m] that outline the cones of the approach; None
    without a cone.

    Args:
        run: its configuration gives angles, lengths and the axis of the fixture.
    """
    limits, axis = run.approach, run.task.axis_c
    pieces = [cone_lines(axis, *cone, limits.mouth_m or 0.0) for cone in limits.cones]
    return np.concatenate(pieces) + run.task.grasp_c if pieces else None


class RerunStream:
    """A listener that shows a run in a Rerun viewer, or writes it to a file for one (extra
    ``rerun``).
    """

    def __init__(self, run: Run, target: str) -> None:
        """Open the viewer or the file, and send what does not change.

        Args:
            run: the run that is shown.
            target: "view" starts a viewer, "connect" uses one that runs on this computer; else an
                .rrd file to write.

        Raises:
            MissingBackend: rerun-sdk is not installed.
            UsageError: there is no display, no viewer to connect to, or the file has another
                suffix.
        """
        _check_target(target)
        try:
            import rerun
        except ModuleNotFoundError:
            hint = "install it with: pip install 'avsreplay[rerun]'"
            raise MissingBackend("rerun-sdk is not installed", where="--rerun", hint=hint) from None
        self._rr: Any = rerun
        self._run, self._paths = run, NewPaths()
        rerun.init("avsreplay", spawn=target == "view")
        if target == "connect":
            rerun.connect_grpc()
        elif target != "view":
            rerun.save(target)
        surface = run.surface
        model = (
            rerun.Mesh3D(vertex_positions=surface.vertices, triangle_indices=surface.faces)
            if len(surface.faces)
            else rerun.Points3D(surface.vertices)
        )
        for name in ("estimate", "truth"):
            rerun.log(f"camera/{name}/model", model, static=True)
        cones = approach_cones(run)
        if cones is not None:
            rerun.log(
                "camera/estimate/cone", rerun.LineStrips3D(cones.reshape(-1, 2, 3)), static=True
            )

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        rr, row, outcome = self._rr, scan.row, scan.outcome
        rr.set_time("log", timestamp=np.datetime64(row.t_ns, "ns"))
        cloud = shown_cloud(self._run, scan)
        share = np.asarray(cloud.residual_m) / (
            MAX_RESIDUAL_OF_EXTENT * self._run.registrar.index.extent_m
        )
        rr.log("camera/scan", rr.Points3D(cloud.points, colors=_colours(share)))
        self._place("camera/estimate", outcome.pose)
        if scan.truth.pose is not None:
            self._place("camera/truth", scan.truth.pose)
        self._ellipsoid(outcome)
        path = self._paths.of(scan.state)
        if path is not None:
            rr.log("camera/plan", rr.LineStrips3D([path[1]]))
        self._show(row)
        if row.gamma == 0:
            rr.log("rows/reason", rr.TextLog(row.reason))

    def correct(self, rows: Sequence[Row], changed: Iterable[int]) -> None:
        """Send the columns of rows again that had other values when their scans were shown.

        Args:
            rows: the rows so far.
            changed: numbers of the rows that have changed.
        """
        for row in (rows[k] for k in changed):
            self._rr.set_time("log", timestamp=np.datetime64(row.t_ns, "ns"))
            self._show(row)

    def close(self) -> None:
        """Send what is still buffered."""
        self._rr.disconnect()

    def _show(self, row: Row) -> None:
        """Send the numeric columns of a row that have a value."""
        for name, value in zip(_NUMBER_COLUMNS, _NUMBER_VALUES(row), strict=True):
            if value is not None:
                self._rr.log(f"rows/{name}", self._rr.Scalars(float(value)))

    def _place(self, path: str, pose: Pose) -> None:
        self._rr.log(path, self._rr.Transform3D(translation=pose.t, quaternion=pose.q))

    def _ellipsoid(self, outcome: Outcome) -> None:
        """The 3 sigma ellipsoid of the position of {C}."""
        variances, axes = np.linalg.eigh(outcome.pose_covariance[:3, :3])
        axes[:, 0] *= np.linalg.det(axes)  # a rotation
        sizes = 3.0 * np.sqrt(np.maximum(variances, 0.0))
        q = geometry.quaternion(axes)
        shape = self._rr.Ellipsoids3D(half_sizes=[sizes], centers=[outcome.pose.t], quaternions=[q])
        self._rr.log("camera/position_3_sigma", shape)


def _colours(share: Array) -> Array:
    """Colours (n, 3) from blue (on the model) to yellow (far from it); ``share`` (n,) is 0 to 1."""
    near, far = np.array([0.0, 114.0, 178.0]), np.array([240.0, 228.0, 66.0])
    return np.asarray(
        near + np.clip(np.nan_to_num(share, nan=1.0), 0.0, 1.0)[:, None] * (far - near), np.uint8
    )


def _check_target(target: str) -> None:
    """Raise UsageError where nothing can be shown."""
    if target == "view":
        if sys.platform.startswith("linux") and not (
            os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        ):
            hint = "write a file with --rerun FILE.rrd, or start 'rerun' and use --rerun connect"
            raise UsageError("there is no display", where="--rerun view", hint=hint)
    elif target == "connect":
        try:
            socket.create_connection(("127.0.0.1", RERUN_PORT), 1.0).close()
        except OSError:
            what = f"no viewer listens on port {RERUN_PORT} of this computer"
            raise UsageError(
                what, where="--rerun connect", hint="start one with the command 'rerun'"
            ) from None
    elif not target.endswith(".rrd"):
        raise UsageError(
            "neither view, connect nor a file .rrd",
            where=f"--rerun {target}",
            hint="name a file .rrd",
        )
    else:
        check_output(Path(target))
