"""The result directory of a run: written scan by scan, complete or not at all; beliefs are read back here.

``rows.jsonl``, ``estimate.tum``, ``registration.tum``, ``truth.tum``, ``beliefs.npz``, ``view.npz`` and ``result.mcap``
depend on the input alone, byte for byte; ``run.json`` also names the versions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import MissingBackend, UnreadableInput, UsageError
from avsreplay.estimate.measurement import measurement_jacobian
from avsreplay.files import check_output, output_folder
from avsreplay.geometry import Array, Pose
from avsreplay.log.result_log import ResultFrame, ResultLog
from avsreplay.numpy_archive import read_npz
from avsreplay.pipeline import PipelineState, planned_segment
from avsreplay.plan.guidance import Segment
from avsreplay.records import Belief, State, Surface
from avsreplay.register import Registrar
from avsreplay.report.export import row_poses, write_layout, write_tum
from avsreplay.report.jsonl import write_rows
from avsreplay.report.result import write_manifest
from avsreplay.report.view import CloudView, PathView, View, thin_cloud, thin_surface, write_view
from avsreplay.rows import Row
from avsreplay.run import Listener, ReplayedScan

PATH_POINTS = 41
_MOST_BELIEF_BYTES, _LARGEST = 1 << 30, 1e15
VIEW_REACH = 0.05  # of the model's extent: residuals in the view are cut off there
_LOGGED_COLUMNS = ("rms_m", "inlier_ratio", "nis", "pos_1s_m", "rot_1s_deg", "ogm_rank", "t_go_s")
_STREAMED_COLUMNS = ("pos_err_m", "rot_err_deg", "rms_m", "nis", "sigma1", "sigma2", "t_go_s", "gamma")
_BLOCKS = (("q_ab", 4), ("w_b", 3), ("r_a", 3), ("v_a", 3), ("sigma", 2), ("c_b", 3), ("q_bc", 4))
MEAN_COLUMNS = tuple(f"{name}[{k}]" for name, size in _BLOCKS for k in range(size))


def mean_vector(x: State) -> Array:
    """Return the mean as one vector (22,) in the order of ``MEAN_COLUMNS``.

    Args:
        x: the mean of a belief.
    """
    return np.concatenate([getattr(x, name) for name, _ in _BLOCKS])


def pose_covariance(belief: Belief) -> Array:
    """Return the (6, 6) covariance of the pose of {C}: position in {A} [m], rotation vector in {A} [rad].

    Args:
        belief: mean and covariance of the estimator.
    """
    H = measurement_jacobian(belief.x)
    to_a = np.zeros((6, 6))
    to_a[:3, :3] = np.eye(3)
    to_a[3:, 3:] = 2.0 * geometry.matrix(belief.x.q_ab)  # half angle in {B} -> full angle in {A}
    return np.asarray(to_a @ H @ belief.P @ H.T @ to_a.T)


def read_beliefs(path: Path) -> list[Belief]:
    """Read ``beliefs.npz`` of a result directory.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file is missing or not as a run writes it.
    """
    shapes = {"t_ns": ("i", (None,)), "x": ("f", (None, len(MEAN_COLUMNS))), "P": ("f", (None, 20, 20))}
    hint = "name a directory written by run -o"
    data = read_npz(path, shapes, limit=_MOST_BELIEF_BYTES, hint=hint)
    ends = np.cumsum([0, *(size for _, size in _BLOCKS)])
    try:
        beliefs = [
            Belief(int(t), State(*(x[a:b] for a, b in pairwise(ends))), P)
            for t, x, P in zip(data["t_ns"], data["x"], data["P"], strict=True)
        ]
    except ValueError:
        raise UnreadableInput("its arrays differ in length", where=str(path), hint=hint) from None
    for k, belief in enumerate(beliefs):
        if defect := _defect(belief):
            raise UnreadableInput(f"the belief after scan {k} {defect}", where=str(path), hint=hint)
    return beliefs


def _defect(belief: Belief) -> str:
    """Return what is wrong with a belief, an empty string if nothing is."""
    x, P = belief.x, belief.P
    numbers = np.concatenate([mean_vector(x), P.ravel()])
    if not (np.isfinite(numbers).all() and np.abs(numbers).max() < _LARGEST):
        return "is not finite"
    if any(abs(np.linalg.norm(q) - 1.0) > 1e-6 for q in (x.q_ab, x.q_bc)):
        return "has a quaternion that is not of unit length"
    if np.abs(x.sigma).max() >= 1.0:
        return "has an inertia ratio that is not below 1"
    if P.diagonal().min() < 0.0:
        return f"has a covariance that is not positive (a variance of {P.diagonal().min():.3g})"
    return "has a covariance that is not symmetric" if np.abs(P - P.T).max() > 1e-9 * np.abs(P).max() else ""


class Beliefs:
    """A listener that keeps the belief after each scan, and the true poses."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.x: list[Array] = []
        self.P: list[Array] = []
        self.truth: list[tuple[int, Pose]] = []

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        belief = scan.outcome.belief
        self.t_ns.append(belief.t_ns)
        self.x.append(mean_vector(belief.x))
        self.P.append(belief.P)
        if scan.truth.pose is not None:
            self.truth.append((scan.row.t_ns, scan.truth.pose))

    def write(self, path: Path) -> None:
        """Write ``beliefs.npz``: t_ns (n,), x (n, 22), P (n, 20, 20)."""
        np.savez(path, t_ns=np.array(self.t_ns, np.int64), x=np.array(self.x), P=np.array(self.P))


