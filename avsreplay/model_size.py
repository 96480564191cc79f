"""Comparison of the size of the scans with that of the model: unit, background and crop, each with
the option to add.

Sizes are compared as diameters (largest distance between two points), which do not depend on the
attitude. A scan shows one side of the target, so that its diameter is between about 0.4 and 1.1 of
that of the model. Where sizes permit several units, a search for the pose decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array
from avsreplay.log import SourceOptions
from avsreplay.log.canonical import inside_crop
from avsreplay.log.header import scaled
from avsreplay.log.options import Unit
from avsreplay.records import Alignment, AlignStatus, Surface
from avsreplay.register.mirror import SeenScan, mirror_image_fits, reflected
from avsreplay.register.params import Camera, RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.sampling import diameter, part_of_size
from avsreplay.register.size import MOST_OF_MODEL

# diameter of a scan over that of the model below which something is wrong, as above MOST_OF_MODEL
_LEAST_SIZE_RATIO = 0.25
_MAX_TARGET_RATIO = 1.1  # no scan of the target alone is larger than this
# share of background below which it does not explain too large a scan
_LEAST_BACKGROUND_SHARE = 0.02
# share of background from which on scans are rejected for too few inliers
_MAX_BACKGROUND_SHARE = 0.5
# below this ratio, background explains too large a scan better than feet (3.28) do
_BACKGROUND_RATIO = 2.0
# below this ratio, a model in feet explains the sizes as well as a view from a narrow side
_FEET_RATIO = 0.36
_LARGEST_TARGET_M = 500.0
_ONE_SIDE = (0.4, 1.15)  # the same for a scan of the target alone
_SEARCHED_POINTS = 20_000  # points of a scan in which the model is searched
_SEARCHED_SCANS = 3
# factor of a unit from which on a scan that seems to show the target only may show its surroundings
_SCENE_FACTOR = 0.11
# largest scan over the target in it, where the unit of the model is unknown
_MAX_SCENE_RATIO = 300.0
_GAPS = 0.2, 0.3  # gaps within and around a target of unknown unit, over its diameter
# space around the target in a suggested crop, over the model's diameter
_CROP_MARGIN_OF_DIAMETER = 0.25
_UNITS = {
    0.001: "millimetres",
    1.0: "metres",
    0.01: "centimetres",
    0.0254: "inches",
    0.3048: "feet",
    3.28084: "units of 3.28 m, or the scans are in feet",
    1000.0: "kilometres, or the scans are in millimetres",
    100.0: "units of 100 m, or the scans are in centimetres",
    39.3701: "units of 39.37 m, or the scans are in inches",
}
_SAME_UNIT_DIFFERENCE = 1e-4  # relative difference of two units that are the same
_SMALLEST_TARGET_M = 0.05  # a smaller model is too small, and not the unit of the scans wrong


@value_class(eq=True)
class Advice:
    """One finding of a check before a run.

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


# position (3,) of the target at the first scan [m] from the examined scan in which it was found and
# its position there, None where it cannot be followed to the first scan
FollowBack = Callable[[int, Array], Array | None]


@value_class
class Sighting:
    """Where the target seems to be in one of the examined scans.

    Attributes:
        scan: number of the scan among the examined ones.
        points: (n, 3) points of the target, or of its model at the pose that was found [m].
    """

    scan: int
    points: Array


