"""The data types that the stages exchange: value classes with read-only float64 arrays.

Frames: {A} camera (inertial), {B} principal axes at the target's centre of mass, {C} grapple
fixture, which is also the frame of the model. ``T_ac`` is the pose of {C} in {A}. SI units and
radians; instants are ``t_ns`` [ns].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from enum import Enum
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import (
    Array,
    MeasuredPose,
    Pose,
    bounding_diagonal,
    frozen,
    matrix,
    multiply,
    rotate,
)

NS_PER_S = 1_000_000_000
MAX_STAMP_S = 2**31 - 2  # a ROS 2 time has 31 bits of seconds
BLOCKS: Mapping[str, slice] = {
    "attitude": slice(0, 3),  # dq_v, half angle, {B}
    "rate": slice(3, 6),  # w_b [rad/s]
    "position": slice(6, 9),  # rho_o [m], {A}
    "velocity": slice(9, 12),  # [m/s], {A}
    "sigma": slice(12, 14),
    "varrho": slice(14, 17),  # [m], {B}
    "mu": slice(17, 20),  # dmu_v, half angle, {B}
}  # the 20 error states by name, in the order of every covariance
STATES: int = max(block.stop for block in BLOCKS.values())  # number of error states
# 99.99 % points of chi-square by degrees of freedom: a squared normalised error above it is not by
# chance. Of the three of a vector, and of the six of a pose.
UNLIKELY = {3: 21.1, 6: 27.86}
# The parts of a state in order, with their sizes.
STATE_SIZES: Mapping[str, int] = {
    "q_ab": 4,
    "w_b": 3,
    "r_a": 3,
    "v_a": 3,
    "sigma": 2,
    "c_b": 3,
    "q_bc": 4,
}
_STATE_SLICES = {
    name: (end - n, end)
    for (name, n), end in zip(STATE_SIZES.items(), accumulate(STATE_SIZES.values()), strict=True)
}


class ScanStatus(Enum):
    """What the reader found about a scan."""

    OK = "ok"
    EMPTY = "empty"  # the message has no finite point
    DAMAGED = "damaged"  # the message could not be decoded
    CLOCK = "clock"  # the stamp is implausible; the log's clock was used instead


class AlignStatus(Enum):
    """What the quality check (register.quality) found of an alignment."""

    ALIGNED = "aligned"
    MEASURED = "measured"  # a pose of the log itself (back end poses): nothing was registered
    NOT_CONVERGED = "not_converged"  # n_max iterations reached; the pose is still graded
    DEGENERATE = "degenerate"  # the view does not determine all six directions
    NO_OVERLAP = "no_overlap"  # too few inliers, whatever the back end reports
    NO_POINTS = "no_points"
    AMBIGUOUS = "ambiguous"  # global search: a second pose fits as well
    FAILED = "failed"  # the back end raised an error or its pose is not finite
    IMPLAUSIBLE = "implausible"  # the scan contradicts the pose (register.plausibility)
    POSTPONED = "postponed"  # not searched, because a search of a scan like it found no pose


class Reason(Enum):
    """Why gamma is 0 (``OK``: gamma is 1): the first rule that holds, in this order."""

    OK = "ok"
    NO_SCAN = "no_scan"  # empty or damaged scan
    FROZEN = "frozen"  # the sensor repeats the scan before although the target moves
    NOT_ALIGNED = "not_aligned"  # no overlap, failed, ambiguous
    NOT_CONVERGED = "not_converged"
    FEW_INLIERS = "few_inliers"
    FIT_ERROR = "fit_error"  # rms_m >= threshold
    HALVES_DIFFER = (
        "halves_differ"  # the poses from two halves of the scan differ by more than their errors
    )
    CLOCK = "clock"  # the stamp steps back or jumps
    SENSOR_BIAS = (
        "sensor_bias"  # the measured poses have a constant offset that motion does not explain
    )
    WRONG_SCAN = "wrong_scan"  # neither a motion nor an error of the sensor explains the poses
    POSE_JUMP = "pose_jump"  # weighted innovation norm >= threshold
    DOUBTFUL = (
        "doubtful"  # unlikely innovation: whether scan, sensor or target is the cause is open
    )


class Moves(Enum):
    """What the poses show of the target's motion."""

    FREE = "free"  # nothing contradicts free motion
    ACCELERATED = "accelerated"  # a constant torque or force acts
    DISTURBED = "disturbed"  # random torques or forces act
    DRIVEN = "driven"  # no free motion explains the poses, which agree with one another


