"""The motions that carry most of a model onto itself: turns about an axis, a finite group, or
single ones.

A body of revolution has any turn about its axis. The turns of a gear carry its teeth onto one
another, and between them the rest of it is on itself as well. They are the least distances along a
fine circle of turns. Other bodies have a finite group, which the products of a few motions give, or
single motions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.register.degenerate import scaled_information
from avsreplay.register.global_search import SYMMETRIC, SYMMETRIES, GlobalSearch
from avsreplay.register.size import normal_jacobian
from avsreplay.register.surface_index import SurfaceIndex

# about an axis of revolution; to recognise the axis
TURNS = 72
GENERIC_TURNS = (5, 11, 23, 31, 43, 59)
# distance of turned surface on the model [extent]; fits of the axis, points
REVOLVED = 0.02
FITS = 2
LEAST_FITTED = 60
# every n-th point for the axis, a product, the circle of turns
AXIS_STRIDE = 3
GROUP_STRIDE = 40
CIRCLE_STRIDE = 20
FINALISTS = 2  # poses of each kind of motion that are refined; kinds of single motions
# turns along the circle; largest cost at the teeth of a gear over the median cost
CIRCLE = 360
LOW = 0.75
# median cost, below which a body is one of revolution; fewest teeth
LEAST_COST = 0.02
LEAST_TEETH = 5
# most motions of a finite group, and rounds of products
PRODUCTS = 96
PRODUCT_ROUNDS = 4
# distance beyond which a point is not carried onto the surface
CARRIED_WIDTH_OF_EXTENT = 0.03
DIFFERENT_RAD = np.radians(3.0)


@value_class
class Symmetries:
    """Near-symmetries of one model.

    Attributes:
        kinds: (k, 4, 4) motions in {C} of each kind, without the identity.
        least_rad: least rotation between the teeth of a gear; inf for other bodies.
    """

    kinds: tuple[Array, ...]
    least_rad: float


NONE = Symmetries((), np.inf)


def near_symmetries(
    search: GlobalSearch, index: SurfaceIndex, points: Array, normals: Array
) -> Symmetries:
    """Return the near-symmetries of a model.

    Args:
        search: of the model, with a few of its near-symmetries.
        index: of the model.
        points: (n, 3) on the surface, in {C} [m].
        normals: (n, 3) of their faces.
    """
    found = search.symmetries
    if not len(found):
        return NONE
    on_axis = (points[::AXIS_STRIDE], normals[::AXIS_STRIDE])
    axis = (
        _axis(index, *on_axis, 0.5)
        or next(_axes_of(index, on_axis[0], found), None)
        or _axis(index, *on_axis, 0.0)
    )
    if axis is not None:
        turns, least = _turns(index, points[::CIRCLE_STRIDE], *axis)
        flips = [T for T in found if axis[0] @ T[:3, :3] @ axis[0] < -0.9]
        return Symmetries((turns[1:], *(turns @ flip for flip in flips[:1])), least)
    group = (
        _group(search, index, points[::GROUP_STRIDE], found) if len(found) == SYMMETRIES else found
    )
    return Symmetries(tuple(group[k::FINALISTS] for k in range(min(FINALISTS, len(group)))), np.inf)


def distances(index: SurfaceIndex, points: Array, motions: Array, most_m: float) -> Array:
    """Return the distances (k, n) [m] of points (n, 3) in {C} moved by (k, 4, 4), at most
    ``most_m`` and the reach.
    """
    moved = points @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]
    most_m = min(most_m, index.reach_m)
    d2 = index.closest(moved.reshape(-1, 3), most_m=most_m).d2
    return np.sqrt(np.minimum(d2, most_m**2)).reshape(len(motions), -1)


def revolved(axis: Array, centre: Array, count: int) -> Array:
    """Return (count, 4, 4) rotations about an axis (3,) through ``centre`` (3,) in {C}; the
    first is the identity.
    """
    R = geometry.matrix(geometry.exp(2.0 * np.pi / count * np.arange(count)[:, None] * axis))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, centre - R @ centre
    return T


def _group(search: GlobalSearch, index: SurfaceIndex, points: Array, found: Array) -> Array:
    """The finite group, without the identity, that motions (k, 4, 4) generate; themselves if it is
    too large.

    Each product is registered, so that errors do not add up.
    """
    width = CARRIED_WIDTH_OF_EXTENT * index.extent_m
    group = [np.eye(4), *found]
    for _ in range(PRODUCT_ROUNDS):
        larger = list(group)
        for product in (a @ b for a in group for b in found):
            if len(larger) > PRODUCTS:
                return found
            if not _among(product, larger) and _cost(index, points, product, width) < SYMMETRIC:
                ended = search.refined(points, Pose.from_matrix(product), width).matrix
                fits = not _among(ended, larger) and _cost(index, points, ended, width) < SYMMETRIC
                larger += [ended] if fits else []
        if len(larger) == len(group):
            return np.stack(group[1:])
        group = larger
    return found


def _cost(index: SurfaceIndex, points: Array, T: Array, width_m: float) -> float:
    """Mean of min(1, squared distance in units of the width) of points moved by (4, 4)."""
    return float(np.mean((distances(index, points, T[None], width_m) / width_m) ** 2))


def _among(T: Array, others: list[Array]) -> bool:
    """Whether a motion (4, 4) is rotated by less than ``DIFFERENT_RAD`` from one of others."""
    trace = np.einsum("kij,ij->k", np.stack(others)[:, :3, :3], T[:3, :3])
    return bool((trace > 1.0 + 2.0 * np.cos(DIFFERENT_RAD)).any())


def _axis(
    index: SurfaceIndex, points: Array, normals: Array, least: float
) -> tuple[Array, Array] | None:
    """Direction and a point of the axis about which most of the surface is a surface of revolution,
    or None.

    Large marks displace the first fit, after which a smaller share of the surface, ``least``, leads
    to the next one.
    """
    on = np.ones(len(points), dtype=bool)
    for _ in range(FITS):
        centre = points[on].mean(axis=0)
        J = normal_jacobian(points[on], normals[on])
        info, radius = scaled_information(J.T @ J, int(on.sum()), centre)
        x = np.linalg.eigh(info)[1][:, 0]
        theta = x[:3] / radius
        size = float(np.linalg.norm(theta))
        if size * radius < 0.5:
            return None
        direction, centre = theta / size, centre + np.cross(theta, x[3:]) / size**2
        on = _revolved(index, points, direction, centre)
        if np.count_nonzero(on) < LEAST_FITTED or on.mean() < least:
            return None
    return (direction, centre) if on.mean() >= 0.5 else None


def _axes_of(index: SurfaceIndex, points: Array, found: Array) -> Iterator[tuple[Array, Array]]:
    """The axes of motions (k, 4, 4) about which most of the surface is a surface of revolution."""
    for T in found:
        turn = geometry.log(Pose.from_matrix(T).q)
        size = float(np.linalg.norm(turn))
        direction = turn / size
        across = np.eye(3) - np.outer(direction, direction)
        centre = np.linalg.lstsq(np.eye(3) - T[:3, :3], across @ T[:3, 3], rcond=1e-6)[0]
        if _revolved(index, points, direction, centre).mean() >= 0.5:
            yield direction, centre


def _revolved(index: SurfaceIndex, points: Array, direction: Array, centre: Array) -> Array:
    """Which points (n, 3) any turn about an axis leaves on the surface."""
    turns = revolved(direction, centre, TURNS)[list(GENERIC_TURNS)]
    width = REVOLVED * index.extent_m
    return np.asarray(np.all(distances(index, points, turns, width) < width, axis=0))


def _turns(
    index: SurfaceIndex, points: Array, direction: Array, centre: Array
) -> tuple[Array, float]:
    """The turns (k, 4, 4) about an axis, the identity first: those of teeth, or else any; the
    least of teeth [rad].
    """
    width = 0.5 * REVOLVED * index.extent_m
    circle = distances(index, points, revolved(direction, centre, CIRCLE), width)
    count = _teeth(np.mean((circle / width) ** 2, axis=1))
    return revolved(direction, centre, count or TURNS), 2.0 * np.pi / count if count else np.inf


def _teeth(cost: Array) -> int:
    """The number of teeth by the cost (k,) of turns along a circle, low at each tooth: the
    main frequency; or 0.
    """
    k, middle = len(cost), float(np.median(cost))
    power = np.abs(np.fft.rfft(cost - cost.mean())) ** 2
    count = LEAST_TEETH + int(np.argmax(power[LEAST_TEETH : k // 3]))
    at_teeth = cost[np.round(np.arange(1, count) * k / count).astype(np.intp)]
    return count if middle >= LEAST_COST and float(np.median(at_teeth)) < LOW * middle else 0
