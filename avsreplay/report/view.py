"""Data for the 3D view of a page, kept in ``view.npz``: a thinned model, thinned clouds and planned
paths.

Thinning is deterministic: clouds keep points at an even stride, the vertices of the model are
merged on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay import geometry
from avsreplay.binary_files import read_npz
from avsreplay.errors import UnreadableInput, value_class
from avsreplay.files import output_path
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.report.charts import pack
from avsreplay.rows import Row
from avsreplay.spool import LARGEST_STORED, Spool, SpoolFile, write_npz
from avsreplay.tables import column_of, numbers

MAX_CLOUD_POINTS = 300
MAX_FACES = 4000
_MAX_VIEW_BYTES = 1 << 30
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    **dict.fromkeys(("vertices", "cloud_points", "path_points"), ("f4", (3,))),
    **dict.fromkeys(("cloud_seq", "cloud_size", "path_t_ns", "path_size"), ("i8", ())),
    **dict.fromkeys(("cloud_residual", "cloud_intensity"), ("f4", ())),
    "path_miss": ("f8", ()),
    "faces": ("i4", (3,)),
}

_CLOUDS = ("cloud_seq", "cloud_size", "cloud_points", "cloud_residual", "cloud_intensity")

Floats = NDArray[np.float32]
Faces = NDArray[np.int32]


@value_class
class CloudView:
    """Some points of scan ``seq``: positions (n, 3) in {A} [m], distances to the model (n,) [m],
    and intensities (n,) or None.
    """

    seq: int
    points: Floats
    residual_m: Floats | None = None
    intensity: Floats | None = None


class CloudTable(Sequence[CloudView]):
    """A sequence of clouds, of which only the last ones are in memory."""

    def __init__(self, clouds: Iterable[CloudView] = (), arrays: Mapping[str, Spool] | None = None):
        """Take clouds.

        Args:
            clouds: the first ones.
            arrays: those of an earlier table in place of empty ones: cloud_seq, cloud_size,
                cloud_points, cloud_residual and cloud_intensity.
        """
        file = SpoolFile()
        self._arrays = arrays or {name: Spool(*_ARRAYS[name], file) for name in _CLOUDS}
        self._ends: list[NDArray[np.int64]] = []  # place after the points of each cloud, if known
        for cloud in clouds:
            self.append(cloud)

    @property
    def arrays(self) -> Mapping[str, Spool]:
        """The arrays of the table by name."""
        return self._arrays

    def append(self, cloud: CloudView) -> None:
        """Append a cloud; a value that its points do not have is NaN.

        Args:
            cloud: the cloud.
        """
        count, parts = len(cloud.points), self._arrays
        parts["cloud_seq"].append(cloud.seq)
        parts["cloud_size"].append(count)
        parts["cloud_points"].extend(cloud.points)
        for name, known in (("residual", cloud.residual_m), ("intensity", cloud.intensity)):
            values = np.full(count, np.nan, np.float32) if known is None else known
            parts[f"cloud_{name}"].extend(values)
        self._ends = []

    def __len__(self) -> int:
        return len(self._arrays["cloud_seq"])

    @overload
    def __getitem__(self, place: int) -> CloudView: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[CloudView]: ...
    def __getitem__(self, place: int | slice) -> CloudView | Sequence[CloudView]:
        """Return a cloud, or a list of some."""
        if isinstance(place, slice):
            return [self[k] for k in range(*place.indices(len(self)))]
        sizes = self._arrays["cloud_size"]
        size = int(sizes[place])
        if not self._ends:
            self._ends = [np.cumsum(sizes.read(0, len(sizes)))]
        end = int(self._ends[0][place])
        points, residual, seen = (
            self._arrays[f"cloud_{name}"].read(end - size, end)
            for name in ("points", "residual", "intensity")
        )
        return CloudView(
            int(self._arrays["cloud_seq"][place]),
            points,
            None if np.isnan(residual).any() or not size else residual,
            None if np.isnan(seen).all() else seen,
        )


@value_class
class PathView:
    """A planned path: time of planning, (n, 3) positions in {A} [m], distance to the true
    grasp point [m].
    """

    t_ns: int
    points: Floats
    miss_m: float | None = None


@value_class
class View:
    """What the 3D view shows: the model with vertices (n, 3) in {C} [m] and faces (m, 3), possibly
    none, the clouds, and the planned paths.
    """

    vertices: Floats
    faces: Faces
    clouds: Sequence[CloudView] = ()
    paths: Sequence[PathView] = ()


def thin_cloud(
    seq: int,
    points: ArrayLike,
    residual_m: ArrayLike | None = None,
    intensity: ArrayLike | None = None,
    *,
    most: int = MAX_CLOUD_POINTS,
) -> CloudView:
    """Thin a cloud to an even stride of its points.

    Args:
        seq: number of the scan.
        points: (n, 3) in {A} [m].
        residual_m: (n,) distances to the model [m].
        intensity: (n,) or None.
        most: largest number of points that are kept.
    """
    points = np.asarray(points)
    count = min(most, len(points))
    chosen = np.arange(count) * (len(points) - 1) // max(count - 1, 1)
    residual, seen = (
        None if of_point is None else np.asarray(of_point, dtype=np.float32)[chosen]
        for of_point in (residual_m, intensity)
    )
    return CloudView(seq, np.asarray(points[chosen], dtype=np.float32), residual, seen)


def thin_surface(surface: Surface, *, most: int = MAX_FACES) -> tuple[Floats, Faces]:
    """Thin a model to at most ``most`` faces (vertices, for a model without faces): vertices are
    merged on a grid that is made coarser until this holds.

    Args:
        surface: the model of the target.
        most: largest number of faces or vertices.
    """
    vertices, faces = surface.vertices, surface.faces
    size = surface.extent / 256.0 or 1.0
    while max(len(faces), 0 if len(faces) else len(vertices)) > most:
        vertices, faces = _clustered(surface.vertices, surface.faces, size)
        size *= 1.25
    return np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.int32)


def _clustered(vertices: Array, faces: Faces, size: float) -> tuple[Array, Faces]:
    """Replace the vertices of each grid cell by their mean; collapsed and duplicate faces are
    removed.
    """
    cells = np.floor((vertices - vertices.min(axis=0)) / size).astype(np.int64)
    member = np.unique(_numbers(cells), return_inverse=True)[1]
    counts = np.bincount(member)
    merged = np.stack(
        [np.bincount(member, weights=vertices[:, k]) / counts for k in range(3)], axis=1
    )
    mapped = member[faces]
    whole = (
        (mapped[:, 0] != mapped[:, 1])
        & (mapped[:, 1] != mapped[:, 2])
        & (mapped[:, 2] != mapped[:, 0])
    )
    mapped = mapped[whole]
    first = np.unique(_numbers(np.sort(mapped, axis=1)), return_index=True)[1]
    return merged, mapped[np.sort(first)].astype(np.int32)


def _numbers(triples: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers (n,) in the order of triples (n, 3) of integers from 0; equal triples have the
    same number.
    """
    first, second, third = triples.T
    pairs = np.unique(first * (second.max(initial=0) + 1) + second, return_inverse=True)[1]
    return np.asarray(pairs * (third.max(initial=0) + 1) + third)