class Admission(Enum):
    """How the rules that use a scan alone permit the estimator to use its pose."""

    REFUSED = "refused"  # nothing
    LARGE = "large"  # to use it where it explains the innovation, which reaches its limit
    ADMITTED = "admitted"  # to use it


class Finding(Enum):
    """The decision of the estimator on a pose, from this pose and those before it."""

    UNTESTED = "untested"  # it was rejected, or its innovation reaches the limit: no further test
    AGREES = "agrees"  # the predicted pose, within its errors
    EXPLAINED = "explained"  # by a change or a disturbance of the motion, or by larger noise
    OPEN = "open"  # not decided yet
    OFFSET = "offset"  # an error of the sensor that lasts
    UNEXPLAINED = "unexplained"  # neither a motion nor an error of the sensor explains it

    @property
    def used(self) -> bool:
        """Return whether the estimate has used the pose."""
        return self in (Finding.AGREES, Finding.EXPLAINED)


@value_class
class Surface:
    """A target model in {C}: a triangle mesh, or a point cloud if ``faces`` is empty.

    Attributes:
        vertices: (n, 3) vertices or points [m].
        faces: (m, 3) vertex indices, int32; those of a closed part point outwards.
        name, sha256, data: name, SHA-256 and bytes of the file of the model.
        reversed: number of faces that were reversed so that they point outwards; None if this was
            not yet examined.
    """

    vertices: Array
    faces: NDArray[np.int32]
    name: str
    sha256: str
    data: bytes = b""
    reversed: int | None = None

    @property
    def extent(self) -> float:
        """Return the diagonal of the bounding box [m]."""
        return bounding_diagonal(self.vertices)


@value_class
class State:
    """Motion and parameters of a target (eq:x): the mean to which the 20 error states refer.

    Attributes:
        q_ab: (4,) attitude of {B} in {A}, quaternion ``[x y z w]``.
        w_b: (3,) angular rate of {B} relative to {A}, in {B} [rad/s].
        r_a: (3,) position of the centre of mass in {A}, the paper's rho_o [m].
        v_a: (3,) velocity of the centre of mass in {A} [m/s].
        sigma: (2,) inertia ratios.
        c_b: (3,) origin of {C} in {B}, the paper's varrho [m].
        q_bc: (4,) attitude of {C} in {B}, the paper's mu.
        flat: (22,) all these numbers in this order; the other arrays are views of it, and the C++
            extension works on it.
    """

    q_ab: Array
    w_b: Array
    r_a: Array
    v_a: Array
    sigma: Array
    c_b: Array
    q_bc: Array
    flat: Array = field(init=False, repr=False)
    _T_ac: Pose | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self._view(
            np.concatenate(
                [frozen(getattr(self, name), b - a) for name, (a, b) in _STATE_SLICES.items()]
            )
        )

    @classmethod
    def of(cls, flat: Array) -> State:
        """Return the state of its 22 numbers, which become read-only.

        Args:
            flat: (22,) q_ab, w_b, r_a, v_a, sigma, c_b, q_bc.
        """
        return cls.__new__(cls)._view(flat)

    def _view(self, flat: Array) -> State:
        flat.setflags(write=False)
        object.__setattr__(self, "flat", flat)
        object.__setattr__(self, "_T_ac", None)
        for name, (a, b) in _STATE_SLICES.items():
            object.__setattr__(self, name, flat[a:b])
        return self

    @property
    def T_ac(self) -> Pose:
        """Return the pose of {C} in {A}: A(eta) = A(q) A(mu), rho = rho_o + A(q) varrho; it
        is computed once.
        """
        pose = self._T_ac or Pose.composed(self.q_ab, self.r_a, self.q_bc, self.c_b)
        object.__setattr__(self, "_T_ac", pose)
        return pose

    @property
    def fixture_velocity(self) -> Array:
        """Return the (3,) velocity of the origin of {C} in {A} [m/s] (section 8)."""
        return self.v_a + rotate(matrix(self.q_ab), np.cross(self.w_b, self.c_b))


@value_class
class Label:
    """An injected fault: its kind and the interval on the log clock in which it acts."""

    kind: str
    start_ns: int
    end_ns: int
    harmful: bool = True
    strength: float | None = None


