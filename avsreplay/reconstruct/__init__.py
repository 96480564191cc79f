"""Reconstruct the model of an unknown target from the scans of a log, without a model and without an initial guess.

(1) Tracking: each scan is registered against the model so far by point-to-plane ICP with an M-estimator, from a
prediction; where that fails, a global search finds the pose. Scans whose points have times of their own are then moved
to one instant by the motion that was found, and tracked once more. (2) Batch refinement: the poses of the key scans
minimise the point-to-plane distances between all pairs of key scans that overlap, including pairs that see the same
side again after a turn (loop closure). The free motion of a rigid body is fitted to all poses; it replaces them if it
explains the scans as well. (3) Fusion: points and normals are averaged over the scans in a voxel grid; a voxel through
which rays of other scans have passed is removed (free-space carving by vote).

The frame {C} of the model is fixed to the target. Its axes are those of {A} at the first scan that is used, and its
origin is the centroid of that scan, until ``at_grasp`` moves it to a grasp point. Ground truth is never read. The scans
are read several times, one by one: memory holds thinned views and the full points of a bounded number of scans.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Pose
from avsreplay.reconstruct.fusion import (
    MOST_THROUGH,
    all_poses,
    contradicting,
    fused,
    joint_motion,
    pair_rms,
    refined,
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
from avsreplay.reconstruct.views import ScanView, Survey, selected, surveyed, thinned_view
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

WEAKEST = 1e-3  # below this ratio of the eigenvalues of a registration, a surface leaves three directions open
AS_WELL = 1.01  # free motion replaces the refined poses if it increases the rms between scans by no more than this
STILL_RAD = np.radians(5.0)  # a target that turned by less is at rest
MOST_ROUNDS = 6  # times views that contradict the others are left out and the poses are refined again
MOST_FUSED = 150  # scans whose points are averaged; more are thinned evenly
Scans = Callable[[], Iterable[Scan]]


def reconstruct(scans: Scans, params: ReconstructionParams | None = None) -> Reconstruction:
    """Build a model of the target from its scans.

    Args:
        scans: gives the scans of a log from its begin, in order of time, each time it is called; their ground truth, if
            any, is not used.
        params: resolution and effort.

    Returns:
        The model in {C}, with poses of the scans that were used.

    Raises:
        UnreadableInput: fewer than three usable scans, steps between scans that are too large, scans that contradict
            one another, or a target that did not turn or has no shape that determines its pose; the message
            states which.
    """
    p = params or ReconstructionParams()
    survey = surveyed(scans, p.fewest_points, p.n_scans)
    if len(survey.chosen) < 3:
        what = f"only {len(survey.chosen)} of {survey.offered} scans have {p.fewest_points} points or more"
        raise UnreadableInput(what, hint="a model needs three at least")
    views, tracked = _tracked(scans, survey, p)
    left_out = 0
    for _ in range(MOST_ROUNDS):
        better, keys, rms, gate = refined(views, tracked, p, survey.extent)
        poses = all_poses(better, tracked, keys, p, survey.extent)
        wrong, through = contradicting(better, poses, p, survey.extent)
        if not wrong:
            break
        left_out += len(wrong)
        tracked = without(tracked, wrong)
        _refuse_few(tracked, views)
    turned, coverage = turn_and_coverage([views[k] for k in poses], list(poses.values()))
    _refuse_undetermined(turned, tracked.weakest)
    motion = free_motion([views[k].t_ns for k in sorted(poses)], [poses[k] for k in sorted(poses)], survey.extent)
    _refuse_contradictions(bool(wrong), through, motion is not None or not tracked.searched)
    if motion is None:
        _refuse_unconfirmed(better, replace(tracked, poses=poses), p, survey.extent)
    else:
        motion = joint_motion(better, sorted(keys), motion, gate, survey.extent)
        moved = _on_motion(views, poses, motion)
        used = {k: moved[k] for k in keys if k in moved}
        if len(used) > 2 and pair_rms(better, used, gate) < AS_WELL * pair_rms(
            better, {k: keys[k] for k in used}, gate
        ):
            poses = moved
    chosen = dict(sorted(poses.items())[:: max(1, -(-len(poses) // MOST_FUSED))])
    twist = twists([view.t_ns for view in views], poses, motion if survey.timed else None)
    points, normals, one_sigma_m, seen, sights = fused(
        selected(scans, survey), survey, {k: twist[k] for k in chosen}, p.voxel * survey.extent, rms
    )
    found = tuple((views[k].t_ns, T) for k, T in sorted(poses.items()))
    return Reconstruction(
        points,
        normals,
        one_sigma_m,
        seen,
        poses=found,
        used=len(found),
        offered=survey.offered,
        searches=len(tracked.searched),
        coverage=coverage,
        turn_deg=float(np.degrees(turned)),
        rms_m=rms,
        voxel_m=p.voxel * survey.extent,
        notes=_notes(len(poses), len(views), left_out, coverage),
        motion=motion,
        sights=tuple(sights),
        frame="origin at the centroid of the first scan, axes parallel to those of the camera at that scan",
    )


def true_frame(made: Reconstruction, truth: Iterable[tuple[int, Pose]]) -> Pose | None:
    """The constant transformation from the true frame {C} to the reconstructed one, for the comparison of poses.

    The frame of a reconstruction is arbitrary. It is related to the true frame by the mean over all scans, so that the
    error of a single pose does not appear in the errors of all others. The mean attitude is the eigenvector of F. L.
    Markley et al., Averaging quaternions, Journal of Guidance, Control, and Dynamics 30(4), 2007.

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


