"""What the 3D view is given: model, poses, a thinned cloud a scan, planned paths. Drawn by ``scene.js``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Pose
from avsreplay.report.page.packing import pack, values
from avsreplay.report.view import CloudView, PathView, View
from avsreplay.rows import Row

__all__ = ["scene"]

MOST_POINTS = 200_000
MOST_CLOUDS = 700
MOST_PATHS = 150
_NO_RESIDUAL = 255


def scene(rows: Sequence[Row], truth: dict[int, Pose], view: View | None) -> dict[str, Any]:
    """Plain data. Poses as seven columns x y z qx qy qz qw; points of a cloud as 16 bit steps about its centre [m]."""
    view = view or View(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    estimate = np.stack([values(rows, n) for n in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")], axis=1)
    return {
        "vertices": pack(view.vertices, "f4"),
        "faces": pack(view.faces, "u4"),
        "estimate": pack(estimate, "f4"),
        "truth": pack(_true_poses(rows, truth), "f4"),
        "clouds": _clouds(_at_most(view.clouds, MOST_CLOUDS), {row.seq: k for k, row in enumerate(rows)}),
        "paths": _paths(_at_most(view.paths, MOST_PATHS), rows[0].t_ns if rows else 0),
    }


def _true_poses(rows: Sequence[Row], truth: dict[int, Pose]) -> NDArray[np.float64]:
    out = np.full((len(rows), 7), np.nan)
    for k, row in enumerate(rows):
        pose = truth.get(row.t_ns)
        if pose is not None:
            out[k] = [*pose.t, *pose.q]
    return out


def _at_most(items: Sequence[Any], most: int) -> list[Any]:
    """At an even stride, first and last kept."""
    chosen = np.unique(np.linspace(0, max(len(items) - 1, 0), min(most, len(items))).astype(int))
    return [items[k] for k in chosen]


def _clouds(clouds: Sequence[CloudView], place: dict[int, int]) -> dict[str, Any]:
    clouds = [c for c in clouds if c.seq in place and len(c.points)]
    each = MOST_POINTS // max(len(clouds), 1)
    thinned = [_thinner(c, each) for c in clouds]
    cap = _cap([c.residual_m for c in thinned if c.residual_m is not None])
    parts = [_quantised(c.points) for c in thinned]
    return {
        "scan": pack([place[c.seq] for c in thinned], "i4"),
        "size": pack([len(c.points) for c in thinned], "i4"),
        "centre": pack([p[1] for p in parts], "f4"),
        "step": pack([p[2] for p in parts], "f4"),
        "points": pack(np.concatenate([np.zeros((0, 3), np.int16), *(p[0] for p in parts)]), "i2"),
        "residual": pack(np.concatenate([np.zeros(0, np.uint8), *(_levels(c, cap) for c in thinned)]), "u1"),
        "cap_m": cap,
    }


def _thinner(cloud: CloudView, most: int) -> CloudView:
    chosen = np.unique(np.linspace(0, len(cloud.points) - 1, min(most, len(cloud.points))).astype(int))
    residual = None if cloud.residual_m is None else cloud.residual_m[chosen]
    return CloudView(cloud.seq, cloud.points[chosen], residual)


def _quantised(points: NDArray[np.float32]) -> tuple[NDArray[np.int16], NDArray[np.float64], float]:
    """Steps (n, 3), centre (3,) and step [m]: point = centre + step x steps, to half a step."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    centre = 0.5 * (low + high)
    step = float(max(np.max(high - low) / 65_000.0, 1e-9))
    return np.round((points - centre) / step).astype(np.int16), centre, step


def _cap(residuals: Sequence[NDArray[np.float32]]) -> float | None:
    """The residual at the top of the colour scale: twice the 90 % point of the middle scan, blind ones or not."""
    if not residuals:
        return None
    return 2.0 * float(np.median([np.quantile(r, 0.9) for r in residuals])) or 1e-9


def _levels(cloud: CloudView, cap: float | None) -> NDArray[np.uint8]:
    if cloud.residual_m is None or cap is None:
        return np.full(len(cloud.points), _NO_RESIDUAL, np.uint8)
    levels: NDArray[np.uint8] = np.round(np.clip(cloud.residual_m / cap, 0.0, 1.0) * 254.0).astype(np.uint8)
    return levels


def _paths(paths: Sequence[PathView], start_ns: int) -> list[dict[str, Any]]:
    return [{"t_s": (p.t_ns - start_ns) * 1e-9, "points": pack(p.points, "f4"), "miss_m": p.miss_m} for p in paths]
