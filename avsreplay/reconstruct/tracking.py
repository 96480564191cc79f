"""Tracking of an unknown target: each scan is registered against the model of the scans
before it; its free motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import value_class
from avsreplay.estimate.batch import Problem
from avsreplay.estimate.chart import Chart, to_errors
from avsreplay.estimate.dynamics import propagate_state
from avsreplay.estimate.initialise import PoseFix, poses_of, weak_prior
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.reference import free_fit
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.registration import (
    Match,
    Patchwork,
    best_starts,
    near_attitudes,
    registered,
)
from avsreplay.reconstruct.views import ScanView, Twist, averaged, depth_behind, point_tree, turn
from avsreplay.records import BLOCKS, State
from avsreplay.register import sampling

MOTION_POSES = 8  # fewest poses to which free motion is fitted
LEAST_AGREEING_POSES_SHARE = 0.7  # share of the poses that must agree with it
MOTION_RMS_OF_EXTENT = 0.01  # largest deviation of these on the surface, as a share of the extent


@value_class
class FreeMotion:
    """One torque-free and force-free motion of a rigid body through poses.

    Attributes:
        state: state at the instant ``epoch_ns``, and covariance (20, 20) of its error states.
        agrees: (n,) whether each pose agrees with the motion.
        rms: of the deviations of the poses that agree: angle [rad] and distance [m].
    """

    state: State
    P: Array
    epoch_ns: int
    agrees: NDArray[np.bool_]
    rms: tuple[float, float]

    def state_at(self, t_ns: int) -> State:
        """The state at an instant.

        Args:
            t_ns: the instant [ns].
        """
        return propagate_state(self.state, (t_ns - self.epoch_ns) * 1e-9)[0]

    def at(self, t_ns: int) -> Pose:
        """The pose T_ac at an instant.

        Args:
            t_ns: the instant [ns].
        """
        return self.state_at(t_ns).T_ac

    def pose_jacobian(
        self, chart: Chart, t_ns: Sequence[int], poses: Sequence[Pose], extent: float
    ) -> tuple[Array, Array]:
        """Derivatives of poses of the motion by its initial values, and the information of the weak
        prior of these.

        Args:
            chart: initial values at ``epoch_ns``.
            t_ns: instants (n).
            poses: T_ac of the motion at these instants.
            extent: of the target [m].

        Returns:
            (6n, 20) derivative of [theta; v] in {C} [rad, m] by steps of the chart, and (20, 20)
            information.
        """
        fixes = tuple(PoseFix(at, T, np.eye(6)) for at, T in zip(t_ns, poses, strict=True))
        measured = poses_of(fixes, self.epoch_ns)
        prior = weak_prior(measured, EstimatorParams().resolved(extent))
        _, H = Problem(measured, prior, np.ones(2), chart).core.rows()
        J: Array = (H @ to_errors(chart)).reshape(-1, H.shape[2])
        return J, np.diag(prior.one_sigma**-2.0)

    def twist_at(self, t_ns: int) -> Twist:
        """Pose, rate in {C} and velocity of {C} in {A} at an instant.

        Args:
            t_ns: the instant [ns].
        """
        x = self.state_at(t_ns)
        return Twist(x.T_ac, geometry.matrix(x.q_bc).T @ x.w_b, x.fixture_velocity)

    @property
    def mass_centre_c(self) -> tuple[Array, float]:
        """Position (3,) of the mass centre in {C} [m] and its 1 sigma, the root of the trace
        [m].
        """
        spread = float(np.sqrt(np.trace(self.P[BLOCKS["varrho"], BLOCKS["varrho"]])))
        return -geometry.matrix(self.state.q_bc).T @ self.state.c_b, spread


def free_motion(t_ns: Sequence[int], poses: Sequence[Pose], extent: float) -> FreeMotion | None:
    """Fit the free motion of a rigid body to poses.

    Args:
        t_ns: instants, ascending.
        poses: T_ac at these instants.
        extent: of the target [m].

    Returns:
        The motion, or None if the poses are too few or do not follow one: at least
        LEAST_AGREEING_POSES_SHARE of them must agree, and those must deviate by less than
        MOTION_RMS_OF_EXTENT of the extent on the surface. A turntable that is turned by hand, or
        scans without real instants, do not.
    """
    if len(poses) < MOTION_POSES or np.diff(t_ns).min() <= 0:
        return None
    fitted = free_fit(t_ns, poses, None, extent)
    agrees = np.asarray(fitted.weights > 0.5)
    if agrees.mean() < LEAST_AGREEING_POSES_SHARE:
        return None
    squares = np.square(fitted.d[agrees])
    angle, distance = (
        float(np.sqrt(squares[:, k].sum(axis=1).mean())) for k in (slice(0, 3), slice(3, 6))
    )
    if not np.hypot(0.5 * extent * angle, distance) < MOTION_RMS_OF_EXTENT * extent:
        return None
    return FreeMotion(fitted.x, fitted.P, t_ns[0], agrees, (angle, distance))


def twists(
    t_ns: Sequence[int], poses: dict[int, Pose], motion: FreeMotion | None
) -> dict[int, Twist]:
    """Motion of the target at every view that has a pose: of the free motion, else from its
    neighbours' poses.

    Args:
        t_ns: stamp of each view [ns].
        poses: T_ac by number of the view.
        motion: the free motion; None where there is none.
    """
    known = sorted(poses)
    found = {}
    for place, k in enumerate(known):
        if motion is not None:
            found[k] = motion.twist_at(t_ns[k])
            continue
        a, b = known[max(place - 1, 0)], known[min(place + 1, len(known) - 1)]
        span = max((t_ns[b] - t_ns[a]) * 1e-9, 1e-9)
        w_c = geometry.log(geometry.multiply(geometry.conjugate(poses[a].q), poses[b].q)) / span
        found[k] = Twist(poses[k], w_c, (poses[b].t - poses[a].t) / span)
    return found


LEAST_ON_MODEL_SHARE = 0.4  # share of the points of a scan that must lie on the model so far
# largest distance of the target's centre from its prediction, as a share of the extent
MAX_SHIFT_OF_EXTENT = 0.4
SHIFT_PER_LOST = 0.01  # increase of that share with every scan that was lost before
LEAST_VISIBLE_SHARE = 0.15  # share of the model's visible side that a scan must show
# share of points that may lie in the free space in front of what another view has measured
MAX_FREE_SPACE_SHARE = 0.12
GRAZING = np.cos(
    np.radians(70.0)
)  # least cosine of the inclination to a line of sight for a test of free space
FREE_SPACE_POINTS = 600  # points of a scan in one test of free space
# while the target is lost, all attitudes are searched for two scans of this many
SEARCH_PERIOD_SCANS = 6
LARGE_STEP_RAD = np.radians(
    30.0
)  # a registration after a larger step may end at another pose of a similar side
# scans whose poses are not certain that are searched again in the complete model
MAX_CONFIRMED_SCANS = 6
# such a pose is ambiguous if another one explains this share of the points that it explains
RIVAL_SHARE = 0.8
DISTINCT_RAD = np.radians(60.0)  # starts nearer to the pose mostly lead back to it
MAX_RETRIED_SCANS = 20  # lost scans that are tried again at the end
KEY_TURN_RAD = np.radians(
    7.0
)  # a scan seen from a direction that differs by this from all key scans becomes one


@dataclass(frozen=True, slots=True)
class ReconstructionParams:
    """Resolution and effort of a reconstruction; lengths are fractions of the extent of the first
    scan.

    Attributes:
        voxel: edge of the voxels of the fused model.
        thin: edge of the voxels to which scans are thinned for registration.
        fine: edge of the voxels to which they are thinned for the fit of the motion to all scans.
        reach: largest distance of corresponding points at the first iteration.
        fewest_points: scans with fewer points are not used.
        n_scans: most scans that are used; a longer log is thinned evenly.
        refinements: most Gauss-Newton iterations of one of the two adjustments of all poses.
    """

    voxel: float = 1.0 / 300.0
    thin: float = 1.0 / 120.0
    fine: float = 1.0 / 240.0
    reach: float = 0.06
    fewest_points: int = 100
    n_scans: int = 400
    refinements: int = 4


@dataclass(slots=True, eq=False)
class Tracked:
    """Poses by number of the view, key views, views found by a search, scans lost in a row,
    ``weakest`` of a match.
    """

    poses: dict[int, Pose]
    keys: list[int]
    searched: list[int]
    lost: int
    weakest: list[float]


def track(views: Sequence[ScanView], p: ReconstructionParams, extent: float) -> Tracked:
    """Register every view against the model that the key views before it give; then try the
    lost ones once more.

    Args:
        views: the views, in order of time.
        p: the parameters of the reconstruction.
        extent: diameter of the target [m].
    """
    origin = views[0].points.mean(axis=0)
    found = Tracked({0: Pose(geometry.IDENTITY_QUAT, origin)}, [0], [], 0, [])
    model = patchwork(views, found, p.thin * extent)
    for k in range(1, len(views)):
        model = _tracked(views, found, k, model, p, extent)
    lost = [k for k in range(len(views)) if k not in found.poses]
    found.lost = 0
    for k in lost[:: max(1, -(-len(lost) // MAX_RETRIED_SCANS))]:
        model = _tracked(views, found, k, model, p, extent)
    return found


def without(found: Tracked, wrong: Sequence[int]) -> Tracked:
    """The result of tracking without the views that have these numbers.

    Args:
        found: the result of tracking.
        wrong: numbers of the views that are left out.
    """
    poses = {k: T for k, T in found.poses.items() if k not in wrong}
    return replace(found, poses=poses, keys=[k for k in found.keys if k in poses])


def _tracked(
    views: Sequence[ScanView],
    found: Tracked,
    k: int,
    model: Patchwork,
    p: ReconstructionParams,
    extent: float,
) -> Patchwork:
    """Register view k from its prediction, else by a search, note the result, and return the model
    that it gives.
    """
    guess = _predicted(views, found, k, extent)
    match = registered(views[k], model, guess, p.reach * extent, extent)
    if not _accepted(match, guess, views, found, k, model, extent):
        searched = _searched(views, found, k, model, guess, p, extent)
        if searched is None:
            found.lost += 1
            return model
        match = searched
        found.searched.append(k)
    found.lost, found.poses[k] = 0, match.T_ac
    found.weakest.append(match.weakest)
    if not _new_side([found.poses[j] for j in found.keys], match.T_ac):
        return model
    found.keys.append(k)
    return patchwork(views, found, p.thin * extent)


def _accepted(
    match: Match,
    guess: Pose,
    views: Sequence[ScanView],
    found: Tracked,
    k: int,
    model: Patchwork,
    extent: float,
) -> bool:
    """Whether scan and model explain each other and no measured ray passes through a surface of the
    other.

    The target must also be near its predicted position, because another object in front of it fits
    to some flat side.
    """
    if match.ratio < LEAST_ON_MODEL_SHARE or match.rms_m > 0.01 * extent:
        return False
    centre = model.points.mean(axis=0)
    shift = float(np.linalg.norm(match.T_ac.apply(centre) - guess.apply(centre)))
    if shift > (MAX_SHIFT_OF_EXTENT + SHIFT_PER_LOST * found.lost) * extent:
        return False
    if _explained(views[k], model, match.T_ac, extent) < LEAST_VISIBLE_SHARE:
        return False
    near = sorted(found.keys, key=lambda j: turn(found.poses[j], match.T_ac))[:3]
    return all(
        _violation(views, found.poses[j], match.T_ac, j, k, extent) < MAX_FREE_SPACE_SHARE
        for j in near
    )


def _explained(view: ScanView, model: Patchwork, T_ac: Pose, extent: float) -> float:
    """Share of the model's side toward the camera that a scan shows; small for a scan of
    something else.
    """
    every = max(1, len(model.points) // 1500)
    p, n = T_ac.apply(model.points[::every]), model.normals[::every] @ T_ac.R.T
    lines = view.camera - p
    facing = np.einsum("ni,ni->n", n, lines) > GRAZING * np.linalg.norm(lines, axis=1)
    if not facing.any():
        return 0.0
    near, _ = view.tree.query(p[facing], most_m=0.03 * extent)
    return float(np.isfinite(near).mean())


def _violation(
    views: Sequence[ScanView], T_j: Pose, T_k: Pose, j: int, k: int, extent: float
) -> float:
    """Share of the points of each of two views that lie in front of the surface which the other has
    measured.

    Points whose surface is inclined to the other line of sight by more than 70 degrees are left
    out: the depth of such a surface changes by more than the tolerance between neighbouring rays.
    """
    shares = []
    for a, T_a, b, T_b in ((views[k], T_k, views[j], T_j), (views[j], T_j, views[k], T_k)):
        T_ba = T_b @ T_a.inverse()
        every = max(1, len(a.points) // FREE_SPACE_POINTS)
        p, n = (
            T_ba.apply(a.points[::every]),
            a.normals[::every] @ T_ba.R.T,
        )  # in {A} at the instant of b
        lines = b.camera - p
        facing = np.einsum("ni,ni->n", n, lines) > GRAZING * np.linalg.norm(lines, axis=1)
        in_front = (
            depth_behind(p[facing], b.points, b.camera, 0.03 * extent, b.rays) > 0.03 * extent
        )
        shares.append(float(in_front.sum()) / max(len(p), 1))
    return max(shares)


def _searched(
    views: Sequence[ScanView],
    found: Tracked,
    k: int,
    model: Patchwork,
    guess: Pose,
    p: ReconstructionParams,
    extent: float,
) -> Match | None:
    """The best acceptable match from turned guesses: first about the prediction, then over
    all attitudes.
    """
    turned = [near_attitudes(guess.q)]
    if found.lost % SEARCH_PERIOD_SCANS < 2:
        turned.append(sampling.attitudes(400))
    for attitudes in turned:
        for start in best_starts(views[k], model, attitudes, 2.0 * p.reach * extent, extent):
            fine = registered(views[k], model, start, p.reach * extent, extent)
            if _accepted(fine, guess, views, found, k, model, extent):
                return fine
    return None


def ambiguous(
    views: Sequence[ScanView], found: Tracked, p: ReconstructionParams, extent: float
) -> bool:
    """Whether most of the views whose poses are not certain fit the complete model at another pose
    as well.

    A search, or a registration after a large step, finds one of several poses of a target that
    looks alike from different sides. A model that was joined at a wrong one of them looks alike
    from both.

    Args:
        views: of the log.
        found: their poses after the refinement.
        p: resolution.
        extent: of the target [m].
    """
    used = sorted(found.poses)
    known = [k for k in used if k in found.searched]
    known = known or [
        k for j, k in pairwise(used) if turn(found.poses[j], found.poses[k]) > LARGE_STEP_RAD
    ]
    if not known:
        return False
    known = known[:: max(1, -(-len(known) // MAX_CONFIRMED_SCANS))]
    model, count = patchwork(views, replace(found, keys=used), p.thin * extent), 0
    for k in known:
        own = found.poses[k]
        least = RIVAL_SHARE * registered(views[k], model, own, p.reach * extent, extent).ratio
        others = [q for q in sampling.attitudes(400) if turn(Pose(q, own.t), own) > DISTINCT_RAD]
        starts = best_starts(views[k], model, np.array(others), 2.0 * p.reach * extent, extent)
        fine = [registered(views[k], model, start, p.reach * extent, extent) for start in starts]
        count += any(
            match.ratio > least and turn(match.T_ac, own) > 0.5 * DISTINCT_RAD for match in fine
        )
    return 2 * count > len(known)


def _new_side(keys: Sequence[Pose], T_ac: Pose) -> bool:
    """Whether the direction of view differs from those of all key views."""
    return bool(min(turn(key, T_ac) for key in keys) > KEY_TURN_RAD)


def patchwork(views: Sequence[ScanView], found: Tracked, size_m: float) -> Patchwork:
    """The model that the key views give, averaged over voxels of the given size.

    Args:
        views: the views, in order of time.
        found: the result of tracking.
        size_m: edge of a voxel [m].
    """
    each = [(found.poses[k].inverse(), views[k]) for k in found.keys]
    points, normals = (
        [T.apply(view.points) for T, view in each],
        [view.normals @ T.R.T for T, view in each],
    )
    mean, normal, _ = averaged(np.vstack(points), np.vstack(normals), size_m)
    return Patchwork(mean, normal, point_tree(mean))


def _predicted(views: Sequence[ScanView], found: Tracked, k: int, extent: float) -> Pose:
    """The pose at view k by the constant twist, in {C}, of the last poses; after a gap by
    free motion if it fits.
    """
    known = sorted(found.poses)
    before = [j for j in known if j < k] or known[:1]
    last = before[-1]
    intervals = np.diff([views[j].t_ns for j in known])
    if (
        k - last > 1
        and len(intervals)
        and views[k].t_ns - views[last].t_ns > 2.0 * np.median(intervals)
    ):
        motion = free_motion(
            [views[j].t_ns for j in known], [found.poses[j] for j in known], extent
        )
        if motion is not None:
            return motion.at(views[k].t_ns)
    if len(before) < 2:
        return found.poses[last]
    first = before[max(-4, -len(before))]
    span = (views[last].t_ns - views[first].t_ns) * 1e-9
    ahead = (views[k].t_ns - views[last].t_ns) * 1e-9
    a, b = found.poses[first], found.poses[last]
    turn = geometry.log(geometry.multiply(geometry.conjugate(a.q), b.q)) * (ahead / span)
    return Pose(geometry.multiply(b.q, geometry.exp(turn)), b.t + (b.t - a.t) * (ahead / span))
