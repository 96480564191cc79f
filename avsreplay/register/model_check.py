"""Errors of the model that the scans of a run show: a wrong size or shape, or unknown times of the
points.

Size: along a run, the factor between target and model is estimated from the residuals of registered
scans. With T_ac_true = T_ac Exp(d) and a target 1 + delta times as large as the model, the residual
at p with normal n is n . (p - c) = J d + delta n . p. Least squares per scan give delta after the
pose is eliminated (``size``); scans are weighted by the inverse of its variance, and their spread
gives the standard error (jackknife over scans). The bias that noise causes is found on a few of the
scans and subtracted; half of it counts as a standard error. Three faces of a box fit a box of any
size, at a place that changes with it. The size follows from the places of all scans: the mass
centre of a free target moves uniformly, and the error of the place changes with the side that is
seen.

Times: points without times are taken as measured at one instant. The motion between two scans and
the order of the points give the duration of a scan by least squares together with the size
(``duration``); a significant one is reported.

Shape: the mirror image of the model is compared with it on a few accepted scans (``mirror``). If no
scan was registered, the global search is repeated with a reflected scan. The unit of the model is
checked before a run (``preflight``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment, AlignStatus, Scan, Surface
from avsreplay.register.backend import (
    POSES,
    Availability,
    Backend,
    Target,
    available,
    measured_alignment,
)
from avsreplay.register.duration import (
    BIAS_SCANS,
    JACKKNIFE_BLOCKS,
    LEAST_SCANS,
    MOST_WEIGHT,
    Duration,
    Durations,
    OrderedScan,
)
from avsreplay.register.mirror import (
    SeenScan,
    from_another_side,
    mirror_image_fits,
    reflected,
    wanted,
)
from avsreplay.register.params import RegisterParams, RegistrationLimits
from avsreplay.register.quality import LEAST_RATIO
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import at_instant, diameter, without_scattered_points
from avsreplay.register.sensor_frame import SensorFrame
from avsreplay.register.size import (
    MOST_OF_MODEL,
    SIZE_SIGMAS,
    fitted_size,
    matched_points,
    noise_bias,
    normal_jacobian,
    spread_of,
)
from avsreplay.register.surface_index import SurfaceIndex

__all__ = [
    "POSES",
    "Availability",
    "Backend",
    "ModelCheck",
    "RegisterParams",
    "Registrar",
    "RegistrationLimits",
    "SensorFrame",
    "Target",
    "available",
    "measured_alignment",
]

CHECKED_POINTS = 1500  # points used of each scan
# least error of size that is reported; a single scan cannot show so small a one
_LEAST_RUN_ERROR = 0.001
CHECKED_EVERY = 3
MOST_CHECKED = 60
ENOUGH_SCANS = 16  # the check ends here if the scans exclude an error that would be reported
_MIRRORED = (
    "so that an axis of the model or of the points is inverted: add --model-mirror (if it is given,"
    " remove it)"
)
# of a scan: compared with the mirror image, and for its duration
_SEEN_POINTS = 2000
_DURATION_POINTS = 800
# scans of which one gives a place, and places that give the size
_PLACE_EVERY = 2
_LEAST_PLACES = 12
_PLACE_POINTS = 500  # points of each
# least share, explained by the size, of what a uniform motion leaves of the places
_LEAST_EXPLAINED = 0.5
_NOTED = 0.5  # least share of systematic errors that is reported
_MOST_TURN_RAD = 0.5  # between two scans; the motion is taken as uniform


@value_class
class _Place:
    """Position (3,) of the origin of {C} in {A} [m] at ``t_ns``, its change (3,) with the size, its
    attitude (3, 3).

    ``sigma_m`` is the standard error of the position.
    """

    t_ns: int
    at: Array
    change: Array
    R: Array
    sigma_m: float


class ModelCheck:
    """Collects scans of one run and reports errors of the model.

    Attributes:
        deltas: sizes of the target over that of the model, less 1, of the scans that show one.
        durations: what the order of the points says of the duration of a scan.
        seen: accepted scans of different sides, with which the mirror image is compared.
    """

    def __init__(self, registrar: Registrar, surface: Surface) -> None:
        """Create the check of one run.

        Args:
            registrar: of the run.
            surface: its model, vertices in {C} [m].
        """
        self._registrar, self._surface = registrar, surface
        self._aligned, self._matched, self._ambiguous, self._several = (
            0,
            False,
            "",
            0,
        )  # several less no poses of scans
        self._systematic = 0.0  # sum of the shares of systematic errors
        self._size_open = (
            True  # whether the scans so far do not exclude an error of the size to report
        )
        self.deltas: list[float] = []
        self._weights: list[float] = []
        self._points: list[
            tuple[Array, Array | None]
        ] = []  # points of each measured scan, and the camera, in {C}
        self._places: list[_Place] = []
        self._placed, self._stride = (
            0,
            _PLACE_EVERY,
        )  # scans that may give a place; one of ``_stride`` does
        self._unmatched: Scan | None = None
        self._last: tuple[int, Pose] | None = None  # instant and pose of the last aligned scan
        self.durations = Durations()
        self._middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
        self.seen: list[SeenScan] = []

    def add(self, scan: Scan, found: Alignment | None) -> None:
        """Use one scan.

        Args:
            scan: points in {A} [m]; points that are not finite are left out.
            found: its alignment; None, or a scan without points, is ignored.
        """
        if found is None or not len(scan.points):
            return
        on_model = found.inlier_ratio >= LEAST_RATIO
        if found.measured and on_model:
            self._matched = True  # the scan is on the model, although the pose is not accepted
        aligned = found.status is AlignStatus.ALIGNED
        unsettled = found.status is AlignStatus.NOT_CONVERGED and on_model
        if (aligned or unsettled) and self._size_open:
            self._add_place(scan, found.T_ac)
        if aligned:
            self._add_aligned(scan, found)
            return
        self._unmatched = self._unmatched or scan
        if found.status is AlignStatus.AMBIGUOUS:
            self._ambiguous = self._ambiguous or found.free_directions
            self._several += 1
        elif found.status is not AlignStatus.POSTPONED:
            self._several -= 1

    def _add_aligned(self, scan: Scan, found: Alignment) -> None:
        self._aligned += 1
        if found.covariance is not None and found.systematic is not None:
            share = float(np.trace(np.linalg.solve(found.covariance, found.systematic))) / 6.0
            self._systematic += share
        if (
            self._aligned % CHECKED_EVERY == 1
            and len(self.deltas) < MOST_CHECKED
            and self._size_open
        ):
            self._measure(scan, found.T_ac)
        if scan.places is not None and self.durations.wanted():
            self._measure_duration(scan, scan.places, found.T_ac)
        self._keep(scan, found.T_ac)
        self._last = scan.t_ns, found.T_ac

    def scale(self) -> tuple[float, float] | None:
        """Return the size of the target over that of the model and its standard error; None
        with too few scans.
        """
        found = [each for each in (self._of_residuals(), self._of_places()) if each is not None]
        if len(found) < 2:
            return found[0] if found else None
        (size, sigma), (other, other_sigma) = found
        share = sigma**2 / (sigma**2 + other_sigma**2)
        return size + share * (other - size), max(
            float(np.sqrt(share)) * other_sigma, 0.5 * abs(other - size)
        )

    def _of_residuals(self) -> tuple[float, float] | None:
        if len(self.deltas) < LEAST_SCANS:
            return None
        mean, spread, weight = self._mean()
        tried = np.linspace(0, len(weight) - 1, BIAS_SCANS).astype(np.intp)
        bias = [noise_bias(self._registrar.index, *self._points[k]) for k in tried]
        mean_bias = float(weight[tried] @ np.array(bias) / weight[tried].sum())
        return 1.0 + mean - mean_bias, float(np.hypot(spread, 0.5 * mean_bias))

    def _of_places(self) -> tuple[float, float] | None:
        """Size and standard error (jackknife over blocks) from the places of the scans; None
        if it explains little.
        """
        if len(self._places) < _LEAST_PLACES:
            return None
        least = float(np.median([place.sigma_m for place in self._places])) / MOST_WEIGHT
        A, y = np.empty((len(self._places), 3, 10)), np.empty((len(self._places), 3))
        for k, place in enumerate(self._places):  # at = c + v t - R rho - change delta
            t_s = 1e-9 * (place.t_ns - self._places[0].t_ns)
            row = np.column_stack([np.eye(3), t_s * np.eye(3), place.R, -place.change])
            A[k], y[k] = row / max(place.sigma_m, least), place.at / max(place.sigma_m, least)
        block = np.arange(len(y)) * JACKKNIFE_BLOCKS // len(y)
        delta, left = _last_unknown(A, y)
        without = np.array(
            [_last_unknown(A[block != k], y[block != k])[0] for k in range(JACKKNIFE_BLOCKS)]
        )
        uniform = _last_unknown(A[:, :, :9], y)[1]
        return (
            (1.0 + delta, spread_of(without)) if left < (1.0 - _LEAST_EXPLAINED) * uniform else None
        )

    def _add_place(self, scan: Scan, T_ac: Pose) -> None:
        self._placed += 1
        if (self._placed - 1) % self._stride:
            return
        p = self._on_model(scan, T_ac, _PLACE_POINTS)
        found = (
            None
            if p is None
            else _place_of_size(self._registrar.index, p, self._camera(scan, T_ac.inverse()))
        )
        if found is None:
            return
        moved, change, sigma_m = found
        self._places.append(
            _Place(scan.t_ns, T_ac.t + T_ac.R @ moved, T_ac.R @ change, T_ac.R, sigma_m)
        )
        if len(self._places) == MOST_CHECKED:
            self._places, self._stride = self._places[::2], 2 * self._stride

    def _mean(self) -> tuple[float, float, Array]:
        """The weighted mean of the errors of size, its standard error (jackknife), and the limited
        weights.
        """
        values, weight = np.array(self.deltas), np.array(self._weights)
        weight = np.minimum(weight, MOST_WEIGHT * np.median(weight))
        without = (weight @ values - weight * values) / (weight.sum() - weight)
        return float(weight @ values / weight.sum()), spread_of(without), weight

    @property
    def duration_known(self) -> bool:
        """Whether the order of the points excludes that a scan takes a part of the period, or
        gives this part.
        """
        durations = self.durations
        return not durations.open or durations.result(self._registrar.index) is not None

    def notes(self) -> tuple[str, ...]:
        """Return the errors of the model that the run shows, one line each; empty if there
        are none.
        """
        if self._aligned:
            if mirror_image_fits(self._registrar, self._surface, self.seen):
                return (
                    (
                        "the mirror image of the model explains the scans better than the model,"
                        f" {_MIRRORED}"
                    ),
                )
            duration = self.durations.result(self._registrar.index)
            if duration is None:
                return _size_note(self.scale())
            # motion during the scans makes an error of the size appear, so that both are fitted
            # together
            return (*_size_note((duration.size, duration.size_1s)), _duration_note(duration))
        if self._ambiguous and self._several >= 0:
            return (
                (
                    f"the scans fit the model in more than one pose ({self._ambiguous}): give the"
                    " first one by --init"
                ),
            )
        unmatched = None if self._matched and not self._ambiguous else self._unmatched
        return () if unmatched is None else (self._diagnosis(unmatched),)

    def remark(self) -> str:
        """Return the share of systematic errors in the covariances of the poses where it is above a
        half; else "".
        """
        share, of = (
            self._systematic / max(self._aligned, 1),
            "errors of the model or of the ranges, which remain",
        )
        return f"{100.0 * share:.0f} % of the variance of the poses comes from {of}" * (
            share > _NOTED
        )

    def _camera(self, scan: Scan, T_ca: Pose) -> Array | None:
        """Position of the sensor in {C}, where only faces towards it are matched."""
        if not self._registrar.sided:
            return None
        return T_ca.t if scan.sensor is None else (T_ca @ scan.sensor).t

    def _measure(self, scan: Scan, T_ac: Pose) -> None:
        p, camera_c = self._on_model(scan, T_ac, CHECKED_POINTS), self._camera(scan, T_ac.inverse())
        measured = None if p is None else fitted_size(self._registrar.index, p, camera_c)
        if p is not None and measured is not None and measured.sigma > 0.0:
            self.deltas.append(measured.delta)
            self._weights.append(1.0 / measured.sigma**2)
            self._points.append((p, camera_c))
            if len(self.deltas) >= ENOUGH_SCANS:
                mean, spread, _ = self._mean()
                self._size_open = not abs(mean) + SIZE_SIGMAS * spread < _LEAST_RUN_ERROR

    def _on_model(self, scan: Scan, T_ac: Pose, count: int) -> Array | None:
        """About ``count`` points (n, 3) in {C} at the instant of the scan; None if their
        motion is unknown.
        """
        kept = _some(scan.points, count)
        p = T_ac.inverse().apply(np.asarray(scan.points[kept], dtype=np.float64))
        if scan.times_s is None:
            return p
        if (moving := self._motion(scan, T_ac)) is None:
            return None
        return at_instant(p, scan.times_s[kept], moving[0], moving[1])

    def _motion(self, scan: Scan, T_ac: Pose) -> tuple[Array, Array, float] | None:
        """Rate [rad/s] and velocity [m/s] (3,) in {C} since the last aligned scan, and the time
        since then [s].
        """
        if self._last is None or (period := 1e-9 * (scan.t_ns - self._last[0])) <= 0.0:
            return None
        before = self._last[1]
        turn = geometry.log((T_ac @ before.inverse()).q)
        if np.linalg.norm(turn) > _MOST_TURN_RAD:
            return None
        rate, velocity = (
            geometry.rotate(T_ac.R.T, each / period) for each in (turn, T_ac.t - before.t)
        )
        return rate, velocity, period

    def _measure_duration(self, scan: Scan, places: NDArray[Any], T_ac: Pose) -> None:
        if (moving := self._motion(scan, T_ac)) is None:
            return
        rate, velocity, period = moving
        kept, T_ca = _some(scan.points, _DURATION_POINTS), T_ac.inverse()
        p = T_ca.apply(np.asarray(scan.points[kept], dtype=np.float64))
        motion = (places[kept].astype(np.float64) - 0.5)[:, None] * (np.cross(rate, p) + velocity)
        self.durations.add(
            self._registrar.index, OrderedScan(p, motion, self._camera(scan, T_ca), period)
        )

    def _keep(self, scan: Scan, T_ac: Pose) -> None:
        """Keep a scan of another side of the target, for the comparison with the mirror image."""
        if not wanted(self.seen):
            return
        T_cs = T_ac.inverse() if scan.sensor is None else T_ac.inverse() @ scan.sensor
        if not from_another_side(T_cs, self.seen, self._middle):
            return
        if (p := self._on_model(scan, T_ac, _SEEN_POINTS)) is not None:
            self.seen.append(SeenScan(T_cs.inverse().apply(p).astype(np.float32), T_cs))

    def _diagnosis(self, scan: Scan) -> str:
        """Try the mirrored model on a scan that was not registered, and compare the sizes."""
        points = without_scattered_points(
            np.asarray(scan.points, dtype=np.float64), self._surface.extent
        )
        if len(points) and self._fits_mirrored(points, scan.sensor):
            return f"the scans fit the mirror image of the model, {_MIRRORED}"
        own, seen = diameter(self._surface.vertices, trimmed=False), diameter(points)
        sizes = f"the first of them measures {seen:.3g} m, the model {own:.3g} m"
        cause = (
            "is background left around the target, and is it"
            if seen > MOST_OF_MODEL * own
            else "is it"
        )
        return (
            f"no pose of the model explains the scans ({sizes}): {cause} the right model, in"
            " metres?"
        )

    def _fits_mirrored(self, points: Array, sensor: Pose | None) -> bool:
        """Whether nearly all of a scan (n, 3) in {A} is on the mirrored model, in one pose only and
        with its size.
        """
        seen = points if sensor is None else sensor.inverse().apply(points)
        found = self._registrar.acquire(reflected(seen))
        return (
            found.status is AlignStatus.ALIGNED
            and found.inlier_ratio >= LEAST_RATIO
            and not found.message
        )


def _size_note(found: tuple[float, float] | None) -> tuple[str, ...]:
    """The text for a size with its standard error; empty if it is right."""
    if found is None or abs(found[0] - 1.0) < max(_LEAST_RUN_ERROR, SIZE_SIGMAS * found[1]):
        return ()
    error = abs(found[0] - 1.0)
    small, long = ("small", "long") if found[0] > 1.0 else ("large", "short")
    return (
        (
            f"the model is {100.0 * error:.1f} % too {small} (1 sigma {100.0 * found[1]:.2g} %):"
            f" multiply --model-scale by {found[0]:.4f}, or the ranges of the sensor are too {long}"
            " by as much"
        ),
    )


def _duration_note(found: Duration) -> str:
    return (
        "the points of a scan have no times, but they fit a moving target that is measured point"
        f" after point in {abs(found.duration_s):.3g} +- {found.sigma_s:.1g} s: record the time of"
        f" each point (field 't'); less exactly, --scan-duration {found.duration_s:.3g} gives times"
        " by the order of the points"
    )


def _some(points: NDArray[Any], count: int) -> NDArray[np.intp]:
    """Numbers of about ``count`` points (n, 3), in their order."""
    return np.arange(0, len(points), max(1, len(points) // count))


def _place_of_size(
    index: SurfaceIndex, p: Array, camera_c: Array | None
) -> tuple[Array, Array, float] | None:
    """Position of a registered scan from the distances along normals, and its change with the size
    of the target.

    ``p``: (n, 3) points in {C} [m], at the registered pose; ``camera_c`` as for ``fitted_size``.
    Returns the translation (3,) of the origin of {C} [m], its change (3,) with delta [m], both in
    {C}, and the standard error of the translation [m]; None with fewer than 50 residuals.
    """
    matched = matched_points(index, p, camera_c)
    if matched is None:
        return None
    near, n, _, e, weight, noise = matched
    q = p[near]
    J, a = weight[:, None] * normal_jacobian(q, n), weight * np.einsum("ij,ij->i", q, n)
    of_e, of_a = np.linalg.lstsq(J, np.column_stack([weight * e, a]), rcond=1e-6)[0].T
    return of_e[3:], -of_a[3:], noise * float(np.sqrt(np.trace(np.linalg.pinv(J.T @ J)[3:, 3:])))


def _last_unknown(A: Array, y: Array) -> tuple[float, float]:
    """Least-squares value of the last unknown of A (n, 3, k) x = y (n, 3), and the sum of the
    squared residuals.
    """
    rows, right = A.reshape(-1, A.shape[2]), y.ravel()
    scale = np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    x = np.linalg.lstsq(rows / scale, right, rcond=1e-9)[0] / scale
    left = right - rows @ x
    return float(x[-1]), float(left @ left)
