"""Listeners that show a run in viewers: ``result.mcap`` for Foxglove, Lichtblick and rosbags, and Rerun."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import geometry
from avsreplay.errors import MissingBackend
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.geometry import Array, Pose
from avsreplay.log.result_log import ResultFrame, ResultLog
from avsreplay.pipeline import PipelineState, planned_segment
from avsreplay.plan.guidance import Segment
from avsreplay.records import Belief, Surface
from avsreplay.report.export import row_poses
from avsreplay.rows import Row, columns
from avsreplay.run import ReplayedScan, Run
from avsreplay.settings import dump

PATH_POINTS = 41
RESIDUAL_REACH = 0.05  # of the model's extent: larger residuals in the viewer log are cut to this
_LOGGED_COLUMNS = ("rms_m", "inlier_ratio", "nis", "pos_1s_m", "rot_1s_deg", "ogm_rank", "t_go_s")
_COLUMNS = tuple(column.name for column in columns())
_STREAMED_COLUMNS = ("pos_err_m", "rot_err_deg", "rms_m", "nis", "sigma1", "sigma2", "t_go_s", "gamma")


def message_covariance(belief: Belief) -> Array:
    """Return the (6, 6) covariance of the pose of {C}: position in {A} [m], rotation vector in {A} [rad].

    Args:
        belief: mean and covariance of the estimator.
    """
    H = measurement_jacobian(belief.x)
    to_a = np.zeros((6, 6))
    to_a[:3, :3] = np.eye(3)
    to_a[3:, 3:] = 2.0 * geometry.matrix(belief.x.q_ab)  # half angle in {B} -> full angle in {A}
    return np.asarray(to_a @ H @ belief.P @ H.T @ to_a.T)


class NewPaths:
    """Samples the flight of each capture plan once, at the scan at which it was made."""

    def __init__(self) -> None:
        self._known: Segment | None = None

    def of(self, state: PipelineState) -> tuple[Array, Array] | None:
        """Times (n,) [s] and positions (n, 3) [m] of a flight not seen before, None where there is none."""
        segment = planned_segment(state)
        if segment is None or segment is self._known or segment.path is None:
            return None
        self._known = segment
        times = np.linspace(0.0, segment.path.t_go_s, PATH_POINTS)
        return times, segment.path.at(times)[0]


class ResultLogWriter:
    """A listener that writes each scan's outcome to ``result.mcap``; ``close`` completes the file."""

    def __init__(self, path: Path, run: Run) -> None:
        settings = dump(run.config)
        del settings["register"]["threads"]  # the file is the same for any number of threads
        configuration = json.dumps(settings, sort_keys=True)
        self._log, self.paths = ResultLog(path, run.surface, configuration), NewPaths()
        self._registrar, self._reach_m = run.registrar, RESIDUAL_REACH * run.surface.extent

    def resume(self, written: Path, paths: NewPaths, last: Row) -> None:
        """Take over the messages of the log of an interrupted run, the plans that it has seen and its last row."""
        self._log.copy(written, last.reason)
        self.paths = paths

    def close(self) -> None:
        """Complete the file."""
        self._log.close()

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        row, outcome = scan.row, scan.outcome
        values = {name: value for name in _LOGGED_COLUMNS if (value := getattr(row, name)) is not None}
        self._log.write(
            ResultFrame(
                t_ns=row.t_ns,
                points=outcome.scan.points,
                estimate=outcome.pose,
                covariance=message_covariance(outcome.belief),
                registration=next((pose for _, pose in row_poses([row], "registration")), None),
                truth=scan.truth.pose,
                path=self.paths.of(scan.state),
                healthy=row.gamma == 1,
                message=row.reason,
                values=values,
                residuals=self._registrar.distance(outcome.scan.points, outcome.pose, self._reach_m),
                columns=_numbers(row),
            )
        )


def _numbers(row: Row) -> dict[str, float]:
    """The numeric columns of a row that have a value."""
    found = ((name, getattr(row, name)) for name in _COLUMNS)
    return {name: float(value) for name, value in found if isinstance(value, (int, float))}


class RerunStream:
    """A listener that sends model, cloud, poses and scalars to a Rerun viewer (extra ``rerun``)."""

    def __init__(self, surface: Surface, file: Path | None = None) -> None:
        """Start the viewer or open the file, and send the model.

        Args:
            surface: model of the target.
            file: .rrd file to write instead of opening a viewer.

        Raises:
            MissingBackend: rerun-sdk is not installed.
        """
        try:
            import rerun
        except ModuleNotFoundError:
            hint = "install avsreplay[rerun]"
            raise MissingBackend("rerun-sdk is not installed", where="--rerun", hint=hint) from None
        self._rr: Any = rerun
        rerun.init("avsreplay", spawn=file is None)
        if file is not None:
            rerun.save(str(file))
        model = (
            rerun.Mesh3D(vertex_positions=surface.vertices, triangle_indices=surface.faces)
            if len(surface.faces)
            else rerun.Points3D(surface.vertices)
        )
        for name in ("estimate", "truth"):
            rerun.log(f"camera/{name}/model", model, static=True)

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        rr, row = self._rr, scan.row
        rr.set_time("log", timestamp=np.datetime64(row.t_ns, "ns"))
        rr.log("camera/scan", rr.Points3D(np.array(scan.outcome.scan.points, np.float32, order="C")))
        self._place("camera/estimate", scan.outcome.pose)
        if scan.truth.pose is not None:
            self._place("camera/truth", scan.truth.pose)
        for name in _STREAMED_COLUMNS:
            value = getattr(row, name)
            if value is not None:
                rr.log(f"rows/{name}", rr.Scalars(float(value)))
        if row.gamma == 0:
            rr.log("rows/reason", rr.TextLog(row.reason))

    def close(self) -> None:
        """Send what is still buffered."""
        self._rr.disconnect()

    def _place(self, path: str, pose: Pose) -> None:
        self._rr.log(path, self._rr.Transform3D(translation=pose.t, quaternion=pose.q))