def write_view(path: str | Path, view: View) -> None:
    """Write one npz file atomically; the same view gives the same bytes.

    Args:
        path: the file.
        view: the model, clouds and paths.
    """
    clouds = view.clouds if isinstance(view.clouds, CloudTable) else CloudTable(view.clouds)
    misses = [np.nan if p.miss_m is None else p.miss_m for p in view.paths]
    arrays: dict[str, NDArray[Any] | Spool] = {
        "vertices": view.vertices,
        "faces": view.faces,
        **{name: clouds.arrays[name] for name in _CLOUDS},
        "path_t_ns": np.array([p.t_ns for p in view.paths], dtype=np.int64),
        "path_size": np.array([len(p.points) for p in view.paths], dtype=np.int64),
        "path_points": _joined([p.points for p in view.paths]),
        "path_miss": np.array(misses, dtype=np.float64),
    }
    with output_path(path) as part:
        write_npz(part, arrays)


def _joined(parts: Sequence[Floats]) -> Floats:
    return np.concatenate([np.zeros((0, 3), np.float32), *parts]).astype(np.float32, copy=False)


def _each_point(parts: Sequence[tuple[CloudView, Floats | None]]) -> Floats:
    """A value of each point of all clouds, NaN where a cloud has none."""
    filled = [
        np.full(len(cloud.points), np.nan, np.float32) if known is None else known
        for cloud, known in parts
    ]
    return np.concatenate([np.zeros(0, np.float32), *filled]).astype(np.float32, copy=False)