@value_class
class Scan:
    """One point cloud, or one measured pose, as the reader returns it.

    Attributes:
        seq: index in the replay, from 0.
        t_ns: instant of the scan on the selected clock [ns].
        log_ns: time at which the log received it [ns].
        points: (n, 3) finite points in {A} [m]; the array may be strided.
        sensor: pose of the sensor in {A}; None if the frame of the sensor is {A}.
        times_s: (n,) instant of each point after ``t_ns`` [s], or None.
        intensities: (n,) intensity of each point, or None.
        places: (n,) share of the message that precedes each point, or None.
        dropped_points: number of points that were left out because they were not finite.
        frame: frame that the message names, or "".
        note: what was wrong with the message, or "".
        pose: the measured pose, in place of points.
    """

    seq: int
    t_ns: int
    points: NDArray[Any]
    status: ScanStatus = ScanStatus.OK
    times_s: NDArray[Any] | None = None
    dropped_points: int = 0
    note: str | None = None
    log_ns: int = 0
    frame: str = ""
    pose: MeasuredPose | None = None
    intensities: NDArray[Any] | None = None
    places: NDArray[Any] | None = None
    sensor: Pose | None = None

    def keep(self, kept: NDArray[np.bool_]) -> Scan:
        """Return the scan with the points that ``kept`` (n,) selects."""
        each = (self.times_s, self.intensities, self.places)
        times, seen, places = (None if column is None else column[kept] for column in each)
        return replace(
            self, points=self.points[kept], times_s=times, intensities=seen, places=places
        )


@value_class
class Truth:
    """Ground truth at a scan, for scoring only: T_ac, full state and label of the injected
    fault, None if unknown.
    """

    pose: Pose | None = None
    state: State | None = None
    fault: str | None = None

    def at_image(self, image: Pose) -> Truth:
        """Return the truth about an image of {C} under a symmetry of the model.

        Args:
            image: pose of the image in {C}.
        """
        x, pose = self.state, None if self.pose is None else self.pose @ image
        if x is not None:
            c_b = x.c_b + matrix(x.q_bc) @ image.t
            q_bc = multiply(x.q_bc, image.q)
            x = State(x.q_ab, x.w_b, x.r_a, x.v_a, x.sigma, c_b, q_bc)
        return Truth(pose, x, self.fault)


@value_class
class LogHeader:
    """The metadata of a log, with which it can be replayed without options.

    Attributes:
        surface: the model of the target.
        scenario: TOML text of the scenario, "" for a recorded log.
        seed: seed of the scenario.
        labels: the injected faults.
        start: the initial belief.
        truth: the true state at the first scan.
        notes: remarks by name.
        fixed_frame: frame of start, truth and poses; "" if it is that of the clouds.
        sensor_at_stamp: whether points with times are in the frame of the sensor at the stamp of
            their cloud.
    """

    surface: Surface | None = None
    scenario: str = ""
    seed: int | None = None
    labels: tuple[Label, ...] = ()
    start: Belief | None = None
    truth: State | None = None
    notes: Mapping[str, str] = field(default_factory=dict)
    fixed_frame: str = ""
    sensor_at_stamp: bool = False


@value_class
class Fit:
    """What a registration back end returns.

    Attributes:
        T_ca: pose of {A} in {C}: takes the points of the scan into the frame of the model.
        iterations: number of iterations.
        converged: whether the back end itself reports convergence.
        matches: correspondences of an ``IcpResult``, or None.
        rough: whether only a part of the scan was used.
    """

    T_ca: Pose
    iterations: int
    converged: bool
    matches: Any = None
    rough: bool = False


