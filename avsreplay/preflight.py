"""Checks before a run: unit of the model, background, truth, transforms and time stamps, each with the option to add.

Sizes are compared as diameters (largest distance between two points), which do not depend on the attitude. A scan shows
one side of the target, so that its diameter is between about 0.4 and 1.1 of the model's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array
from avsreplay.log import LogInfo, Source, SourceOptions
from avsreplay.log.bytes_io import shown
from avsreplay.log.options import ASSUMED_HZ, NO_TIMES, Unit
from avsreplay.records import Scan, ScanStatus, Surface
from avsreplay.register import Registrar
from avsreplay.register.size import diameter

SCANS = 5
_POSES = 200  # measured poses examined
_LEAST, _MOST = 0.25, 1.3  # diameter of a scan over that of the model outside which something is wrong
_WHOLE = 1.1  # no scan of the target alone is larger than this
_FEW = 0.02  # share of background below which it does not explain too large a scan
_LEFT_OVER = 2.0  # below this ratio, background explains too large a scan better than feet (3.28) do
_FEET = 0.36  # below this ratio, a model in feet explains the sizes as well as a view from a narrow side
_LARGEST_TARGET_M = 500.0
_ONE_SIDE = (0.4, 1.15)  # the same for a scan of the target alone
_UNITS = {
    0.001: "millimetres",
    1000.0: "kilometres, or the scans are in millimetres",
    0.01: "centimetres",
    100.0: "units of 100 m, or the scans are in centimetres",
    0.0254: "inches",
    39.3701: "units of 39.37 m, or the scans are in inches",
    0.3048: "feet",
    3.28084: "units of 3.28 m, or the scans are in feet",
}
_POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped")
_SAMPLED = 3000  # points of a scan that are grouped
_SEARCHED = 20_000  # points of a scan in which the model is searched
_LARGEST_SCENE = 300.0  # largest scan over the target in it, where the unit of the model is unknown
_GAPS = 0.2, 0.3  # gaps within and around a target of unknown unit, over its diameter
_MARGIN = 0.25  # space around the target in a suggested crop, over the model's diameter


@dataclass(frozen=True, slots=True)
class Advice:
    """One finding.

    Attributes:
        grade: "ok", "check" or "fail".
        about: what was checked.
        text: what was found.
        option: the exact option to add, "" if there is none.
    """

    grade: str
    about: str
    text: str
    option: str = ""

    @property
    def sentence(self) -> str:
        """The finding with its option."""
        return f"{self.text}; add {self.option}" if self.option else self.text


def preflight(source: Source, surface: Surface | None, registrar: Registrar | None = None) -> list[Advice]:
    """Check a log and a model before a run.

    Args:
        source: open log; at most five scans spread over it are read.
        surface: model of the target, None if there is none.
        registrar: of the model; with it the share of points on the model is measured where the first pose is known.

    Returns:
        The findings in the order of the checks.
    """
    info = source.info()
    if source.options.poses:
        return [*_poses(source, surface), *_transforms(info, source), *_truth(info), *_clock(info)]
    contents = _contents(_sampled(source), surface, registrar, source.options)
    found = [*contents, *_faces(surface), *_transforms(info, source), *_truth(info), *_clock(info)]
    share = None if registrar is None else _share_on_model(source, registrar)
    if share is not None:
        text = f"{100 * share:.0f} % of the points of the first scan are on the model at the first pose"
        found.insert(1, Advice("ok" if share >= 0.5 else "check", "points on the model", text))
    return found


def _faces(surface: Surface | None) -> list[Advice]:
    if surface is None or not surface.reversed:
        return []
    text = f"{surface.reversed} of {len(surface.faces)} faces pointed inwards and are used reversed"
    return [Advice("ok", "faces", text)]


def _sampled(source: Source) -> list[Scan]:
    """A few scans, spread evenly over the log."""
    wanted = np.unique(np.linspace(0, len(source) - 1, SCANS).astype(int)).tolist() if len(source) else []
    return [source.scan_at(seq) for seq in wanted]


def _contents(
    scans: Sequence[Scan], surface: Surface | None, registrar: Registrar | None, options: SourceOptions
) -> list[Advice]:
    """Scans that cannot be decoded, with the reason, and the size of those with at least ten points."""
    broken, clouds = [scan for scan in scans if scan.status is ScanStatus.DAMAGED], [scan.points for scan in scans]
    finite = [cloud[np.isfinite(cloud).all(axis=1)] for cloud in clouds if len(cloud) >= 10]
    found = [] if broken and len(broken) == len(scans) else _sizes(finite, surface, registrar, options)
    if broken:
        text = f"{len(broken)} of {len(scans)} examined scans cannot be decoded, the first: {broken[0].note}"
        found.insert(0, Advice("check" if found else "fail", "scans", text))
    return found


def _poses(source: Source, surface: Surface | None) -> list[Advice]:
    """Measured poses: how many of a sample are valid, where their covariance comes from, and the size of the target."""
    wanted = np.unique(np.linspace(0, len(source) - 1, _POSES).astype(int)).tolist() if len(source) else []
    found = [source.scan_at(seq) for seq in wanted]
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
    if surface is not None and not surface.sha256:
        text = f"no model: limits are those of a target of {surface.extent:.3g} m"
        given = source.options.extent_m != SourceOptions().extent_m
        out.append(Advice("ok" if given else "check", "size", text, "" if given else "--extent METRES or --model FILE"))
    return out


def _share_on_model(source: Source, registrar: Registrar) -> float | None:
    """Share of the first scan's points on the model, registered from its known pose; None without either."""
    if not len(source) or len((scan := source.scan_at(0)).points) < 10:
        return None
    start, truth = source.header.start, source.truth_of(scan).pose
    pose = start.x.T_ac if start is not None else truth
    return None if pose is None else registrar.register(scan.points, pose).inlier_ratio


