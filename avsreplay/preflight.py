"""Checks before a run: model, scans, truth, transforms and time stamps, each with the option
to add.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avsreplay.build import grasp_patches, target_geometry, task_and_target
from avsreplay.config import RunConfig
from avsreplay.geometry import Array
from avsreplay.log import LogInfo, Source, SourceOptions
from avsreplay.log.bytes_io import shown
from avsreplay.log.options import ASSUMED_HZ, NO_TIMES
from avsreplay.log.returns import MAX_COORDINATE_M
from avsreplay.model_size import Advice, compare_sizes, find_model, in_found_unit
from avsreplay.records import Scan, ScanStatus, Surface
from avsreplay.region import Region
from avsreplay.register.registrar import Registrar
from avsreplay.register.sensor_frame import SensorFrame

SCANS_FOR_CHECKS = 5  # scans, spread over the log, that are examined before a run
# distance of the grasp point from the bounding box, in extents, above which it is reported
OFF_THE_MODEL_OF_EXTENT = 0.25
_EXAMINED_POSES = 200  # measured poses that are examined
_EXAMINED_PAIRS = 50  # pairs of successive poses that are examined
MAX_STEP_OF_EXTENT = 0.25  # from one pose to the next, over the extent (docs/poses.md)
_MAX_FOLLOWED_SCANS = 300  # most scans over which a target is followed back to the first one
_MAX_LOST_SCANS = 5  # scans without points of the target after which it is lost
_POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped")


def preflight(
    source: Source,
    surface: Surface | None,
    registrar: Registrar | None = None,
    *,
    search: bool = False,
    followed: bool = False,
) -> list[Advice]:
    """Check a log and a model before a run.

    Args:
        source: open log; at most five scans spread over it are read.
        surface: model of the target, None if there is none.
        registrar: of the model; with it the share of points on the model is measured where the
            first pose is known.
        search: look for the model in some of the scans, and propose grasp points.
        followed: a region follows the target, so that points around it are expected.

    Returns:
        The findings in the order of the checks.
    """
    info, scans = source.info(), _sampled(source)
    general = [*_transforms(info, source), *_truth(info, source, scans), *_clock(info)]
    general += _meaning(source)
    if source.options.poses:
        return [*_poses(source, surface), *_grasp(surface, search), *general]
    sizes = _contents(source, scans, surface, registrar, search, follow=not followed)
    if followed:
        sizes = [each for each in sizes if each.about != "background"]
    model = None if surface is None else in_found_unit(surface, sizes, source.options)
    found = [*sizes, *_faces(surface), *_grasp(model, search), *general]
    share = None if registrar is None else _share_on_model(source, registrar)
    if share is not None:
        text = (
            f"{100 * share:.0f} % of the points of the first scan are on the model at the first"
            " pose"
        )
        found.insert(1, Advice("ok" if share >= 0.5 else "check", "points on the model", text))
    return found


def _meaning(source: Source) -> list[Advice]:
    """What the numbers of the clouds mean; an option is named where it should be confirmed."""
    return [
        Advice(each.grade, each.about, each.sentence, each.option if each.grade != "ok" else "")
        for each in source.meaning.inferences
    ]


def _faces(surface: Surface | None) -> list[Advice]:
    if surface is None or not surface.reversed:
        return []
    text = f"{surface.reversed} of {len(surface.faces)} faces pointed inwards and are used reversed"
    return [Advice("ok", "faces", text)]


def _grasp(surface: Surface | None, search: bool) -> list[Advice]:
    return _grasp_patches(surface) if search else _grasp_point(surface)


def _grasp_point(surface: Surface | None) -> list[Advice]:
    """Whether the grasp point, the origin of {C}, is far outside of the model's bounding box."""
    if surface is None or not surface.sha256:
        return []
    outside = np.maximum(
        np.maximum(surface.vertices.min(axis=0), -surface.vertices.max(axis=0)), 0.0
    )
    distance = float(np.linalg.norm(outside))
    if distance <= OFF_THE_MODEL_OF_EXTENT * surface.extent:
        return []
    text = f"the grasp point, the origin of the model, is {distance:.3g} m outside of the model"
    return [Advice("check", "grasp point", text, "--grasp X,Y,Z")]


def _grasp_patches(surface: Surface | None) -> list[Advice]:
    """Whether a gripper can grasp at the grasp point, the origin of {C}, and flat patches of the
    surface that can be used in its place.
    """
    if surface is None or not surface.sha256:
        return []
    config = RunConfig()
    geometry_c = target_geometry(surface, config.fixture_axis_c)
    task, _ = task_and_target(config, surface, geometry_c)
    patches = grasp_patches(surface, geometry_c)
    found = []
    if task.problem:
        option = patches[0].option if patches else "--grasp X,Y,Z"
        found.append(Advice("check", "grasp point", task.problem, option))
    return found + [Advice("ok", "grasp patch", f"{each.option}: {each.text}") for each in patches]


