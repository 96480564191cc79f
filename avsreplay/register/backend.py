"""The base class of registration back ends, the list of all back ends, and the default one,
``horn``.

A back end is a class that derives from ``Backend``, under the entry-point group
``avsreplay.backends``. It returns a pose, an iteration count and its own convergence flag, nothing
more: ``quality.grade`` measures the quality of every pose. Its parameters, its accuracy and what it
can do besides ``align`` are stated in the class.

``poses`` is the entry for logs that hold poses of a tracker (markers, motion capture), of which
nothing is registered: the pipeline takes the pose of such a scan as its alignment.
"""

from __future__ import annotations

import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import MissingBackend, UsageError, value_class
from avsreplay.geometry import MeasuredPose, Pose, frozen
from avsreplay.parts import BACKENDS
from avsreplay.records import Alignment, AlignStatus, Fit, Surface
from avsreplay.register.surface_index import IcpParams, SurfaceIndex
from avsreplay.settings import NoParameters, Settings

if TYPE_CHECKING:
    from avsreplay.register.params import RegisterParams, RegistrationLimits
    from avsreplay.register.visibility import Visibility

S = TypeVar("S", bound=Settings)

# of an exact scan [deg, share of the extent], where a back end does not state its own
ACCURACY = (0.1, 0.001)
MESSAGE_LENGTH = 200  # an error message is cut to this number of characters
POSES = "poses"
REINSTALL = "reinstall the package that provides it"

PLANE_PASSES = 3
CLOUD_PLANE_PASSES = 30  # point-to-plane passes of a second alignment to a model of points
TIGHTEN = 3.0  # rejection distance over the rms distance of the last pass
LEAST_GATE_OF_EXTENT = 0.004  # the rejection distance follows the rms down to this
MOST_WITHIN = 60  # passes of an alignment that begins near its result
# of the rejection distance over the root of the points; usual rms radius
SETTLED_ERROR_OF_GATE = 0.05
RADIUS_OF_EXTENT = 0.25
FEW_POINTS = 600  # points for the first passes on a scan that has many more
# with a larger rms distance of these points, in gates, the fit of the scan is not close
ROUGH_OF_GATE = 0.375
# a scan of fewer points has the budget of this many, because its target may be mostly hidden
LEAST_BUDGET_POINTS = 2000
# most work of an alignment (fixed, per point); with a fixed gate
ALIGN_WORK = (20_000, 8)
WITHIN_WORK = (30_000, 15)


@value_class
class Target:
    """What a back end is built from.

    Attributes:
        surface: mesh or point cloud of the target, vertices in {C} [m].
        index: exact closest points on this surface.
        limits: rejection distances and stopping rule.
        visibility: which faces the camera can have measured.
        own: parameters of the back end, lengths that scale with the target filled in.
    """

    surface: Surface
    index: SurfaceIndex
    limits: RegistrationLimits
    visibility: Visibility
    own: Settings = NoParameters()

    def parameters(self, kind: type[S]) -> S:
        """Return the parameters of a back end.

        Args:
            kind: its parameter class; the defaults where ``own`` belongs to another back end.
        """
        return self.own if isinstance(self.own, kind) else kind().resolved(self.surface.extent)


class Backend(ABC):
    """Aligns a scan to the model it was built with.

    Only ``name`` and ``align`` must be given; the other attributes and methods have defaults.

    Attributes:
        name: the entry-point name.
        about: what it does, in one line.
        requires: (module, distribution) of each library that it needs.
        get: how to install them.
        parameters: class of its own parameters, the table ``[register.NAME]``; the constructor
            receives them from ``Target.parameters``.
        accuracy: largest error on an exact scan that the contract allows: angle [deg] and share of
            the extent.
        same_bytes: whether its results are the same to the bit on every x86-64 processor.
    """

    name: ClassVar[str]
    about: ClassVar[str] = ""
    requires: ClassVar[tuple[tuple[str, str], ...]] = ()
    get: ClassVar[str] = "install the package that provides it"
    parameters: ClassVar[type[Settings]] = NoParameters
    accuracy: ClassVar[tuple[float, float]] = ACCURACY
    same_bytes: ClassVar[bool] = False

    def __init__(self, target: Target) -> None:  # noqa: B027 (a back end without preparation)
        """Prepare for scans of a target.

        Args:
            target: model, limits and own parameters.

        Raises:
            ImportError: a library cannot be imported.
        """

    @abstractmethod
    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return the pose T_ca that aligns the scan {A} to the model {C}.

        Args:
            points: (n, 3) finite, n >= 1, float32 or float64, possibly strided, in {A} [m].
            guess: initial T_ca, the inverse of the predicted pose.

        Returns:
            T_ca, the number of iterations and whether the iteration converged. If no point has a
            correspondence, the guess and False. An exception, or a pose that is not finite, becomes
            the status FAILED.
        """

    def align_roughly(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca as :meth:`align`. A back end may return early, not converged, where a part of
        the scan shows that no fit is close.

        Args:
            points: as of ``align``.
            guess: as of ``align``.
        """
        return self.align(points, guess)