def _sizes(
    clouds: Sequence[NDArray[Any]], surface: Surface | None, registrar: Registrar | None, options: SourceOptions
) -> list[Advice]:
    if not clouds:
        cropped = options.crop_range is not None or options.crop_box is not None
        text = (
            "no points are left in the examined scans; widen the crop"
            if cropped
            else "the examined scans hold no points"
        )
        return [Advice("check", "scans", text)]
    scan_m = float(np.median([diameter(cloud) for cloud in clouds]))
    if surface is None:
        text = f"there is no model; the scans measure {_metres(scan_m)}"
        return [Advice("fail", "model", text, "--model FILE or --model auto")]
    model_m = diameter(surface.vertices, trimmed=False)
    ratio = scan_m / model_m if model_m else np.inf
    said = f"the scans measure {_metres(scan_m)}, the model {_metres(model_m)}"
    if _LEAST <= ratio <= _WHOLE:
        return [_agreeing(said, scan_m, ratio)]
    left = ratio < _LEFT_OVER or _unit(ratio) is None  # background, not a wrong unit, explains the size
    if ratio > _MOST and left and (found := _located(clouds, surface, registrar)):
        why = f"the model was found in {len(found)} of {len(clouds)} examined scans"
        among = Advice("ok", "size", f"{said}; {why}, among other points")
        return [_crop_advice(clouds, found, why) or among]
    targets = [_target(cloud, model_m) for cloud in clouds] if ratio > _MOST else []
    inside = [points for points in targets if points is not None]
    grouped = len(inside) * 2 > len(clouds)
    if grouped and (crop := _crop_advice(clouds, inside, _of_size(model_m))):
        return [crop]
    if grouped or _WHOLE < ratio <= _MOST:
        text = f"{said}: the model is too small (then --model-scale {ratio:.2f} or more), or background is left"
        return [Advice("check", "size", text)]
    if _MOST < ratio < _LEFT_OVER:
        text = f"{said}: points around the target seem to be left; a narrower --crop-box or --crop-range removes them"
        return [Advice("check", "background", text)]
    scale = _unit(ratio)
    if scale is None and (both := _unit_and_background(clouds, model_m, ratio, said)):
        return both
    if scale is None:
        return [Advice("fail", "size", f"{said}; no common unit explains the difference")]
    text = f"{said}: the model seems to be in {_UNITS[scale]}"
    return [Advice("fail", "unit", text, _unit_option(scale))]


def _agreeing(said: str, scan_m: float, ratio: float) -> Advice:
    """Sizes that agree, though both may be in millimetres, or the model in feet."""
    if scan_m > _LARGEST_TARGET_M:
        text = f"{said}: if both are in millimetres, all lengths are 1000 times too large; convert them to metres"
        return Advice("check", "unit", text)
    feet = "; if more than a narrow side is seen, the model is in feet (--model-scale 0.3048)"
    return Advice("ok", "size", said + feet * (ratio < _FEET))


def _unit_option(scale: float) -> str:
    unit = next((unit for unit in Unit if unit.metres == scale), None)
    return f"--model-scale {scale:g}" if unit is None else f"--model-unit {unit.value}"


def _unit(ratio: float) -> float | None:
    """The factor of a unit that makes the sizes agree best, None if none does."""
    low, high = _ONE_SIDE
    fitting = [scale for scale in _UNITS if low <= ratio / scale <= high]
    return min(fitting, key=lambda scale: abs(np.log(ratio / scale / 0.9)), default=None)


def _unit_and_background(clouds: Sequence[NDArray[Any]], model_m: float, ratio: float, said: str) -> list[Advice]:
    """The unit with which a group of points in most scans has the size of the model; empty if there is none."""
    for scale, name in _UNITS.items():  # the most frequent unit first
        if not _MOST < ratio / scale < _LARGEST_SCENE:
            continue
        size = scale * model_m
        found = [[_target(cloud, size, gap) for gap in _GAPS] for cloud in clouds]
        # a group that grows with the gap is a part of something larger
        groups = [one for one, two in found if one is not None and two is not None and len(two) < 1.2 * len(one)]
        if len(groups) * 2 > len(clouds):
            unit = Advice("fail", "unit", f"{said}: the model seems to be in {name}", _unit_option(scale))
            crop = _crop_advice(clouds, groups, _of_size(size))
            return [unit, crop] if crop else [unit]
    return []