def compare_sizes(
    clouds: Sequence[NDArray[Any]],
    surface: Surface | None,
    registrar: Registrar | None,
    options: SourceOptions,
    follow_back: FollowBack | None = None,
) -> list[Advice]:
    """Compare the size of scans with that of the model.

    Args:
        clouds: finite points (n, 3) of some scans in the frame of the sensor [m].
        surface: model of the target, None if there is none.
        registrar: of the model; one is made if it is None and needed.
        options: how the log is read: unit and crop.
        follow_back: the position of a target that moves at the first scan, for ``--region``.

    Returns:
        The findings.
    """
    if not clouds:
        return [_no_points(options)]
    scan_m = float(np.median([diameter(cloud) for cloud in clouds]))
    if surface is None:
        text = f"there is no model; the scans measure {_metres(scan_m)}"
        return [Advice("fail", "model", text, "--model FILE or --model auto")]
    model_m = diameter(surface.vertices, trimmed=False)
    ratio = scan_m / model_m if model_m else np.inf
    said = f"the scans measure {_metres(scan_m)}, the model {_metres(model_m)}"
    unit = options.model_unit.metres
    if min(scan_m, model_m) > _LARGEST_TARGET_M:
        text = f"{said}: if both are in millimetres, all lengths are 1000 times too large"
        return [Advice("check", "unit", text, "--model-unit mm --scan-unit mm")]
    if _LEAST_SIZE_RATIO <= ratio <= _MAX_TARGET_RATIO:
        groups = _grouped_units(clouds, model_m, ratio, unit, most=_SCENE_FACTOR)
        other = groups and _unit_advice({unit: [], **groups}, clouds, surface, options, ratio, said)
        return other or [_agreeing(said, ratio)]
    whole = _units(ratio, unit)
    left = ratio > MOST_OF_MODEL and (ratio < _BACKGROUND_RATIO or not whole)  # not a wrong unit
    located = _located(clouds, surface, registrar) if left else []
    if 2 * len(located) >= len(clouds):
        why = f"the model was found in {len(located)} of {len(clouds)} examined scans"
        among = Advice("ok", "size", f"{said}; {why}, among other points")
        region = _region_advice(located, why, follow_back)
        return [region or _crop_advice(clouds, [each.points for each in located], why) or among]
    return (
        _background_advice(clouds, model_m, ratio, said, located, follow_back)
        or _unit_advice(
            {**dict.fromkeys(whole, ()), **_grouped_units(clouds, model_m, ratio, unit)},
            clouds,
            surface,
            options,
            ratio,
            said,
        )
        or [_unexplained(said, ratio)]
    )


def _background_advice(
    clouds: Sequence[NDArray[Any]],
    model_m: float,
    ratio: float,
    said: str,
    located: Sequence[Sighting],
    follow_back: FollowBack | None,
) -> list[Advice]:
    """What the size of the scans, ``ratio`` times that of the model, says of points around the
    target, which was ``located`` in some of them; empty where another unit explains it.
    """
    targets = (
        [part_of_size(cloud, model_m, _ONE_SIDE) for cloud in clouds]
        if ratio > MOST_OF_MODEL
        else []
    )
    inside = [Sighting(k, points) for k, points in enumerate(targets) if points is not None]
    if ratio > _BACKGROUND_RATIO and len(inside) * 2 <= len(clouds):
        inside = _groups(clouds, model_m)
    grouped = len(inside) * 2 > len(clouds)
    if grouped:
        why = f"a group of points has the size of the model in {len(inside)} of {len(clouds)} scans"
        if region := _region_advice(inside, why, follow_back, located):
            return [region]
        points = [each.points for each in inside]
        if crop := _crop_advice(clouds, points, _of_size(model_m)):
            return [crop]
    if grouped or _MAX_TARGET_RATIO < ratio <= MOST_OF_MODEL:
        text = (
            f"{said}: the model is too small (then --model-scale {ratio:.2f} or more), or"
            " background is left"
        )
        return [Advice("check", "size", text)]
    if MOST_OF_MODEL < ratio < _BACKGROUND_RATIO:
        text = (
            f"{said}: points around the target seem to be left; a narrower --crop-box or"
            " --crop-range removes them"
        )
        return [Advice("check", "background", text)]
    return []


def _unexplained(
    said: str, ratio: float, why: str = "no common unit explains the difference"
) -> Advice:
    """Sizes that no unit explains."""
    hint = ": if other objects are in view, keep the target by --crop-box or --crop-range" * (
        ratio > MOST_OF_MODEL
    )
    return Advice("fail", "size", f"{said}; {why}{hint}")


def _no_points(options: SourceOptions) -> Advice:
    """What is said where the examined scans have no points."""
    cropped = options.crop_range is not None or options.crop_box is not None
    empty = "no points are left in the examined scans; widen the crop"
    few = "the examined scans hold fewer than ten points"
    return Advice("check", "scans", empty if cropped else few)


