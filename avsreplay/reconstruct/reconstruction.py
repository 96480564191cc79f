"""Reconstruct the model of an unknown target from the scans of a log, without a model and without
an initial guess.

(1) Tracking: each scan is registered against the model so far by point-to-plane ICP with an
M-estimator, from a prediction; where that fails, a global search finds the pose. Scans whose points
have times of their own are then moved to one instant by the motion that was found, and tracked once
more. (2) Batch refinement: the poses of the key scans minimise the point-to-plane distances between
all pairs of key scans that overlap, including pairs that see the same side again after a turn (loop
closure). The free motion of a rigid body is fitted to all poses; it replaces them if it explains
the scans as well. (3) Fusion: points and normals are averaged over the scans in a voxel grid; a
voxel through which rays of other scans have passed is removed (free-space carving by vote).

The frame {C} of the model is fixed to the target. Its axes are those of {A} at the first scan that
is used, and its origin is the centroid of that scan, until ``at_grasp`` moves it to a grasp point.
Ground truth is never read. The scans are read several times, one by one: memory holds thinned views
and the full points of a bounded number of scans.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from avsreplay.errors import UnreadableInput, value_class
from avsreplay.geometry import Array, Pose
from avsreplay.reconstruct.fusion import (
    MISSED_SHARE,
    all_poses,
    contradicting,
    fused,
    joint_motion,
    refined,
    refuted,
    turn_and_coverage,
)
from avsreplay.reconstruct.model import (
    Deviations,
    Reconstruction,
    at_grasp,
    deviations,
    meshed,
    reconstruction_ply,
    surface_of,
)
from avsreplay.reconstruct.registration import pair_rms
from avsreplay.reconstruct.tracking import (
    FreeMotion,
    ReconstructionParams,
    Tracked,
    ambiguous,
    free_motion,
    track,
    twists,
    without,
)
from avsreplay.reconstruct.views import ScanView, Survey, surveyed, surveyed_scans, thinned_view
from avsreplay.records import Scan

__all__ = [
    "Deviations",
    "Reconstruction",
    "ReconstructionParams",
    "at_grasp",
    "deviations",
    "meshed",
    "reconstruct",
    "reconstruction_ply",
    "surface_of",
    "true_frame",
]

# below this ratio of the eigenvalues of a registration, a surface leaves three directions open
WEAKEST_EIGENVALUE_RATIO = 1e-3
# free motion replaces the refined poses if it increases the rms between scans by no more than this
MAX_RMS_RATIO = 1.01
STILL_RAD = np.radians(5.0)  # a target that turned by less is at rest
# times views that contradict the others are left out and the poses are refined again
MAX_REFINEMENT_ROUNDS = 6
LEAST_CONFIRMING_POSES = 10  # fewest poses that test the 20 parameters of a free motion
MAX_FUSED_SCANS = 150  # scans whose points are averaged; more are thinned evenly
Scans = Callable[[], Iterable[Scan]]


@value_class
class Assembly:
    """Views that agree with one another.

    Attributes:
        views: with the normals of all key views together.
        tracked: the views that were not left out.
        keys: T_ac of the key views.
        poses: T_ac of all views that are used.
        motion: free motion that the poses follow, or None.
        rms: of the distances between the views [m].
        gate: largest distance that counted [m].
        missed: share of the surface in the direction of each view that contradicts it.
        refuted: whether views contradict one another after MAX_REFINEMENT_ROUNDS.
        left_out: number of views that were left out.
    """

    views: list[ScanView]
    tracked: Tracked
    keys: dict[int, Pose]
    poses: dict[int, Pose]
    motion: FreeMotion | None
    rms: float
    gate: float
    missed: Array
    refuted: bool
    left_out: int


def reconstruct(scans: Scans, params: ReconstructionParams | None = None) -> Reconstruction:
    """Build a model of the target from its scans.

    Args:
        scans: gives the scans of a log from its begin, in order of time, each time it is called;
            their ground truth, if any, is not used.
        params: resolution and effort.

    Returns:
        The model in {C}, with poses of the scans that were used.

    Raises:
        UnreadableInput: fewer than three usable scans, steps between scans that are too large,
            scans that contradict one another, or a target that did not turn or has no shape that
            determines its pose; the message states which.
    """
    p = params or ReconstructionParams()
    survey = surveyed(scans, p.fewest_points, p.n_scans)
    if len(survey.chosen) < 3:
        what = (
            f"only {len(survey.chosen)} of {survey.offered} scans have {p.fewest_points} points or"
            " more"
        )
        raise UnreadableInput(what, hint="a model needs three at least")
    views, tracked = _tracked(scans, survey, p)
    found = _assembled(views, tracked, p, survey.extent)
    poses, motion, tracked, rms = found.poses, found.motion, found.tracked, found.rms
    turned, coverage = turn_and_coverage([views[k] for k in poses], list(poses.values()))
    _refuse_undetermined(turned, tracked.weakest)
    _refuse_contradictions(found)
    if motion is None:
        _refuse_unconfirmed(found.views, replace(tracked, poses=poses), p, survey.extent)
    else:
        fine = _fine_views(scans, survey, found, motion, p)
        motion = joint_motion(
            found.views, fine, motion, found.gate, p.thin * survey.extent, survey.extent
        )
        poses = _on_motion(found, motion)
    chosen = evenly(sorted(poses), MAX_FUSED_SCANS)
    twist = twists([view.t_ns for view in views], poses, motion if survey.timed else None)
    points, normals, one_sigma_m, seen, sights = fused(
        surveyed_scans(scans, survey),
        survey,
        {k: twist[k] for k in chosen},
        p.voxel * survey.extent,
        rms,
    )
    each = tuple((views[k].t_ns, T) for k, T in sorted(poses.items()))
    return Reconstruction(
        points,
        normals,
        one_sigma_m,
        seen,
        poses=each,
        used=len(each),
        offered=survey.offered,
        searches=len(tracked.searched),
        coverage=coverage,
        turn_deg=float(np.degrees(turned)),
        rms_m=rms,
        voxel_m=p.voxel * survey.extent,
        notes=_notes(len(poses), len(views), found.left_out, coverage),
        motion=motion,
        sights=tuple(sights),
        frame=(
            "origin at the centroid of the first scan, axes parallel to those of the camera at that"
            " scan"
        ),
    )


def true_frame(made: Reconstruction, truth: Iterable[tuple[int, Pose]]) -> Pose | None:
    """The constant transformation from the true frame {C} to the reconstructed one, for the
    comparison of poses.

    The frame of a reconstruction is arbitrary. It is related to the true frame by the mean over all
    scans, so that the error of a single pose does not appear in the errors of all others. The mean
    attitude is the eigenvector of F. L. Markley et al., Averaging quaternions, Journal of Guidance,
    Control, and Dynamics 30(4), 2007.

    Args:
        made: the reconstruction.
        truth: instants [ns] and true poses T_ac.

    Returns:
        The pose of the reconstructed {C} in the true {C}; None if no scan has a true pose.
    """
    true = dict(truth)
    each = [true[t_ns].inverse() @ T_ac for t_ns, T_ac in made.poses if t_ns in true]
    if not each:
        return None
    q = np.array([T.q for T in each])
    return Pose(np.linalg.eigh(q.T @ q)[1][:, 3], np.mean([T.t for T in each], axis=0))


def _tracked(
    scans: Scans, survey: Survey, p: ReconstructionParams
) -> tuple[list[ScanView], Tracked]:
    """The thinned views and their poses; scans with times of their own are deskewed and
    tracked twice.
    """
    size_m = p.thin * survey.extent
    views = [thinned_view(scan, survey, size_m) for scan in surveyed_scans(scans, survey)]
    tracked = track(views, p, survey.extent)
    if survey.timed and len(tracked.poses) > 2:
        instants = [view.t_ns for view in views]
        known = sorted(tracked.poses)
        motion = free_motion(
            [instants[k] for k in known], [tracked.poses[k] for k in known], survey.extent
        )
        twist = twists(instants, tracked.poses, motion)
        views = [
            thinned_view(scan, survey, size_m, twist.get(k))
            for k, scan in enumerate(surveyed_scans(scans, survey))
        ]
        tracked = track(views, p, survey.extent)
    _refuse_few(tracked, views)
    return views, tracked


def _fine_views(
    scans: Scans, survey: Survey, found: Assembly, motion: FreeMotion, p: ReconstructionParams
) -> dict[int, ScanView]:
    """The key views with more points."""
    size_m, timed = p.fine * survey.extent, survey.timed
    each = ((k, scan) for k, scan in enumerate(surveyed_scans(scans, survey)) if k in found.keys)
    return {
        k: thinned_view(scan, survey, size_m, motion.twist_at(scan.t_ns) if timed else None)
        for k, scan in each
    }


def _refuse_few(tracked: Tracked, views: Sequence[ScanView]) -> None:
    if len(tracked.poses) < 3:
        turn = f"only {len(tracked.poses)} of {len(views)} scans could be registered to one another"
        hint = (
            "the steps between scans are too large, or too much of the target is hidden: record"
            " more scans"
        )
        raise UnreadableInput(turn, hint=hint)


def _assembled(
    views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float
) -> Assembly:
    """Refine the poses; while views contradict the others, leave these out and refine again.

    If the views contradict one another, but none far more often than the others, the worst one is
    left out.
    """
    left_out = 0
    for _ in range(MAX_REFINEMENT_ROUNDS):
        better, keys, rms, gate = refined(views, tracked, p, extent)
        poses = all_poses(better, tracked, keys, p, extent)
        used = sorted(poses)
        motion = free_motion([views[k].t_ns for k in used], [poses[k] for k in used], extent)
        wrong, shares = contradicting(better, poses, p, extent)
        tested = motion is not None and motion.agrees.sum() >= LEAST_CONFIRMING_POSES
        missed = shares[:, 0 if tested or not tracked.searched else 1]
        if not wrong and refuted(missed):
            wrong = [used[int(np.argmax(missed))]]
        if not wrong:
            break
        left_out += len(wrong)
        tracked = without(tracked, wrong)
        _refuse_few(tracked, views)
    return Assembly(better, tracked, keys, poses, motion, rms, gate, missed, bool(wrong), left_out)


def _refuse_contradictions(found: Assembly) -> None:
    if found.refuted:
        count = int((found.missed > MISSED_SHARE).sum())
        what = (
            f"the scans contradict one another at every pose that was found: {count} of"
            f" {len(found.missed)} scans"
        )
        what += (
            f" do not show more than {100.0 * MISSED_SHARE:.0f} % of the surface that the others"
            " show in their direction"
        )
        hint = (
            "steps between scans are too large, or other objects are in view: record more scans, or"
            " crop the target"
        )
        raise UnreadableInput(what, hint=hint)


def _refuse_unconfirmed(
    views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float
) -> None:
    """Poses that follow no free motion must be those of most scans, and the only ones at which the
    scans fit.
    """
    what = (
        f"only {len(tracked.poses)} of {len(views)} scans agree with one another, and their poses"
        " follow no free motion"
    )
    if 2 * len(tracked.poses) > len(views):
        if not ambiguous(views, tracked, p, extent):
            return
        what = (
            "the poses come from a search or follow large steps, and the scans fit at other poses"
            " as well"
        )
    raise UnreadableInput(
        what, hint="record smaller steps between scans, or give a model with --model FILE"
    )


def _on_motion(found: Assembly, motion: FreeMotion) -> dict[int, Pose]:
    """Poses of the free motion at the views that agree with it, if it explains the distances
    between them as well.
    """
    agreeing = [k for k, agrees in zip(sorted(found.poses), motion.agrees, strict=True) if agrees]
    moved = {k: motion.at(found.views[k].t_ns) for k in agreeing}
    keys = [k for k in found.keys if k in moved]
    if len(keys) < 3:
        return found.poses
    before, after = (
        pair_rms(found.views, {k: at[k] for k in keys}, found.gate) for at in (found.keys, moved)
    )
    return moved if after < MAX_RMS_RATIO * before else found.poses


def _refuse_undetermined(turned: float, weakest: Sequence[float]) -> None:
    """A sphere is an error for any poses, because its estimated attitude follows the noise and
    drifts by degrees.
    """
    what = f"the scans show a turn of {np.degrees(turned):.1f} deg only: the target is at rest"
    if float(np.median(weakest)) < WEAKEST_EIGENVALUE_RATIO:
        what = "the surface of the target does not determine its attitude, as that of a sphere"
    elif turned >= STILL_RAD:
        return
    raise UnreadableInput(
        what, hint="a model needs scans of several sides; give one with --model FILE"
    )


def _notes(used: int, offered: int, contradicting: int, coverage: float) -> tuple[str, ...]:
    notes = []
    if used < 0.8 * offered:
        notes.append(
            f"{offered - used} of {offered} scans could not be registered and are not part of the"
            " model"
        )
    if contradicting:
        notes.append(
            f"{contradicting} scans do not show the surface that the other scans show there and"
            " were left out"
        )
    if coverage < 0.5:
        notes.append(f"the target was seen from {100.0 * coverage:.0f} % of all directions only")
    return tuple(notes)


def evenly(numbers: Sequence[int], most: int) -> Sequence[int]:
    """Return every n-th of some numbers, with the least n that leaves at most ``most``."""
    return numbers[:: max(1, -(-len(numbers) // most))]