def _target(cloud: NDArray[Any], model_m: float, gap: float = 0.1) -> Array | None:
    """The largest group of points with the size of the model, connected over gaps up to a share of it, or None."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    points = np.asarray(cloud[:: max(len(cloud) // _SAMPLED, 1)], dtype=np.float64)
    edges = cKDTree(points).query_pairs(gap * model_m, output_type="ndarray")
    ones = np.ones(len(edges))
    graph = csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(len(points), len(points)))
    _, member = connected_components(graph, directed=False)
    groups = [points[member == k] for k in np.flatnonzero(np.bincount(member) >= max(10, len(points) // 100))]
    fitting = [g for g in groups if _ONE_SIDE[0] <= diameter(g, trimmed=False) / model_m <= _ONE_SIDE[1]]
    return max(fitting, key=len, default=None)


def _of_size(model_m: float) -> str:
    return f"a group of points has the size of the model ({_metres(model_m)})"


def _located(clouds: Sequence[NDArray[Any]], surface: Surface, registrar: Registrar | None) -> list[Array]:
    """The model's vertices where a search finds them in the scans; empty if they are found in less than half of them.

    The search looks at the connected parts of the scan with the size of the model, and tests every pose: size alone
    does not distinguish the target from other objects.
    """
    registrar, found = registrar or Registrar(surface), []
    for k, cloud in enumerate(clouds):
        pose = registrar.acquire(cloud[:: max(len(cloud) // _SEARCHED, 1)])
        if pose.measured:
            found.append(pose.T_ac.apply(surface.vertices))
        if 2 * (k + 1 - len(found)) > len(clouds):
            return []
    return found


def _crop_advice(clouds: Sequence[NDArray[Any]], targets: Sequence[Array], why: str) -> Advice | None:
    """The crop that keeps the target in all examined scans; None if hardly any point lies outside it."""
    margin = _MARGIN * max(diameter(points, trimmed=False) for points in targets)
    ranges = [np.linalg.norm(points, axis=1) for points in targets]
    low, high = max(min(r.min() for r in ranges) - margin, 0.0), max(r.max() for r in ranges) + margin
    everything = np.concatenate([np.asarray(cloud, dtype=np.float64) for cloud in clouds])
    away = np.linalg.norm(everything, axis=1)
    by_range = (away >= low) & (away <= high)
    corner = np.min([points.min(axis=0) for points in targets], axis=0) - margin
    other = np.max([points.max(axis=0) for points in targets], axis=0) + margin
    by_box = ((everything >= corner) & (everything <= other)).all(axis=1)
    box = ",".join(f"{v:.2f}" for v in (*corner, *other))
    use_range = by_range.mean() <= 1.2 * by_box.mean()
    option = f"--crop-range {low:.2f},{high:.2f}" if use_range else f"--crop-box {box}"
    share = 1.0 - (by_range if use_range else by_box).mean()
    if share < _FEW:
        return None
    text = f"{100 * share:.0f} % of the points are background; {why}"
    return Advice("check", "background", text, option)


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
    return [Advice("ok", "transforms", names)]


def _metres(length: float) -> str:
    """Three significant figures without an exponent."""
    return f"{float(f'{length:.3g}'):.10g} m"


def _truth(info: LogInfo) -> list[Advice]:
    if info.truth:
        return [Advice("ok", "truth", "the log states true poses; they are used for scoring")]
    names = [t.name for t in info.topics if t.type.rsplit("/", 1)[-1] in _POSE_TYPES and t.count]
    if names:
        others = f" (or {', '.join(names[1:3])})" if names[1:] else ""
        text = f"no truth is selected, but the log has poses{others}"
        return [Advice("ok", "truth", text, f"--truth-topic {names[0]}")]
    return [Advice("ok", "truth", "the log has no true poses; errors are unknown", "--reference fit")]


def _clock(info: LogInfo) -> list[Advice]:
    clock = info.clock
    if clock is None:
        return []
    if not info.topics and info.notes.get("times", "").startswith(NO_TIMES):
        text = f"the files hold no time stamps: {ASSUMED_HZ:g} Hz is assumed, on which all velocities depend"
        return [Advice("check", "time stamps", text, "--rate HZ")]
    problems = [
        f"{getattr(clock, name)} {name}" for name in ("unset", "jumps", "back", "equal") if getattr(clock, name)
    ]
    if not problems:
        text = f"median period {clock.period_s:.4g} s" if clock.period_s else "no period: a single scan"
        return [Advice("ok", "time stamps", text)]
    option = "--clock log" if clock.clock == "header" else ""
    return [Advice("check", "time stamps", f"time stamps of scans: {', '.join(problems)}", option)]