class _NewPaths:
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

    def __init__(self, path: Path, surface: Surface) -> None:
        self._log, self._paths = ResultLog(path, surface), _NewPaths()

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
                covariance=pose_covariance(outcome.belief),
                registration=next((pose for _, pose in row_poses([row], "registration")), None),
                truth=scan.truth.pose,
                path=self._paths.of(scan.state),
                healthy=row.gamma == 1,
                message=row.reason,
                values=values,
            )
        )


class ViewWriter:
    """A listener that keeps a thinned model, thinned clouds and planned paths for the report page."""

    def __init__(self, surface: Surface, registrar: Registrar) -> None:
        self._surface, self._registrar, self._paths = surface, registrar, _NewPaths()
        self._clouds: list[CloudView] = []
        self._plans: list[PathView] = []

    def __call__(self, scan: ReplayedScan) -> None:
        """Take one scan of a run."""
        thin = thin_cloud(scan.outcome.scan.seq, scan.outcome.scan.points)
        self._clouds.append(CloudView(thin.seq, thin.points, self._residual(thin.points, scan.outcome.pose)))
        path = self._paths.of(scan.state)
        if path is not None:
            self._plans.append(PathView(scan.row.t_ns, np.asarray(path[1], np.float32), scan.row.plan_miss_m))

    def _residual(self, points: NDArray[np.float32], T_ac: Pose) -> NDArray[np.float32]:
        """Distance (n,) [m] of points (n, 3) in {A} to the model at the estimated pose."""
        return self._registrar.distance(points, T_ac, VIEW_REACH * self._surface.extent).astype(np.float32)

    def view(self) -> View:
        """Return everything kept so far."""
        vertices, faces = thin_surface(self._surface)
        return View(vertices, faces, tuple(self._clouds), tuple(self._plans))


class ResultDirectory:
    """The folder of a result; it appears when the ``with`` block ends without an error, and not otherwise."""

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        """Check that the folder can be written.

        Args:
            path: the folder.
            overwrite: whether an existing result may be replaced.

        Raises:
            UsageError: the folder exists, is not a result, or its name cannot be used.
        """
        self.path, self._stack = path, ExitStack()
        check_output(path, folder=True)
        if path.exists() and not overwrite and any(path.iterdir()):
            raise UsageError("already exists", where=str(path), hint="choose another name, or add --overwrite")
        if path.exists() and not _replaceable(path):
            raise UsageError("is not a result directory", where=str(path), hint="name another; it is left alone")

    def __enter__(self) -> ResultDirectory:
        self._part = self._stack.enter_context(output_folder(self.path))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, traceback)

    def write(self, rows: Sequence[Row], beliefs: Beliefs) -> None:
        """Write rows, trajectories and beliefs.

        Args:
            rows: one per scan.
            beliefs: collected during the run.
        """
        write_rows(self._part / "rows.jsonl", rows)
        write_tum(self._part / "estimate.tum", row_poses(rows, "estimate"))
        write_tum(self._part / "registration.tum", row_poses(rows, "registration"))
        if beliefs.truth:
            write_tum(self._part / "truth.tum", beliefs.truth)
        beliefs.write(self._part / "beliefs.npz")

    def file(self, name: str) -> Path:
        """Return where a further file of the result is to be written, inside the ``with`` block."""
        return self._part / name


def _replaceable(path: Path) -> bool:
    return path.is_dir() and ((path / "rows.jsonl").is_file() or not any(path.iterdir()))


class ResultWriter:
    """Writes everything a run leaves in a result directory; a context manager around the replay.

    The directory appears when the block ends without an error, after ``finish``, and not otherwise.
    """

    def __init__(self, directory: ResultDirectory, surface: Surface, registrar: Registrar) -> None:
        self._directory, self._surface = directory, surface
        self._beliefs, self._view = Beliefs(), ViewWriter(surface, registrar)

    def __enter__(self) -> ResultWriter:
        self._directory.__enter__()
        self._log = ResultLogWriter(self._directory.file("result.mcap"), self._surface)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with suppress(OSError):  # reported by ``finish``; after an error the folder is removed
            self._log.close()
        self._directory.__exit__(kind, error, traceback)

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """The listeners that must take every scan."""
        return self._beliefs, self._view, self._log

    def finish(self, rows: Sequence[Row], record: Mapping[str, Any]) -> None:
        """Write what needs the whole run.

        Args:
            rows: one per scan.
            record: content of ``run.json``.
        """
        self._log.close()
        self._directory.write(rows, self._beliefs)
        write_view(self._directory.file("view.npz"), self._view.view())
        write_layout(self._directory.file("result.layout.json"))
        write_manifest(self._directory.file("run.json").parent, record, len(rows))


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
