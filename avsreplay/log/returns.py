"""Which points of a cloud are returns of the sensor, and which stand for a missing return.

NaN and infinite coordinates always stand for a missing return, and so does the origin of the
sensor. Other drivers repeat one point, such as the position of the sensor in the frame of the
vehicle, write the largest number of a depth image (65.535 m), or put the point at the largest range
along its ray. Such a code is recognised by its values: it is repeated far more often than any
return, and a largest depth or range is the same in every cloud and apart from all other points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class

# a larger coordinate is a sensor error; squares and grid cells stay in range
MAX_COORDINATE_M = 1e6
_LEAST_REPEATS = 10  # points that are equal before they are taken for a code
_LEAST_REPEATED_SHARE = 0.005  # of the points of a cloud
_REPEATS_OVER_OTHERS = 10.0  # how much more often than the others a point is repeated
_PROBE_POINTS = 512  # points of a cloud that are compared before all are
_RANGE_GAP_SHARE = 0.05  # gap between a largest depth or range and the next point, over it
_FLOAT32_DIFFERENCE = 3e-6  # relative difference of values that are written as float32
_DIGITS = range(10, 17)  # bits of a depth image
_DIGIT_UNITS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 2.5e-4)  # their units


@value_class(eq=True)
class NoReturn:
    """The codes of missing returns, besides numbers that are not finite and the origin.

    Attributes:
        points: coordinates of repeated points [unit of the cloud].
        depths: (axis, value) of a largest depth [the same].
        ranges: distances from the origin [the same].
        find: also leave out a point that is repeated in a cloud although it is not listed.
    """

    points: tuple[tuple[float, float, float], ...] = ()
    depths: tuple[tuple[str, float], ...] = ()
    ranges: tuple[float, ...] = ()
    find: bool = True

    @property
    def text(self) -> str:
        """Return the codes as the argument of ``--no-return``."""
        codes = [",".join(f"{v:.9g}" for v in point) for point in self.points]
        codes += [f"{axis}={value:.9g}" for axis, value in self.depths]
        codes += [f"range={value:.9g}" for value in self.ranges]
        return ";".join(codes) or "none"


@value_class(eq=True)
class Missing:
    """How many points of a sample stand for missing returns.

    Attributes:
        total: points of the sample.
        not_finite: that are not finite or beyond the largest coordinate.
        at_origin: at the origin.
        coded: with one of the codes.
    """

    total: int = 0
    not_finite: int = 0
    at_origin: int = 0
    coded: int = 0


def parse_no_return(text: str) -> NoReturn:
    """Return the codes that ``--no-return`` states.

    Args:
        text: codes separated by semicolons, each ``X,Y,Z``, ``x=VALUE``, ``y=VALUE``, ``z=VALUE``
            or ``range=VALUE`` in the unit of the clouds; "none" for no code.

    Raises:
        ValueError: a code has another form.
    """
    points, depths, ranges = [], [], []
    for code in () if text == "none" else text.split(";"):
        name, given, value = code.strip().rpartition("=")
        try:
            numbers = tuple(float(word) for word in value.split(","))
        except ValueError:
            numbers = ()
        if not given and len(numbers) == 3:
            points.append((numbers[0], numbers[1], numbers[2]))
        elif name in ("x", "y", "z") and len(numbers) == 1:
            depths.append((name, numbers[0]))
        elif name == "range" and len(numbers) == 1:
            ranges.append(numbers[0])
        else:
            raise ValueError(f"'{code}' is not X,Y,Z, z=VALUE or range=VALUE, and not 'none'")
    return NoReturn(tuple(points), tuple(depths), tuple(ranges), find=False)


def valid(points: NDArray[Any], codes: NoReturn, largest: float) -> NDArray[np.bool_] | None:
    """Return which points are returns; None if all are.

    Args:
        points: (n, 3) in the unit of the cloud.
        codes: of missing returns.
        largest: coordinate beyond which a point is not valid [the same unit].
    """
    found = [_finite(points, largest), _away_from_origin(points)]
    found += [_differs(points, np.array(code)) for code in codes.points]
    found += [~_equals(points[:, "xyz".index(axis)], value) for axis, value in codes.depths]
    found += [_not_at(points, value) for value in codes.ranges]
    masks = [mask for mask in found if mask is not None]
    kept = None if not masks else np.logical_and.reduce(masks)
    if codes.find and (code := repeated(points if kept is None else points[kept])) is not None:
        differs = _differs(points, code)
        kept = differs if kept is None or differs is None else kept & differs
    return None if kept is None or kept.all() else kept


def repeated(points: NDArray[Any]) -> NDArray[Any] | None:
    """Return the coordinates of a point that is repeated far more often than the others of a
    cloud; None if there is none.

    Args:
        points: (n, 3) finite.
    """
    if len(points) < 2 * _LEAST_REPEATS:
        return None
    probe = points[:: max(len(points) // _PROBE_POINTS, 1)]
    if _most_common(probe)[1] <= max(1, int(_LEAST_REPEATED_SHARE * len(probe))):
        return None
    code, count, distinct = _most_common(points)
    often = count >= max(_LEAST_REPEATS, _LEAST_REPEATED_SHARE * len(points))
    return code if often and count >= _REPEATS_OVER_OTHERS * len(points) / distinct else None


def _most_common(points: NDArray[Any]) -> tuple[NDArray[Any], int, int]:
    """The most frequent point, its count, and the number of different points."""
    order = np.lexsort(points.T)
    rows = points[order]
    begins = np.flatnonzero(np.append(True, (rows[1:] != rows[:-1]).any(axis=1)))
    counts = np.diff(np.append(begins, len(rows)))
    best = int(np.argmax(counts))
    return rows[begins[best]], int(counts[best]), len(begins)


def find_codes(clouds: Sequence[NDArray[Any]]) -> NoReturn:
    """Return the codes of missing returns in a sample.

    Args:
        clouds: (n, 3) points of each cloud as they are stored.
    """
    finite = [_usable(cloud) for cloud in clouds]
    finite = [cloud for cloud in finite if len(cloud)]
    points = dict.fromkeys(
        tuple(float(v) for v in code) for code in map(repeated, finite) if code is not None
    )
    for code in points:
        finite = [cloud[(cloud != np.array(code)).any(axis=1)] for cloud in finite]
    finite = [cloud for cloud in finite if len(cloud)]
    depths = [(axis, v) for k, axis in enumerate("xyz") if (v := _largest_depth(finite, k))]
    ranges = [] if depths else [v for v in (_largest_range(finite),) if v]
    few = tuple((x, y, z) for x, y, z in list(points)[:_LEAST_REPEATS])
    return NoReturn(few, tuple(depths), tuple(ranges))


def count(clouds: Sequence[NDArray[Any]], codes: NoReturn, largest: float) -> Missing:
    """Return how many points of a sample are not returns, by cause.

    Args:
        clouds: as for ``find_codes``.
        codes: of missing returns.
        largest: as for ``valid``.
    """
    total = not_finite = at_origin = kept = 0
    for cloud in clouds:
        finite, away = _finite(cloud, largest), _away_from_origin(cloud)
        total += len(cloud)
        not_finite += 0 if finite is None else len(cloud) - int(np.count_nonzero(finite))
        at_origin += 0 if away is None else len(cloud) - int(np.count_nonzero(away))
        mask = valid(cloud, codes, largest)
        kept += len(cloud) if mask is None else int(np.count_nonzero(mask))
    return Missing(total, not_finite, at_origin, total - kept - not_finite - at_origin)


def _usable(points: NDArray[Any]) -> NDArray[Any]:
    masks = [
        m
        for m in (_finite(points, MAX_COORDINATE_M**2), _away_from_origin(points))
        if m is not None
    ]
    return points[np.logical_and.reduce(masks)] if masks else points


def _finite(points: NDArray[Any], largest: float) -> NDArray[np.bool_] | None:
    if np.einsum("ij,ij->", points, points) < largest**2:  # fast: no point can be outside
        return None
    kept: NDArray[np.bool_] = np.isfinite(points).all(axis=1)
    kept &= (np.abs(points) <= largest).all(axis=1)
    return kept


def _away_from_origin(points: NDArray[Any]) -> NDArray[np.bool_] | None:
    if points[:, 0].all():
        return None
    return np.asarray(points.any(axis=1))


def _differs(points: NDArray[Any], code: NDArray[Any]) -> NDArray[np.bool_] | None:
    same = np.logical_and.reduce([points[:, k] == points.dtype.type(code[k]) for k in range(3)])
    return ~same if same.any() else None


def _equals(values: NDArray[Any], code: float) -> NDArray[np.bool_]:
    equal: NDArray[np.bool_] = np.isclose(values, code, rtol=_FLOAT32_DIFFERENCE, atol=0.0)
    return equal


def _not_at(points: NDArray[Any], code: float) -> NDArray[np.bool_]:
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    return ~_equals(distance, code)


def _largest_depth(clouds: Sequence[NDArray[Any]], axis: int) -> float | None:
    """The largest value along an axis, if many points have it, it is a largest number of a depth
    image, and it is apart from all other values.
    """
    value = _apart([np.abs(cloud[:, axis]).astype(np.float64) for cloud in clouds], least=1)
    if value is None:
        return None
    digits = [value / unit for unit in _DIGIT_UNITS]
    full = [2**k - one for k in _DIGITS for one in (0, 1)]
    if not any(
        abs(each - number) <= _FLOAT32_DIFFERENCE * number for each in digits for number in full
    ):
        return None
    return next(
        float(cloud[k, axis])
        for cloud in clouds
        for k in np.flatnonzero(_equals(np.abs(cloud[:, axis]), value))[:1]
    )


def _largest_range(clouds: Sequence[NDArray[Any]]) -> float | None:
    """The largest range, if many points of several clouds have it and it is apart from all other
    ranges.
    """
    return _apart([np.linalg.norm(c.astype(np.float64), axis=1) for c in clouds], least=2)


def _apart(values: Sequence[NDArray[Any]], least: int) -> float | None:
    """The largest value of all clouds if at least ``least`` of them, and most, have many points
    with it, and it is apart from all other values, of which there are some.
    """
    if not values:
        return None
    largest = max(float(each.max()) for each in values)
    if not largest > 0.0:
        return None
    counts, others = list[int](), 0
    for each in values:
        equal = _equals(each, largest)
        rest = each[~equal]
        if len(rest) and rest.max() > (1.0 - _RANGE_GAP_SHARE) * largest:
            return None
        counts.append(int(np.count_nonzero(equal)))
        others += len(rest)
    many = [
        n >= max(_LEAST_REPEATS, _LEAST_REPEATED_SHARE * len(each))
        for n, each in zip(counts, values, strict=True)
    ]
    return largest if others and sum(many) >= least and 2 * sum(many) > len(values) else None