class HornBackend(Backend):
    """Exact closest points on the model, one fused pass, identical results for any number of
    threads.

    Rejection and stopping are those of :class:`~avsreplay.register.surface_index.IcpParams`: the
    gate starts at ``reach_m``, follows three times the rms of the last pass and never goes below
    0.004 of the extent, or ``gate_m`` if that is less: points further away, at the edges of hidden
    surface, bias the pose. Where the position of the camera is known, only faces that face it are
    matched.

    A model of points is aligned twice, and the pose with the smaller sum of min(d^2, gate_m^2) is
    taken. Along a flat side Horn's iteration ends at false minima between the points, which more
    point-to-plane passes avoid; where the model has holes, these passes can lead away from the
    guess.
    """

    name: ClassVar[str] = "horn"
    accuracy: ClassVar[tuple[float, float]] = (0.001, 1e-05)
    same_bytes: ClassVar[bool] = True  # on every x86-64 processor
    about: ClassVar[str] = (
        "point-to-plane start, then Newton steps to the fixed point of Horn's quaternion ICP on the"
        " mesh itself, C++"
    )
    requires: ClassVar[tuple[tuple[str, str], ...]] = (("avsreplay.register._kernel", "avsreplay"),)
    get: ClassVar[str] = "a C++17 compiler, then pip install ."

    def __init__(self, target: Target) -> None:
        limits = target.limits
        self._index, self._visibility = target.index, target.visibility
        self._cloud, self._gate = not len(target.surface.faces), limits.gate_m
        rule = IcpParams(
            n_max=limits.n_max,
            n_plane=min(PLANE_PASSES, limits.n_max),
            few=FEW_POINTS,
            gate_m=limits.reach_m,
            floor_m=min(limits.gate_m, LEAST_GATE_OF_EXTENT * target.index.extent_m),
            tighten=TIGHTEN,
            eps_rad=limits.eps_rad,
            eps_m=limits.eps_m,
            threads=limits.threads,
        )
        self._rules = {facing: replace(rule, facing=facing) for facing in (False, True)}
        poor_m = ROUGH_OF_GATE * limits.gate_m
        self._rough = {facing: replace(rule, poor_m=poor_m) for facing, rule in self._rules.items()}
        passes = min(CLOUD_PLANE_PASSES, limits.n_max)
        self._more_plane = {
            facing: replace(rule, n_plane=passes) for facing, rule in self._rules.items()
        }

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca, see :class:`avsreplay.register.backend.Backend`."""
        found = self._run(points, guess, self._rules.__getitem__)
        if not self._cloud:
            return found
        other = self._run(points, guess, self._more_plane.__getitem__)
        return min(found, other, key=lambda fit: self._cost(points, fit.T_ca))

    def align_roughly(self, points: NDArray[Any], guess: Pose) -> Fit:
        """Return T_ca as :meth:`align`; of a part of the scan, not converged, if that shows
        that no fit is close.
        """
        return (
            self.align(points, guess)
            if self._cloud
            else self._run(points, guess, self._rough.__getitem__)
        )

    def _cost(self, points: NDArray[Any], T_ca: Pose) -> float:
        sums = self._index.normal_equations(points, T_ca, self._gate)
        return sums.sum_d2 + (sums.points - sums.inliers) * self._gate**2

    def align_within(
        self,
        points: NDArray[Any],
        guess: Pose,
        gate_m: float,
        near: bool = False,
        most: int = MOST_WITHIN,
    ) -> Fit:
        """Return T_ca with correspondences nearer than ``gate_m`` [m] in all passes, at most
        ``most``.

        ``near``: the guess is a registered pose, so that no point-to-plane passes and no passes
        over few points come
        first: they would end further from the result than it is.
        """
        rule = self._rules[False]
        plane, few, most = (
            0 if near else rule.n_plane,
            0 if near else rule.few,
            min(rule.n_max, most),
        )
        within: dict[str, Any] = {"n_max": most, "n_plane": plane, "few": few, "tighten": 0.0}
        # A third of the rejection distance is the noise; a small share of the error that it leaves
        # need not be reached.
        error = SETTLED_ERROR_OF_GATE * gate_m / np.sqrt(max(len(points), 1))
        limits, rad = self._rules[False], error / (RADIUS_OF_EXTENT * self._index.extent_m)
        within.update(
            gate_m=gate_m,
            floor_m=gate_m,
            eps_m=max(limits.eps_m or 0.0, error),
            eps_rad=max(limits.eps_rad, rad),
        )
        return self._run(
            points, guess, lambda facing: replace(self._rules[facing], **within), WITHIN_WORK
        )

    def _run(
        self,
        points: NDArray[Any],
        guess: Pose,
        rules: Callable[[bool], IcpParams],
        work: tuple[int, int] = ALIGN_WORK,
    ) -> Fit:
        """Align with one of the rules; ``work``: most point searches, fixed and per point."""
        most = work[0] + work[1] * max(len(points), LEAST_BUDGET_POINTS)

        def align(start: Pose, facing: bool) -> Fit:
            found = self._index.icp(points, start, rules(facing), most)
            T_ca, rough = Pose.from_matrix(found.T_ca), found.matches is None
            return Fit(T_ca, found.iterations, found.converged, found.matches, rough)

        return self._visibility.consistent(self._index, points, guess, align)


def measured_alignment(found: MeasuredPose) -> Alignment:
    """Return a measured pose as an alignment: no points, and no fit whose quality could be graded.

    Args:
        found: the pose. Where it has no covariance, the estimator uses its R0.
    """
    C = found.covariance
    info = frozen(np.zeros((6, 6)) if C is None else np.linalg.inv(C))
    return Alignment(found.T_ac, 0, True, 0, 0, 0.0, info, AlignStatus.MEASURED, C)


class PoseBackend(Backend):
    """The entry of ``poses`` in the list of back ends; it does not register clouds."""

    name: ClassVar[str] = POSES
    same_bytes: ClassVar[bool] = True
    about: ClassVar[str] = (
        "no registration: the log holds measured poses of a tracker (pose topic, TUM, CSV)"
    )

    def align(self, points: NDArray[Any], guess: Pose) -> Fit:  # noqa: ARG002 (the protocol names them)
        """Raise an error for a cloud, so that its scan has the status FAILED.

        Args:
            points: (n, 3) in {A} [m].
            guess: initial T_ca.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"the back end '{self.name}' takes the poses of the log and cannot align clouds"
        )