def _sampled(source: Source) -> list[Scan]:
    """A few scans, spread evenly over the log."""
    return [source.scan_at(seq) for seq in _spread(len(source), SCANS_FOR_CHECKS)]


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` of the numbers below ``count``, spread evenly."""
    return sorted({int(k) for k in np.linspace(0, count - 1, most)}) if count else []


def _contents(
    source: Source,
    scans: Sequence[Scan],
    surface: Surface | None,
    registrar: Registrar | None,
    search: bool,
    follow: bool,
) -> list[Advice]:
    """Scans that cannot be decoded, with the reason, and the size of those with at least ten
    points; with ``follow`` a target that moves is followed to the first scan.
    """
    broken, clouds = (
        [s for s in scans if s.status is ScanStatus.DAMAGED],
        list(map(source.in_own_frame, scans)),
    )
    full = [k for k, cloud in enumerate(clouds) if len(cloud) >= 10]
    finite = [clouds[k][np.isfinite(clouds[k]).all(axis=1)] for k in full]

    def follow_back(k: int, at: Array) -> Array | None:
        scan = scans[full[k]]
        return None if surface is None else _followed_back(source, scan, surface, at)

    found = (
        []
        if broken and len(broken) == len(scans)
        else compare_sizes(
            finite, surface, registrar, source.options, follow_back if follow else None
        )
    )
    if not finite and (dropped := max((scan.dropped_points for scan in scans), default=0)):
        text = (
            f"the {dropped} points of a scan are not finite or have coordinates above"
            f" {MAX_COORDINATE_M:.0e} m: transform them to a frame near the sensor"
        )
        return [Advice("fail", "scans", text)]
    if search and surface is not None and finite and found:
        found += find_model(finite, surface, found, source.options)
    if broken:
        text = (
            f"{len(broken)} of {len(scans)} examined scans cannot be used, the first:"
            f" {broken[0].note}"
        )
        found.insert(0, Advice("check" if found else "fail", "scans", text))
    return found


def _followed_back(source: Source, scan: Scan, surface: Surface, at: Array) -> Array | None:
    """The position of the target at the first scan in {A} [m], followed back in time from a scan.

    Args:
        source: the log.
        scan: the one in which the target was found.
        surface: model of the target.
        at: (3,) where it was found, in the frame of the sensor [m].

    Returns:
        The position, None where the target is lost on the way.
    """
    start = at if scan.sensor is None else scan.sensor.apply(at[None])[0]
    region = Region(start, surface.vertices.min(axis=0), surface.vertices.max(axis=0))
    seen, lost = None, 0
    for seq in reversed(_spread(scan.seq + 1, _MAX_FOLLOWED_SCANS)):
        before = source.scan_at(seq)
        if len(before.points):
            kept, seen = region.cut(before.points, -before.t_ns, seen, None)
            lost = 0 if kept.any() else lost + 1
        if lost > _MAX_LOST_SCANS:
            return None
    return None if seen is None else seen.centre


def _poses(source: Source, surface: Surface | None) -> list[Advice]:
    """Measured poses: how many of a sample are valid, where their covariance comes from, and
    the size of the target.
    """
    found = [source.scan_at(seq) for seq in _spread(len(source), _EXAMINED_POSES)]
    bad = [scan for scan in found if scan.pose is None]
    out = [Advice("ok", "poses", f"{len(source)} measured poses")]
    if bad:
        text = f"{len(bad)} of {len(found)} examined poses are not valid, the first: {bad[0].note}"
        out = [Advice("check", "poses", text)]
    stated = any(scan.pose is not None and scan.pose.covariance is not None for scan in found)
    if source.options.pose_sigma is not None:
        out.append(Advice("ok", "covariance", "given by --pose-sigma"))
    elif stated:
        out.append(Advice("ok", "covariance", "stated by the messages"))
    else:
        text = "the source states none: R0 of the estimator, adapted to the residuals"
        out.append(Advice("ok", "covariance", text, "--pose-sigma MM,DEG"))
    out += _step(source, surface)
    if surface is not None and not surface.sha256:
        text = f"no model: limits are those of a target of {surface.extent:.3g} m"
        given = source.options.extent_m != SourceOptions().extent_m
        out.append(
            Advice(
                "ok" if given else "check",
                "size",
                text,
                "" if given else "--extent METRES or --model FILE",
            )
        )
    return out


def _step(source: Source, surface: Surface | None) -> list[Advice]:
    """The motion from one pose to the next, where it is too large for a target of this size."""
    if surface is None:
        return []
    pairs = [
        (source.scan_at(seq).pose, source.scan_at(seq + 1).pose)
        for seq in _spread(len(source) - 1, _EXAMINED_PAIRS)
    ]
    steps = [
        float(np.linalg.norm(b.T_ac.t - a.T_ac.t))
        for a, b in pairs
        if a is not None and b is not None
    ]
    step = float(np.median(steps)) if steps else 0.0
    if step <= MAX_STEP_OF_EXTENT * surface.extent:
        return []
    text = (
        f"the target moves {step:.3g} m from one pose to the next, {step / surface.extent:.2g}"
        f" times its size ({MAX_STEP_OF_EXTENT:g} is the most): check the size and the unit; a"
        " column named 'x [mm]' is in millimetres, all other positions in metres"
    )
    return [Advice("fail", "unit", text)]


def _share_on_model(source: Source, registrar: Registrar) -> float | None:
    """Share of the first scan's points on the model, registered from its known pose; None
    without either.
    """
    if not len(source) or len((scan := source.scan_at(0)).points) < 10:
        return None
    start, truth = source.header.start, source.truth_of(scan).pose
    pose = start.x.T_ac if start is not None else truth
    return (
        None
        if pose is None
        else SensorFrame(registrar, scan.sensor).register(scan.points, pose).inlier_ratio
    )


def _transforms(info: LogInfo, source: Source) -> list[Advice]:
    found = [topic for topic in info.topics if topic.type.endswith("TFMessage") and topic.count]
    if not found:
        return []
    names = ", ".join(f"{topic.name} ({topic.count} messages)" for topic in found)
    frame = source.scan_at(0).frame if len(source) else ""
    root = source.moving_in(frame)
    if root is not None and source.options.fixed_frame is None:
        text = f"the frame of the clouds, '{shown(frame)}', moves in '{shown(root)}'"
        return [Advice("check", "transforms", text, f"--fixed-frame {shown(root)}")]
    fixed = source.options.fixed_frame
    return [
        Advice(
            "ok",
            "transforms",
            names if fixed is None else f"{names}; clouds are moved to '{shown(fixed)}'",
        )
    ]


def _truth(info: LogInfo, source: Source, scans: Sequence[Scan]) -> list[Advice]:
    if info.truth:
        if problem := source.truth_problem(scans):
            return [Advice("check", "truth", *problem)]
        return [Advice("ok", "truth", "the log states true poses; they are used for scoring")]
    names = [t.name for t in info.topics if t.type.rsplit("/", 1)[-1] in _POSE_TYPES and t.count]
    if names:
        others = f" (or {', '.join(names[1:3])})" if names[1:] else ""
        text = f"no truth is selected, but the log has poses{others}"
        return [Advice("ok", "truth", text, f"--truth-topic {names[0]}")]
    frame = scans[0].frame if scans else ""
    if moving := source.moving_beside(frame):
        text = f"no truth is selected, but in /tf '{shown(moving[0])}' moves; is it the target?"
        return [Advice("ok", "truth", text, f"--truth-frame {shown(moving[0])}")]
    return [
        Advice("ok", "truth", "the log has no true poses; errors are unknown", "--reference fit")
    ]


def _clock(info: LogInfo) -> list[Advice]:
    clock = info.clock
    if clock is None:
        return []
    if not info.topics and info.notes.get("times", "").startswith(NO_TIMES):
        text = (
            f"the files hold no time stamps: {ASSUMED_HZ:g} Hz is assumed, on which all velocities"
            " depend"
        )
        return [Advice("check", "time stamps", text, "--rate HZ")]
    problems = [
        f"{count} {'jump' if (count, name) == (1, 'jumps') else name}"
        for name in ("unset", "jumps", "back", "equal")
        if (count := getattr(clock, name))
    ]
    if not problems:
        text = (
            f"median period {clock.period_s:.4g} s"
            if clock.period_s
            else "no period: a single scan"
        )
        return [Advice("ok", "time stamps", text)]
    text = f"time stamps of scans: {', '.join(problems)}"
    if not info.topics:  # files have no other clock
        more = "; several recordings in one source must be split" if clock.back else ""
        return [Advice("check", "time stamps", f"{text}{more}")]
    return [Advice("check", "time stamps", text, "--clock log" if clock.clock == "header" else "")]
