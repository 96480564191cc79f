"""Listeners that keep what pictures need: the result log for viewers, the thinned view for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.chain import Memory
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.geometry import Array, Pose
from avsreplay.job import Listener
from avsreplay.log.result_log import ResultFrame, ResultLog
from avsreplay.plan.guidance import Segment
from avsreplay.records import Belief, Scan, Surface
from avsreplay.register import Registrar
from avsreplay.report import CloudView, PathView, View, row_poses, thin_cloud, thin_surface, write_layout, write_view
from avsreplay.results import Beliefs, ResultDirectory, belief_of
from avsreplay.rows import Row

__all__ = ["LogKeeper", "ResultKeeper", "ViewKeeper", "pose_covariance"]

PATH_POINTS = 41
VIEW_REACH = 0.05  # of the model's extent: points farther off all look alike
_VALUES = ("rms_m", "inlier_ratio", "nis", "pos_1s_m", "rot_1s_deg", "ogm_rank", "t_go_s")


def pose_covariance(belief: Belief) -> Array:
    """(6, 6) of the fixture's (position in {A} [m], rotation vector in {A} [rad])."""
    H = measurement_jacobian(belief.x)
    to_a = np.zeros((6, 6))
    to_a[:3, :3] = np.eye(3)
    to_a[3:, 3:] = 2.0 * geometry.matrix(belief.x.q_ab)  # half angle in {B} -> full angle in {A}
    return np.asarray(to_a @ H @ belief.P @ H.T @ to_a.T)


class _Paths:
    """Tells a new plan from the one before and samples it."""

    def __init__(self) -> None:
        self._known: Segment | None = None

    def new(self, memory: Memory) -> tuple[Array, Array] | None:
        """(times (n,), positions (n, 3)) of a plan not seen before."""
        leg = memory.aim.leg
        if leg is None or leg is self._known or leg.path is None:
            return None
        self._known = leg
        times = np.linspace(0.0, leg.path.t_go_s, PATH_POINTS)
        return times, leg.path.at(times)[0]


class LogKeeper:
    """Writes each scan's outcome to ``result.mcap``; ``close`` finishes the file."""

    def __init__(self, path: Path, surface: Surface) -> None:
        self._log, self._paths = ResultLog(path, surface), _Paths()

    def close(self) -> None:
        """Finish the file."""
        self._log.close()

    def __call__(self, scan: Scan, memory: Memory, row: Row) -> None:
        """Take one scan."""
        belief = belief_of(memory)
        values = {name: value for name in _VALUES if (value := getattr(row, name)) is not None}
        self._log.write(
            ResultFrame(
                t_ns=row.t_ns,
                points=scan.points,
                estimate=belief.x.T_ac,
                covariance=pose_covariance(belief),
                registration=next((pose for _, pose in row_poses([row], "registration")), None),
                truth=scan.truth,
                path=self._paths.new(memory),
                healthy=row.gamma == 1,
                message=row.reason,
                values=values,
            )
        )


class ViewKeeper:
    """Keeps a thinned model, thinned clouds and planned paths for the page."""

    def __init__(self, surface: Surface, registrar: Registrar) -> None:
        self._surface, self._registrar, self._paths = surface, registrar, _Paths()
        self._clouds: list[CloudView] = []
        self._plans: list[PathView] = []

    def __call__(self, scan: Scan, memory: Memory, row: Row) -> None:
        """Take one scan."""
        thin = thin_cloud(scan.seq, scan.points)
        self._clouds.append(CloudView(thin.seq, thin.points, self._residual(thin.points, belief_of(memory).x.T_ac)))
        path = self._paths.new(memory)
        if path is not None:
            self._plans.append(PathView(row.t_ns, np.asarray(path[1], np.float32), row.hindsight_m))

    def _residual(self, points: NDArray[np.float32], T_ac: Pose) -> NDArray[np.float32]:
        """Distance (n,) [m] of points (n, 3) in {A} to the model at the estimated pose."""
        return self._registrar.distance(points, T_ac, VIEW_REACH * self._surface.extent).astype(np.float32)

    def view(self) -> View:
        """Everything kept so far."""
        vertices, faces = thin_surface(self._surface)
        return View(vertices, faces, tuple(self._clouds), tuple(self._plans))


class ResultKeeper:
    """Everything a run leaves in a result directory; a context manager around the replay.

    The directory appears when the block ends well, after ``finish``, and not otherwise.
    """

    def __init__(self, directory: ResultDirectory, surface: Surface, registrar: Registrar) -> None:
        self._directory, self._surface = directory, surface
        self._beliefs, self._view = Beliefs(), ViewKeeper(surface, registrar)

    def __enter__(self) -> ResultKeeper:
        self._directory.__enter__()
        self._log = LogKeeper(self._directory.file("result.mcap"), self._surface)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._log.close()
        self._directory.__exit__(kind, error, traceback)

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """What must hear every scan."""
        return self._beliefs, self._view, self._log

    def finish(self, rows: Sequence[Row], record: Mapping[str, Any]) -> None:
        """Write what needs the whole run; ``record`` is ``run.json``."""
        self._directory.write(rows, self._beliefs, record)
        write_view(self._directory.file("view.npz"), self._view.view())
        write_layout(self._directory.file("result.layout.json"))