@dataclass(frozen=True, slots=True)
class Availability:
    """State of one back end, as listed by ``avsreplay backends``.

    Attributes:
        name: entry-point name.
        installed: it can be built on this installation.
        version: version of the library that it uses, "" if none.
        about: what it does, in one line.
        get: how to install it, "" if it is installed.
        elsewhere: how far its results on another processor can differ.
    """

    name: str
    installed: bool
    version: str
    about: str
    get: str
    elsewhere: str = ""


def load_backend(name: str) -> type[Backend]:
    """Return the class of a back end.

    Raises:
        UsageError: unknown name, or a class that does not derive from ``Backend``.
        MissingBackend: its library is not installed.
    """
    try:
        found = BACKENDS.load(name)
    except ImportError as error:
        raise _missing(name, f"cannot be imported ({error})", REINSTALL) from None
    if not (isinstance(found, type) and issubclass(found, Backend)):
        what = f"'{name}' is registered as a back end and does not derive from Backend"
        raise UsageError(what, where="--backend", hint="see docs/your-own-backend.md")
    state = _availability(name, found)
    if not state.installed:
        raise _missing(name, "is not installed", state.get)
    return found


def create_backend(params: RegisterParams, factory: type[Backend], target: Target) -> Backend:
    """Build a back end.

    Args:
        params: parameters of registration, with those of the back end.
        factory: its class.
        target: what it is built from; its ``own`` is filled in.

    Raises:
        MissingBackend: its library is installed but cannot be imported.
    """
    own = params.own.of(params.backend, factory.parameters).resolved(target.surface.extent)
    try:
        return factory(replace(target, own=own))
    except ImportError as error:
        raise _missing(params.backend, f"cannot be imported ({error})", factory.get) from None


def available() -> tuple[Availability, ...]:
    """Return the state of every registered back end, by name.

    Does not import any registration library.
    """
    return tuple(_state(name) for name in BACKENDS.names())


def _state(name: str) -> Availability:
    try:
        return _availability(name, BACKENDS.load(name))
    except ImportError as error:
        return Availability(
            name,
            False,
            "",
            f"cannot be imported: {error}",
            REINSTALL,
        )


def aligned(name: str, align: Callable[[], Fit]) -> Fit | str:
    """Run a back end. An exception, or a result of a wrong type, is returned as the text of a
    failure.

    Args:
        name: of the back end.
        align: one of its methods with its arguments.
    """
    try:
        fit = align()
        if not isinstance(fit, Fit):
            return f"back end '{name}' returned {type(fit).__name__}, not Fit"
        finite = bool(np.isfinite(fit.T_ca.matrix).all())
    except (
        Exception
    ) as error:  # an error of a library is a status of this scan, not the end of a replay
        return f"back end '{name}' failed: {type(error).__name__}: {error}".splitlines()[0][
            :MESSAGE_LENGTH
        ]
    return fit if finite else f"back end '{name}' returned a pose that is not finite"


def _availability(name: str, factory: type[Backend]) -> Availability:
    """State of a back end whose module could be imported."""
    missing = [m for m, _ in factory.requires if importlib.util.find_spec(m) is None]
    version = "" if missing or not factory.requires else _version(factory.requires[0][1])
    get = factory.get if missing else ""
    return Availability(name, not missing, version, factory.about, get, _elsewhere(factory))


def _elsewhere(factory: type[Backend]) -> str:
    """How far results on another processor can differ: one that stops by its own rule can end
    anywhere within its accuracy.
    """
    if factory.same_bytes:
        return "same bytes"
    degrees, share = factory.accuracy
    return f"within {degrees:g} deg, {share:g} of the extent"


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _missing(name: str, what: str, get: str) -> MissingBackend:
    return MissingBackend(
        f"back end '{name}' {what}", where="--backend", hint=f"install it with: {get}"
    )