def read_view(path: str | Path) -> View:
    """Read a view.

    Args:
        path: the file.

    Raises:
        UnreadableInput: the file is missing or is not a view.
    """
    path, hint = Path(path), "run again with -o"
    arrays = read_npz(
        path, _ARRAYS, limit=_MAX_VIEW_BYTES, hint=hint, optional=("cloud_intensity",)
    )
    try:
        return _view(arrays)
    except ValueError as error:
        raise UnreadableInput(f"not a view file: {error}", where=str(path), hint=hint) from None


def _view(arrays: dict[str, Spool]) -> View:
    """The view that arrays hold. Raises ValueError where they do not fit to one another."""
    if "cloud_intensity" not in arrays:  # earlier versions
        arrays["cloud_intensity"] = Spool("f4")
        for block in arrays["cloud_residual"].blocks():
            arrays["cloud_intensity"].extend(np.full(len(block), np.nan, np.float32))
    _check_arrays(arrays)
    whole = {
        name: each.read(0, len(each))
        for name, each in arrays.items()
        if not name.startswith("cloud_")
    }
    vertices, faces = whole["vertices"], whole["faces"]
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError("faces refer to vertices that do not exist")
    lines = np.split(whole["path_points"], np.cumsum(whole["path_size"])[:-1])
    paths = tuple(
        PathView(int(t), p, None if np.isnan(miss) else float(miss))
        for t, p, miss in zip(
            whole["path_t_ns"],
            lines if len(whole["path_size"]) else (),
            whole["path_miss"],
            strict=True,
        )
    )
    clouds = {name: arrays[name] for name in _CLOUDS}
    return View(vertices, faces, CloudTable((), clouds), paths)


def _check_arrays(arrays: Mapping[str, Spool]) -> None:
    """Raise ValueError where points are not finite, or sizes are not those of the parts."""
    for name in ("vertices", "cloud_points", "path_points"):
        if not all((np.abs(block) < LARGEST_STORED).all() for block in arrays[name].blocks()):
            raise ValueError("points that are not finite or too far away")
    values = ("cloud_points", "cloud_residual", "cloud_intensity")
    for name, sizes in (*((each, "cloud_size") for each in values), ("path_points", "path_size")):
        _check_sizes(arrays[sizes], len(arrays[name]))
    if len(arrays["cloud_seq"]) != len(arrays["cloud_size"]):
        raise ValueError("sizes of other clouds")


def _check_sizes(sizes: Spool, count: int) -> None:
    """Raise ValueError unless sizes are those of the parts of an array of ``count`` values."""
    total = 0
    for block in sizes.blocks():
        if (block < 0).any() or (block > count).any():
            raise ValueError("sizes out of range")
        total += int(block.sum())  # no overflow: a block has fewer than 2^18 sizes
        if total > count:
            break
    if total != count:
        raise ValueError("sizes do not add up")


MAX_PAGE_POINTS = 200_000
MAX_CLOUDS = 700
MAX_PATHS = 150
_NO_VALUE_LEVEL = 255
CONE_LINES = 48  # lines of a cone