@value_class
class Alignment:
    """A pose with its quality, measured in the same way for every back end (register.quality).

    Attributes:
        T_ac: the measured pose of {C} in {A}.
        well_off: of 1,000 points, the number of those farther than two gates from the model.
        info: (6, 6) information of the error d = [theta; v] in {C} [rad, m], with T_ac_true = T_ac
            @ Exp(d); it may be singular.
        covariance: (6, 6) covariance of d; None for a degenerate alignment.
        dof: degrees of freedom of this covariance as an estimate.
        systematic: the part of the covariance that errors of the model and of the ranges cause.
        message: why the registration failed or is not accepted, "" otherwise.
        free_directions: in words, the directions of motion that the scan does not determine.
        free: (6, k) these directions as columns d.
        members: of an ambiguous alignment, the poses T_ac that explain the scan, the registered one
            first.
        equal: whether no scan can tell these poses apart, because exact symmetries of the model
            carry one onto another.
        split_nis, size, size_1s: see ``register.quality``; the size of the target relative to the
            model and its standard deviation.
    """

    T_ac: Pose
    iterations: int
    converged: bool
    points: int
    inliers: int
    rms_m: float
    info: Array
    status: AlignStatus
    covariance: Array | None = None
    free_directions: str = ""
    message: str = ""
    split_nis: float | None = None
    dof: float = float("inf")
    free: Array | None = None
    well_off: int = 0
    size_1s: float | None = None
    systematic: Array | None = None
    size: tuple[float, float] | None = None
    members: tuple[Pose, ...] = ()
    equal: bool = False

    @property
    def measured(self) -> bool:
        """Return whether ``T_ac`` is a measurement and not only the initial guess."""
        s = AlignStatus
        return self.status in (s.ALIGNED, s.MEASURED, s.NOT_CONVERGED, s.DEGENERATE, s.AMBIGUOUS)

    @property
    def inlier_ratio(self) -> float:
        """Return the share of inliers among the points, 0 for an empty scan."""
        return self.inliers / self.points if self.points else 0.0


@value_class
class Belief:
    """Mean and covariance (20, 20) of the error states at an instant; dq_v and dmu_v are vectors of
    half angles.
    """

    t_ns: int
    x: State
    P: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "P", frozen(self.P, 20, 20))


@value_class
class Innovation:
    """Innovation alpha = z - h(x-) of z = (rho, deta_v) [m, half angle] and its covariance.

    Attributes:
        alpha: (6,) the innovation.
        S: (6, 6) its covariance H P H' + R.
        R: (6, 6) covariance of the measurement noise that was used.
        nis: normalised innovation squared, alpha' S^-1 alpha.
        distance_m: length of its position part [m].
        angle_rad: angle of its attitude part [rad].
        weight: Cauchy weight of the measurement.
        share: share of R that is correlated between neighbouring views.
        rms_m, free: fit error and undetermined directions of the alignment.
        dof: degrees of freedom of R as an estimate, infinite if R is known.
        chi2: the NIS, which follows Hotelling's T^2 where R is estimated, converted to a chi-square
            value.
    """

    alpha: Array
    S: Array
    R: Array
    nis: float
    chi2: float
    distance_m: float
    angle_rad: float
    weight: float = 1.0
    share: float = 0.0
    rms_m: float = float("nan")
    dof: float = float("inf")
    free: Array | None = None


@value_class
class Verdict:
    """The decision of the fault detector: gamma 1 (healthy) or 0 (faulty), and the reason."""

    gamma: int
    reason: Reason


@value_class
class Manoeuvre:
    """A change of the target's velocity that free motion does not explain.

    Attributes:
        t_ns, t_1s_s: most likely instant [ns] and its standard deviation [s].
        detected_ns: instant of the scan at which it was detected [ns].
        P: (6, 6) covariance of the changes (rate, velocity).
        velocity: (3,) change of the velocity of the centre of mass in {A} [m/s].
        rate: (3,) change of the angular rate in {B} [rad/s].
    """

    t_ns: int
    t_1s_s: float
    velocity: Array
    rate: Array
    P: Array
    detected_ns: int


class Drift(Manoeuvre):
    """A constant acceleration since ``t_ns``: ``rate`` in {C} [rad/s2] by a torque,
    ``velocity`` [m/s2] by a force.
    """


@value_class
class Forecast:
    """Predicted standard deviations (n,) of the grasp point, each the root of the trace of its 3x3
    covariance.

    ``times_s`` [s after now]; ``pos_1s_m``, ``vel_1s_mps``, ``rot_1s_rad``: position, velocity,
    attitude (full angle); ``lasting``: 1 sigma of the part of position [m] and attitude [rad] that
    no further pose reduces.
    """

    times_s: Array
    pos_1s_m: Array
    vel_1s_mps: Array
    rot_1s_rad: Array
    lasting: tuple[float, float] = (0.0, 0.0)


@value_class
class Possible:
    """A change of the motion that the last scans make possible.

    Attributes:
        probability: that it has happened.
        errors: root mean square of the error of the grasp point that it has then caused.
    """

    probability: float
    errors: Forecast


Trajectory = Callable[
    [Array], tuple[Array, Array]
]  # times (n,) [s] -> r (n, 3) [m], v (n, 3) [m/s] of {C} in {A}