def find_model(
    clouds: Sequence[NDArray[Any]],
    surface: Surface,
    found: Sequence[Advice],
    options: SourceOptions,
) -> list[Advice]:
    """Look for the model in some scans, which may show other objects too.

    Args:
        clouds: as for ``compare_sizes``.
        surface: model of the target.
        found: findings of ``compare_sizes``; the unit and the crop that they suggest are used.
        options: how the log is read.

    Returns:
        The number of scans in which the model is found, and whether the sensor is elsewhere. If the
        mirror image of the model explains the scans better, a second finding says so.
    """
    model = in_found_unit(surface, found, options)
    if (metres := _named_unit(found, "--scan-unit")) is not None:
        clouds = [metres * cloud for cloud in clouds]
    by_range, by_box = _named(found, "--crop-range"), _named(found, "--crop-box")
    range_m = None if by_range is None else [float(v) for v in by_range.split(",")]
    box_m = None if by_box is None else [float(v) for v in by_box.split(",")]
    clouds = [cloud[inside_crop(cloud, range_m, box_m)] for cloud in clouds]
    few, registrar = _few(clouds), Registrar(model)
    poses = [registrar.acquire(cloud) for cloud in few]
    one, any_pose = _counts(poses)
    mirrored = _mirror_advice(few, poses, registrar, model, options)
    text = f"the model is found in {any_pose} of {len(few)} searched scans"
    if one < len(few):
        anywhere = _fitting(few, Registrar(model, RegisterParams(camera=Camera.NONE)))[0]
        if anywhere > one + 1:  # one scan more may be chance
            text += (
                f", and in {anywhere} if the sensor may be anywhere: are the points in its frame?"
                " If its position in their frame is known, give --sensor-at X,Y,Z instead"
            )
            return [Advice("check", "sensor", text, "--set register.camera=none")]
    if not any_pose:
        doubt = ": is it the right model, and does the topic show the target?"
        return [Advice("check", "pose", text + doubt * (not mirrored)), *mirrored]
    return [
        Advice("ok", "pose", text + ("" if one else ", each time in more than one pose")),
        *mirrored,
    ]


def in_found_unit(surface: Surface, found: Sequence[Advice], options: SourceOptions) -> Surface:
    """Return the model in the unit that findings suggest for it.

    Args:
        surface: model of the target.
        found: findings of ``compare_sizes``.
        options: how the log is read.
    """
    scale = _named_unit(found, "--model-unit") or options.model_unit.metres
    return scaled(surface, scale / options.model_unit.metres)


def _named_unit(found: Sequence[Advice], option: str) -> float | None:
    """The unit [m] that a finding names as the value of an option, None if none does."""
    value = _named(found, option)
    return None if value is None else Unit(value).metres


def _named(found: Sequence[Advice], option: str) -> str | None:
    """The value of an option that a finding names, None if none does."""
    words = next((a.option.split() for a in found if option in a.option.split()), [])
    return words[words.index(option) + 1] if words else None


def _mirror_advice(
    clouds: Sequence[NDArray[Any]],
    poses: Sequence[Alignment],
    registrar: Registrar,
    model: Surface,
    options: SourceOptions,
) -> list[Advice]:
    """What is said if the mirror image explains the scans in which the model is found, or is found
    where it is not.
    """
    seen = [
        SeenScan(np.asarray(cloud, dtype=np.float32), pose.T_ac.inverse())
        for cloud, pose in zip(clouds, poses, strict=True)
        if pose.status is AlignStatus.ALIGNED
    ]
    if seen:
        if not mirror_image_fits(registrar, model, seen):
            return []
        text = "the mirror image of the model explains the scans better than the model"
    else:
        found = _counts([registrar.acquire(reflected(cloud)) for cloud in clouds])[0]
        if 2 * found <= len(clouds):
            return []
        text = f"the mirror image of the model is found in {found} of {len(clouds)} searched scans"
    if options.model_mirror:
        return [Advice("fail", "mirror", f"{text}: remove --model-mirror")]
    return [
        Advice(
            "fail",
            "mirror",
            f"{text}: an axis of the model or of the points is inverted",
            "--model-mirror",
        )
    ]