def scene(rows: Sequence[Row], truth: dict[int, Pose], view: View | None) -> dict[str, Any]:
    """Return the plain data for ``scene.js``: poses as columns x y z qx qy qz qw, points as 16-bit
    steps about a centre [m].

    Args:
        rows: the rows of a run.
        truth: true T_ac by number of the scan.
        view: the model, clouds and paths; None where there are none.
    """
    view = view or View(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    estimate = np.stack(
        [numbers(rows, n) for n in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")], axis=1
    )
    return {
        "vertices": pack(view.vertices, "f4"),
        "faces": pack(view.faces, "u4"),
        "estimate": pack(estimate, "f4"),
        "truth": pack(_true_poses(rows, truth), "f4"),
        "clouds": _clouds(
            _at_most(view.clouds, MAX_CLOUDS),
            {seq: k for k, seq in enumerate(column_of(rows, "seq"))},
        ),
        "paths": _paths(_at_most(view.paths, MAX_PATHS), rows[0].t_ns if rows else 0),
    }


def _true_poses(rows: Sequence[Row], truth: dict[int, Pose]) -> NDArray[np.float64]:
    out = np.full((len(rows), 7), np.nan)
    for k, t_ns in enumerate(column_of(rows, "t_ns")):
        pose = truth.get(t_ns)
        if pose is not None:
            out[k] = [*pose.t, *pose.q]
    return out


def _at_most(items: Sequence[Any], most: int) -> list[Any]:
    """At an even stride, with the first and the last."""
    chosen = np.unique(np.linspace(0, max(len(items) - 1, 0), min(most, len(items))).astype(int))
    return [items[k] for k in chosen]


def _clouds(clouds: Sequence[CloudView], place: dict[int, int]) -> dict[str, Any]:
    clouds = [c for c in clouds if c.seq in place and len(c.points)]
    each = MAX_PAGE_POINTS // max(len(clouds), 1)
    thinned = [thin_cloud(c.seq, c.points, c.residual_m, c.intensity, most=each) for c in clouds]
    cap = _cap([c.residual_m for c in thinned if c.residual_m is not None])
    brightest = _brightest([c.intensity for c in thinned if c.intensity is not None])
    parts = [_quantised(c.points) for c in thinned]
    return {
        "scan": pack([place[c.seq] for c in thinned], "i4"),
        "size": pack([len(c.points) for c in thinned], "i4"),
        "centre": pack([p[1] for p in parts], "f4"),
        "step": pack([p[2] for p in parts], "f4"),
        "points": pack(np.concatenate([np.zeros((0, 3), np.int16), *(p[0] for p in parts)]), "i2"),
        "residual": _levels([(c, c.residual_m) for c in thinned], cap),
        "intensity": None
        if brightest is None
        else _levels([(c, c.intensity) for c in thinned], brightest),
        "cap_m": cap,
        "brightest": brightest,
    }


def _quantised(points: NDArray[np.float32]) -> tuple[NDArray[np.int16], NDArray[np.float64], float]:
    """Steps (n, 3), centre (3,) and step [m]: point = centre + step x steps, to half a step."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    centre = 0.5 * (low + high)
    step = float(max(np.max(high - low) / 65_000.0, 1e-9))
    return np.round((points - centre) / step).astype(np.int16), centre, step


def _cap(residuals: Sequence[NDArray[np.float32]]) -> float | None:
    """Residual at the top of the colour scale [m]: twice the median over the scans of their
    90 % points.
    """
    if not residuals:
        return None
    return 2.0 * float(np.median([np.quantile(r, 0.9) for r in residuals])) or 1e-9


def _brightest(seen: Sequence[NDArray[np.float32]]) -> float | None:
    """Intensity at the top of the colour scale: the 99 % point of all points."""
    known = np.concatenate([np.zeros(0, np.float32), *seen])
    known = known[np.isfinite(known)]
    return (float(np.quantile(known, 0.99)) or 1.0) if len(known) else None


def _levels(parts: Sequence[tuple[CloudView, Floats | None]], top: float | None) -> dict[str, Any]:
    """Levels 0 to 254 of the values from 0 to ``top``; 255 where there is none."""
    share = _each_point(parts) / (top or 1.0)
    levels = np.where(
        np.isfinite(share), np.round(np.clip(share, 0.0, 1.0) * 254.0), _NO_VALUE_LEVEL
    )
    return pack(levels, "u1")


def _paths(paths: Sequence[PathView], start_ns: int) -> list[dict[str, Any]]:
    return [
        {"t_s": (p.t_ns - start_ns) * 1e-9, "points": pack(p.points, "f4"), "miss_m": p.miss_m}
        for p in paths
    ]


def cone_lines(axis: Array, degrees: float, length: float, mouth: float) -> Array:
    """Return line segments (2 n, 3) of a cone about an axis: its rim, the rim of its mouth, and
    lines between them.

    The rim lies where the cone meets the ball of radius ``length`` about the grasp point.

    Args:
        axis: (3,) unit.
        degrees: Half-angle.
        length: Distance of the rim from the grasp point [m].
        mouth: Radius at the grasp point [m].
    """
    side = geometry.across(axis)
    turn = np.linspace(0.0, 2.0 * math.pi, CONE_LINES + 1)
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    slope = math.tan(math.radians(degrees))
    a, b = 1.0 + slope * slope, slope * mouth  # along^2 + (mouth + slope along)^2 = length^2
    along = (math.sqrt(max(b * b - a * (mouth * mouth - length * length), 0.0)) - b) / a
    rim, inner = along * axis + (mouth + slope * along) * ring, mouth * ring
    around = [np.stack([r[:-1], r[1:]], axis=1).reshape(-1, 3) for r in (rim, inner)]
    return np.concatenate([*around, np.stack([inner[:-1:6], rim[:-1:6]], axis=1).reshape(-1, 3)])