def _tracked(scans: Scans, survey: Survey, p: ReconstructionParams) -> tuple[list[ScanView], Tracked]:
    """The thinned views and their poses; scans with times of their own are deskewed and tracked twice."""
    size_m = p.thin * survey.extent
    views = [thinned_view(scan, survey, size_m) for scan in selected(scans, survey)]
    tracked = track(views, p, survey.extent)
    if survey.timed and len(tracked.poses) > 2:
        instants = [view.t_ns for view in views]
        known = sorted(tracked.poses)
        motion = free_motion([instants[k] for k in known], [tracked.poses[k] for k in known], survey.extent)
        twist = twists(instants, tracked.poses, motion)
        views = [thinned_view(scan, survey, size_m, twist.get(k)) for k, scan in enumerate(selected(scans, survey))]
        tracked = track(views, p, survey.extent)
    _refuse_few(tracked, views)
    return views, tracked


def _refuse_few(tracked: Tracked, views: Sequence[ScanView]) -> None:
    if len(tracked.poses) < 3:
        turn = f"only {len(tracked.poses)} of {len(views)} scans could be registered to one another"
        hint = "the steps between scans are too large, or too much of the target is hidden: record more scans"
        raise UnreadableInput(turn, hint=hint)


def _refuse_contradictions(wrong: bool, through: float, confirmed: bool) -> None:
    """``confirmed``: by free motion, or because every scan was registered from its prediction."""
    if wrong or through > MOST_THROUGH[not confirmed]:
        what = "the scans contradict one another at every pose that was found:"
        what += f" {100.0 * through:.1f} % of the surface that others show is seen through"
        hint = "steps between scans are too large, or other objects are in view: record more scans, or crop the target"
        raise UnreadableInput(what, hint=hint)


def _refuse_unconfirmed(views: Sequence[ScanView], tracked: Tracked, p: ReconstructionParams, extent: float) -> None:
    """Poses that follow no free motion must be those of most scans, and the only ones at which the scans fit."""
    what = (
        f"only {len(tracked.poses)} of {len(views)} scans agree with one another, and their poses follow no free motion"
    )
    if 2 * len(tracked.poses) > len(views):
        if not ambiguous(views, tracked, p, extent):
            return
        what = (
            f"the poses of {len(tracked.searched)} scans come from a search, and the scans fit at other poses as well"
        )
    raise UnreadableInput(what, hint="record smaller steps between scans, or give a model with --model FILE")


def _on_motion(views: Sequence[ScanView], poses: dict[int, Pose], motion: FreeMotion) -> dict[int, Pose]:
    """Poses of the free motion at the views whose own poses agree with it."""
    return {k: motion.at(views[k].t_ns) for k, agrees in zip(sorted(poses), motion.agrees, strict=True) if agrees}


def _refuse_undetermined(turned: float, weakest: Sequence[float]) -> None:
    """A sphere is an error for any poses, because its estimated attitude follows the noise and drifts by degrees."""
    what = f"the scans show a turn of {np.degrees(turned):.1f} deg only: the target is at rest"
    if float(np.median(weakest)) < WEAKEST:
        what = "the surface of the target does not determine its attitude, as that of a sphere"
    elif turned >= STILL_RAD:
        return
    raise UnreadableInput(what, hint="a model needs scans of several sides; give one with --model FILE")


def _notes(used: int, offered: int, contradicting: int, coverage: float) -> tuple[str, ...]:
    notes = []
    if used < 0.8 * offered:
        notes.append(f"{offered - used} of {offered} scans could not be registered and are not part of the model")
    if contradicting:
        notes.append(f"{contradicting} scans do not show the surface that the other scans show there and were left out")
    if coverage < 0.5:
        notes.append(f"the target was seen from {100.0 * coverage:.0f} % of all directions only")
    return tuple(notes)