def _few(clouds: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Points of scans in which the model is searched."""
    chosen = np.unique(np.linspace(0, len(clouds) - 1, _SEARCHED_SCANS).astype(int)).tolist()
    return [_thinned(clouds[k]) for k in chosen]


def _thinned(cloud: NDArray[Any]) -> NDArray[Any]:
    return cloud[:: max(len(cloud) // _SEARCHED_POINTS, 1)]


def _agreeing(said: str, ratio: float) -> Advice:
    """Sizes that agree, though the model may be in feet."""
    feet = "; if more than a narrow side is seen, the model is in feet (--model-scale 0.3048)"
    return Advice("ok", "size", said + feet * (ratio < _FEET_RATIO))


def _scan_unit(factor: float, model_m: float) -> Unit | None:
    """The unit of the scans that explains a factor on a model of this size, None if the model
    explains it.
    """
    of_scans = (
        unit
        for unit in Unit
        if unit is not Unit.M and abs(factor * unit.metres - 1.0) < _SAME_UNIT_DIFFERENCE
    )
    return next(of_scans, None) if model_m >= _SMALLEST_TARGET_M else None


def _unit_option(scale: float, given: float) -> str:
    unit = next((unit for unit in Unit if unit.metres == scale), None)
    return (
        f"{'--model-unit m ' * (given != 1.0)}--model-scale {scale:g}"
        if unit is None
        else f"--model-unit {unit.value}"
    )


def _units(ratio: float, given: float) -> list[float]:
    """Units in which the model has the size of the scans, best first; ``ratio`` is that with
    the ``given`` unit.
    """
    low, high = _ONE_SIDE
    fitting = [scale for scale in _UNITS if scale != given and low <= ratio * given / scale <= high]
    return sorted(fitting, key=lambda scale: abs(np.log(ratio * given / scale / 0.9)))


def _grouped_units(
    clouds: Sequence[NDArray[Any]], model_m: float, ratio: float, given: float, most: float = np.inf
) -> dict[float, Sequence[Sighting]]:
    """Units, at most ``most`` times the given one, in which groups of points in most scans have the
    model's size.
    """
    units = dict[float, Sequence[Sighting]]()
    for scale in _UNITS:
        factor = scale / given
        if scale == given or factor > most or not MOST_OF_MODEL < ratio / factor < _MAX_SCENE_RATIO:
            continue
        if len(groups := _groups(clouds, factor * model_m)) * 2 > len(clouds):
            units[scale] = groups
    return units


def _groups(clouds: Sequence[NDArray[Any]], size_m: float) -> list[Sighting]:
    """Groups of points of a size, one of a scan; none where less than half of the scans have one.

    A group that grows with the gap is a part of something larger.
    """
    found = list[Sighting]()
    for k, cloud in enumerate(clouds):
        if 2 * (k - len(found)) >= len(clouds):
            return []
        one = part_of_size(cloud, size_m, _ONE_SIDE, _GAPS[0])
        two = None if one is None else part_of_size(cloud, size_m, _ONE_SIDE, _GAPS[1])
        if one is not None and two is not None and len(two) < 1.2 * len(one):
            found.append(Sighting(k, np.asarray(one, dtype=np.float64)))
    return found


def _unit_advice(
    units: Mapping[float, Sequence[Sighting]],
    clouds: Sequence[NDArray[Any]],
    surface: Surface,
    options: SourceOptions,
    ratio: float,
    said: str,
) -> list[Advice]:
    """The unit, and the crop around its groups of points; empty if it is the given one.

    The registration decides: the unit is that in which most scans fit the model, the first of equal
    ones. If no scan fits it, the text says so, because an object of another size fits some unit,
    too.
    """
    if not units:
        return []
    few, given = _few(clouds), options.model_unit.metres
    once = RegisterParams(index_cache=False)  # most of the units are wrong
    fits = {each: _fitting(few, Registrar(scaled(surface, each / given), once)) for each in units}
    scale, groups = max(units.items(), key=lambda item: fits[item[0]][0])
    if scale == given:
        return []
    if not fits[scale][1] and MOST_OF_MODEL < ratio <= _MAX_SCENE_RATIO:
        # surroundings explain the size of the scans as well
        return [_unexplained(said, ratio, "the model is not found in them in any unit")]
    doubt = "" if fits[scale][1] else ", or it is another object: it is not found in the scans"
    model_m = diameter(surface.vertices, trimmed=False)
    scans = None if options.scan_unit else _scan_unit(scale / given, model_m)
    if scans is None:
        what, option = f"the model seems to be in {_UNITS[scale]}", _unit_option(scale, given)
    else:
        what = f"the scans seem to be in {_UNITS[scans.metres]}"
        option = f"--scan-unit {scans.value}"
    unit = Advice("fail", "unit", f"{said}: {what}{doubt}", option)
    metres = 1.0 if scans is None else scans.metres  # a crop is in the new unit
    size = metres * scale / given * model_m
    crop = None
    if groups:
        inside = [metres * group.points for group in groups]
        crop = _crop_advice([metres * cloud for cloud in clouds], inside, _of_size(size))
    return [unit, crop] if crop else [unit]


def _fitting(clouds: Sequence[NDArray[Any]], registrar: Registrar) -> tuple[int, int]:
    """The numbers of scans in which a search finds one pose of the model, and one pose or more."""
    return _counts([registrar.acquire(cloud) for cloud in clouds])


def _counts(found: Sequence[Alignment]) -> tuple[int, int]:
    return sum(each.status is AlignStatus.ALIGNED for each in found), sum(
        each.measured for each in found
    )


def _of_size(model_m: float) -> str:
    return f"a group of points has the size of the model ({_metres(model_m)})"


def _located(
    clouds: Sequence[NDArray[Any]], surface: Surface, registrar: Registrar | None
) -> list[Sighting]:
    """The model's vertices where a search finds them in the scans.

    The search looks at the connected parts of the scan with the size of the model, and tests every
    pose: size alone does not distinguish the target from other objects.
    """
    registrar, found = registrar or Registrar(surface), []
    for k, cloud in enumerate(clouds):
        pose = registrar.acquire(_thinned(cloud))
        if pose.measured:
            found.append(Sighting(k, pose.T_ac.apply(surface.vertices)))
    return found


def _region_advice(
    found: Sequence[Sighting],
    why: str,
    follow_back: FollowBack | None,
    located: Sequence[Sighting] = (),
) -> Advice | None:
    """The region that follows a target that moves farther than its size; None where it does not.

    The position at the first scan is that of the first ``located`` or else found target that can be
    followed back to it.
    """
    size_m = max(diameter(each.points, trimmed=False) for each in found)
    centres = np.array([each.points.mean(axis=0) for each in found])
    moved_m = float(np.ptp(centres, axis=0).max())
    if moved_m <= size_m:
        return None
    text = f"{why}, and moves by {_metres(moved_m)}: no fixed crop keeps it"
    for each in (*located, *found):
        at = follow_back(each.scan, each.points.mean(axis=0)) if follow_back else None
        if at is not None:
            return Advice(
                "check", "background", text, "--region " + ",".join(f"{v:.2f}" for v in at)
            )
    return Advice("check", "background", text, "--region X,Y,Z")


def _crop_advice(
    clouds: Sequence[NDArray[Any]], targets: Sequence[Array], why: str
) -> Advice | None:
    """The crop that keeps the target in all examined scans; None if hardly any point lies
    outside it.
    """
    margin = _CROP_MARGIN_OF_DIAMETER * max(diameter(points, trimmed=False) for points in targets)
    ranges = [np.linalg.norm(points, axis=1) for points in targets]
    low, high = (
        max(min(r.min() for r in ranges) - margin, 0.0),
        max(r.max() for r in ranges) + margin,
    )
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
    if share < _LEAST_BACKGROUND_SHARE:
        return None
    text = f"{100 * share:.0f} % of the points are background; {why}"
    return Advice("fail" if share > _MAX_BACKGROUND_SHARE else "check", "background", text, option)


def _metres(length: float) -> str:
    """Three significant figures without an exponent."""
    return f"{float(f'{length:.3g}'):.10g} m"
