"""Beams, mixed pixels, intensity, range noise and patterns of a scanner, against closed forms."""

import math
import tomllib
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from avsreplay import settings, toml_document
from avsreplay.errors import UsageError
from avsreplay.log import read_surface
from avsreplay.records import Surface
from avsreplay.simulate.inertia import principal
from avsreplay.simulate.motion import Motion, MotionParams
from avsreplay.simulate.optics import Material, beam, crosstalk, face_optics, merged
from avsreplay.simulate.rays import Pattern, Preset, ScannerParams
from avsreplay.simulate.scanner import Scanner
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

BODY = principal(np.diag([1.0, 1.1, 1.2]), np.zeros(3))
CLEAN = ScannerParams(rays=(33, 33), fov_deg=(40.0, 40.0), noise_m=0.0, outlier_ratio=0.0)


def rng(seed=0):
    return np.random.Generator(np.random.PCG64(seed))


def plate(z=0.0, x=(-1.0, 1.0), y=(-1.0, 1.0)):
    """Corners and faces of a rectangle at z that faces the camera."""
    corners = np.array(
        [[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]], dtype=np.float64
    )
    return corners, np.array([[0, 2, 1], [0, 3, 2]], np.int32)


def scanner(params, *plates, at=3.0, tilt_rad=0.0, materials=()):
    """A scanner in front of plates, which are ``at`` metres away and tilted about x."""
    corners = np.concatenate([p[0] for p in plates])
    shifts = np.cumsum([0, *(len(p[0]) for p in plates[:-1])])
    faces = np.concatenate([p[1] + s for p, s in zip(plates, shifts, strict=True)]).astype(np.int32)
    attitude = (math.sin(tilt_rad / 2), 0.0, 0.0, math.cos(tilt_rad / 2))
    motion = MotionParams(
        attitude_xyzw=attitude, rate_radps=(0.0, 0.0, 0.0), position_m=(0.0, 0.0, at)
    )
    surface = Surface(corners, faces, "plates", "")
    return Scanner(params, surface, Motion(BODY, motion, 10.0, rng()), materials)


def test_a_beam_has_the_second_moments_of_a_uniform_cone():
    for direction in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.3, 0.5, np.sqrt(1 - 0.34)]):
        axis = np.array([direction])
        rays = beam(axis, 0.02)[:, 0]
        assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-15)
        off = rays - axis * (rays @ axis[0])[:, None]
        assert_allclose(off.mean(axis=0), 0.0, atol=1e-15)
        values = np.linalg.eigvalsh(off.T @ off / len(rays))
        assert_allclose(values[1:], 0.01**2 / 4, rtol=1e-3)  # a disc of radius R: R^2 / 4
    assert beam(axis, 0.0).shape == (1, 1, 3)


def test_a_beam_on_a_plane_returns_the_range_of_its_centre():
    narrow, wide = (
        scanner(replace(CLEAN, divergence_mrad=d), plate()).cast(0.0) for d in (0.0, 5.0)
    )
    at_centre = np.abs(narrow.directions[:, :2]).max(axis=1) < 0.2
    found = {tuple(d): r for d, r in zip(wide.directions, wide.ranges, strict=True)}
    gap = [
        abs(found[tuple(d)] - r)
        for d, r in zip(narrow.directions[at_centre], narrow.ranges[at_centre], strict=True)
    ]
    assert max(gap) < 3.0 * 0.005**2


@pytest.mark.parametrize("merge_m", [math.inf, 0.1])
def test_an_edge_gives_mixed_pixels_only_where_returns_merge(merge_m):
    """Two plates 0.5 m apart with a common edge at x = 0."""
    params = replace(CLEAN, rays=(301, 5), fov_deg=(4.0, 1.0), divergence_mrad=3.0, merge_m=merge_m)
    returns = scanner(params, plate(0.0, x=(-1.0, 0.0)), plate(0.5, x=(0.0, 1.2))).cast(0.0)
    depth = returns.directions[:, 2] * returns.ranges
    between = (depth > 3.02) & (depth < 3.48)
    across = returns.directions[:, 0] / returns.directions[:, 2]
    if merge_m == math.inf:
        assert between.sum() >= 10
        assert np.abs(across[between]).max() < 0.003  # within one beam of the edge
    else:
        assert between.sum() == 0
    assert ((depth < 3.02) & (across < -0.004)).sum() > 100
    assert ((depth > 3.48) & (across > 0.004)).sum() > 100


def test_merged_ranges_are_means_weighted_by_intensity():
    ranges = np.array([[1.0, 1.0, np.inf], [2.0, 1.05, np.inf], [np.inf, 3.0, np.inf]])
    power = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 1.5, 0.0]])
    mean, intensity, weights = merged(ranges, power, math.inf)
    assert_allclose(mean, [1.25, (1.0 + 2.1 + 4.5) / 4.5, np.inf])
    assert_allclose(intensity, [4.0 / 3.0, 1.5, 0.0])
    assert_allclose(weights.sum(axis=0), [1.0, 1.0, 0.0])
    mean, intensity, _ = merged(ranges, power, 0.1)
    assert_allclose(mean, [1.0, 3.1 / 3.0, np.inf])
    assert_allclose(intensity, [1.0, 1.0, 0.0])


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 60.0])
def test_intensity_follows_lambert_and_the_square_of_the_range(tilt_deg):
    material = Material("grey", reflectance=0.4)
    params = replace(CLEAN, rays=(1, 1), fov_deg=(0.1, 0.1), reference_m=2.0)
    near, far = (
        scanner(params, plate(), at=d, tilt_rad=math.radians(tilt_deg), materials=[material])
        .cast(0.0)
        .intensities
        for d in (2.0, 6.0)
    )
    assert_allclose(near, 0.4 * math.cos(math.radians(tilt_deg)), rtol=1e-9)
    assert_allclose(near / far, 9.0, rtol=1e-9)


def test_a_specular_surface_is_lost_except_near_its_normal():
    foil = Material("foil", reflectance=0.01, specular=20.0, specular_width_deg=3.0)
    params = replace(CLEAN, intensity_min=0.05, reference_m=3.0)
    seen = scanner(params, plate(x=(-2, 2), y=(-2, 2)), materials=[foil]).cast(0.0)
    angle = np.degrees(np.arccos(seen.cosines))
    limit = 3.0 * math.sqrt(
        math.log(20.0 / 0.04)
    )  # where the lobe has fallen to 0.04 = 0.05 - 0.01
    assert len(angle) > 0
    assert angle.max() < limit
    white = scanner(
        params, plate(x=(-2, 2), y=(-2, 2)), materials=[Material("white", reflectance=1.0)]
    ).cast(0.0)
    assert len(white.ranges) == 33 * 33 > 2 * len(seen.ranges)


def test_materials_apply_to_the_faces_in_their_box_the_last_one_first():
    corners, faces = plate()
    other, more = plate(x=(2.0, 3.0))
    surface = Surface(
        np.concatenate([corners, other]),
        np.concatenate([faces, more + 4]).astype(np.int32),
        "two",
        "",
    )
    right = (1.5, -9.0, -9.0, 9.0, 9.0, 9.0)
    optics = face_optics(
        surface, [Material("all", reflectance=0.2), Material("r", box_m=right, dropout_ratio=0.9)]
    )
    assert optics.diffuse.tolist() == [0.2, 0.2, 0.5, 0.5]
    assert optics.dropouts.tolist() == [0.0, 0.0, 0.9, 0.9]


def test_dropouts_of_a_material_come_at_their_rate():
    params = replace(CLEAN, rays=(100, 100), dropout_ratio=0.2)
    scan = scanner(
        params, plate(x=(-2, 2), y=(-2, 2)), materials=[Material("m", dropout_ratio=0.5)]
    )
    clean = scan.cast(0.0)
    kept = len(scan.disturb(clean, rng(1)).ranges)
    assert stats.binomtest(kept, len(clean.ranges), 0.8 * 0.5).pvalue > 1e-3


@pytest.mark.parametrize(
    ("growth", "incidence"), [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (2.0, 0.5)]
)
def test_noise_grows_with_range_and_incidence(growth, incidence):
    params = replace(CLEAN, rays=(80, 80), fov_deg=(3.0, 3.0), noise_m=0.01, reference_m=2.0)
    params = replace(params, noise_growth=growth, noise_incidence=incidence)
    tilt = math.radians(50.0)
    scan = scanner(params, plate(), at=6.0, tilt_rad=tilt)
    clean = scan.cast(0.0)
    error = scan.disturb(clean, rng(2)).ranges - clean.ranges
    expected = 0.01 * (clean.ranges / 2.0) ** growth / clean.cosines**incidence
    assert stats.kstest(error / expected, "norm").pvalue > 1e-3
    assert 0.95 < np.std(error) / (0.01 * 3.0**growth / math.cos(tilt) ** incidence) < 1.05


def test_ranges_are_quantised():
    params = replace(CLEAN, noise_m=0.01, quantisation_m=0.004)
    scan = scanner(params, plate())
    steps = scan.disturb(scan.cast(0.0), rng(3)).ranges / 0.004
    assert_allclose(steps, np.round(steps), atol=1e-9)
    assert len(np.unique(np.round(steps))) > 5


def test_a_spinning_scanner_measures_a_column_at_once():
    params = replace(
        CLEAN, rays=(20, 16), fov_deg=(60.0, 30.0), pattern=Pattern.SPINNING, scan_s=0.1
    )
    scan = scanner(params, plate(x=(-9, 9), y=(-9, 9)))
    d, t = scan.rays[0], scan.times_s
    azimuth = np.degrees(np.arctan2(d[:, 0], d[:, 2]))
    elevation = np.degrees(np.arctan2(d[:, 1], np.hypot(d[:, 0], d[:, 2])))
    assert len(np.unique(t)) == 20
    for each in np.unique(t):
        assert np.ptp(azimuth[t == each]) < 1e-9
    assert_allclose(np.unique(np.round(np.diff(np.unique(np.round(azimuth, 9))), 9)), 3.0)
    assert_allclose(
        np.unique(np.round(elevation, 9)), np.arange(-15 + 0.9375, 15, 1.875), atol=1e-8
    )


def test_a_lissajous_figure_closes_and_covers_the_field_of_view():
    params = replace(
        CLEAN, rays=(60, 60), pattern=Pattern.LISSAJOUS, lissajous=(11, 13), scan_s=1.0
    )
    d = scanner(params, plate()).rays[0]
    u, v = (np.degrees(np.arctan2(d[:, k], d[:, 2])) / 20.0 for k in (0, 1))
    assert_allclose(np.abs([u, v]).max(axis=1), 1.0, atol=1e-3)
    crossings = [int((np.diff(np.sign(each)) != 0).sum()) for each in (u, v)]
    assert abs(crossings[0] - 22) <= 1
    assert abs(crossings[1] - 26) <= 1
    cells, _, _ = np.histogram2d(u, v, bins=10, range=[(-1, 1), (-1, 1)])
    assert (cells > 0).all()


@pytest.mark.parametrize("preset", [p.value for p in Preset if p is not Preset.NONE])
def test_a_preset_gives_scans_and_its_figures_are_defaults_only(preset):
    figures = tomllib.loads(
        resources.files("avsreplay.simulate").joinpath("presets.toml").read_text("utf-8")
    )[preset]
    text = (
        "duration_s = 3.0\nrate_hz = 0.35\n[motion]\nposition_m = [0.0, 0.0, 2.2]\n[target]\nshape"
        " = 'bracket'\n"
    )
    text += f"[scanner]\npreset = '{preset}'\nnoise_m = 0.0123\n"
    scenario = scenario_of(toml_document.parse(text, "s.toml"))
    assert scenario.params.scanner.noise_m == 0.0123
    plain = settings.dump(scenario.params.scanner)
    assert {k: plain[k] for k in figures if k != "noise_m"} == {
        k: v for k, v in figures.items() if k != "noise_m"
    }
    scan = next(iter(simulate(scenario, builtin_surface(scenario.params.target.shape)).scans()))
    assert len(scan.points) > 100
    assert (scan.times_s is not None) == (figures["pattern"] != "flash")


def test_presets_are_exactly_the_classes():
    text = resources.files("avsreplay.simulate").joinpath("presets.toml").read_text("utf-8")
    assert set(tomllib.loads(text)) == {
        preset.value for preset in Preset if preset is not Preset.NONE
    }


def grid_of(found):
    """Ranges by direction, to compare two casts of one pattern."""
    return {tuple(np.round(d, 12)): r for d, r in zip(found.directions, found.ranges, strict=True)}


def test_more_returns_of_a_beam_separate_the_surfaces_on_an_edge():
    """Half of each beam on the edge meets the near plate, half the far one: both ranges
    return, without a mixture.
    """
    wide = replace(CLEAN, divergence_mrad=40.0, merge_m=0.1)
    plates = (plate(0.0, x=(-1.0, 0.0)), plate(1.0, x=(-3.0, 3.0), y=(-3.0, 3.0)))
    one = scanner(wide, *plates).cast(0.0)
    two = scanner(replace(wide, returns=2), *plates).cast(0.0)
    at_edge = np.abs(two.directions[:, 0]) < 1e-9
    z = np.round(two.directions[at_edge, 2] * two.ranges[at_edge], 1)
    assert set(z) == {3.0, 4.0}
    assert len(two.ranges) > len(one.ranges)
    assert (
        np.abs(np.round(one.directions[:, 2] * one.ranges, 1)[:, None] - [3.0, 4.0])
        .min(axis=1)
        .max()
        < 0.05
    )


def test_range_walk_is_proportional_to_the_logarithm_of_the_intensity():
    materials = [
        Material("left", box_m=(-9, -9, -9, 0, 9, 9), reflectance=1.0),
        Material("right", reflectance=0.01),
    ]
    params = replace(CLEAN, range_walk_m=0.05, reference_m=3.0, max_incidence_deg=90.0)
    left, right = plate(x=(-2.0, -0.1)), plate(x=(0.1, 2.0))
    at = scanner(params, left, right, materials=materials[::-1])
    clean = at.cast(0.0)
    walked = at.disturb(clean, rng())
    assert_allclose(walked.ranges - clean.ranges, -0.05 * np.log10(clean.intensities), atol=1e-12)
    dark = clean.directions[:, 0] > 0.0
    assert_allclose(
        (walked.ranges - clean.ranges)[dark].mean() - (walked.ranges - clean.ranges)[~dark].mean(),
        0.1,
        atol=0.02,
    )


def test_stray_light_pulls_all_ranges_to_that_of_the_strongest_return():
    """A retro-reflector at 2 m and a plate at 4 m: phasors of a long modulation wave give the
    weighted mean.
    """
    ranges, intensities, ratio = np.array([4.0, 4.2, 2.0]), np.array([0.5, 0.1, 100.0]), 1e-3
    found = crosstalk(ranges, intensities, ratio)
    wave = 1e4  # [m], long against the differences of range
    phasors = intensities * np.exp(2j * np.pi * ranges / wave) + ratio * 100.0 * np.exp(
        2j * np.pi * 2.0 / wave
    )
    assert_allclose(found, np.angle(phasors) * wave / (2.0 * np.pi), rtol=1e-6)
    assert np.all(found[:2] < ranges[:2])
    assert_allclose(found[2], 2.0)
    assert len(crosstalk(np.zeros(0), np.zeros(0), 0.1)) == 0


def test_a_saturated_return_blooms_over_the_rays_around_it():
    """A retro-reflector seen by the central ray only fills a disc of bloom_deg; outside
    nothing changes.
    """
    reflector = [
        Material("reflector", box_m=(-0.05, -0.05, -0.2, 0.05, 0.05, -0.1), retroreflectance=50.0)
    ]
    parts = (plate(-0.15, x=(-0.04, 0.04), y=(-0.04, 0.04)), plate())
    params = replace(CLEAN, saturation=2.0, max_incidence_deg=90.0)
    sharp, blooming = (
        scanner(replace(params, bloom_deg=d), *parts, materials=reflector).cast(0.0)
        for d in (0.0, 5.0)
    )
    before, after = grid_of(sharp), grid_of(blooming)
    centre = np.array([0.0, 0.0, 1.0])
    for direction, value in after.items():
        away = math.degrees(math.acos(min(1.0, float(np.dot(direction, centre)))))
        if away < 4.99:
            assert_allclose(value, 2.85, atol=1e-9)
        elif away > 5.01:
            assert value == before[direction]
    assert sum(abs(v - 2.85) < 1e-9 for v in after.values()) > 10


def test_the_sun_blinds_specular_faces_that_mirror_it():
    """A tilted mirror returns nothing if the sun is in the mirrored direction of the ray, and all
    if it is not.
    """
    tilt = math.radians(20.0)
    mirror = [Material("cells", specular=5.0, specular_width_deg=2.0)]
    n = np.array([0.0, math.sin(tilt), -math.cos(tilt)])
    ray = np.array([0.0, 0.0, 1.0])
    mirrored = ray - 2.0 * (ray @ n) * n
    params = replace(CLEAN, fov_deg=(2.0, 2.0), max_incidence_deg=90.0)

    def cast(sun, m):
        return len(
            scanner(replace(params, sun_a=sun), plate(), tilt_rad=tilt, materials=m)
            .cast(0.0)
            .ranges
        )

    everything = cast(None, mirror)
    assert everything == 33 * 33
    assert cast(tuple(mirrored), mirror) == 0
    assert cast(tuple(-mirrored), mirror) == everything
    assert cast(tuple(mirrored), []) == everything  # a diffuse surface does not mirror


def test_materials_apply_to_the_groups_of_an_obj_model(tmp_path):
    text = """mtllib none.mtl
v -1 -1 0
v 0 -1 0
v 0 1 0
v -1 1 0
v 1 -1 0
v 1 1 0
v 1 1 0
g body
usemtl white
f 1 2 3 4
g panel wing
usemtl black
f 2 5 6
f 5 6 7
f -6 -2 -5
"""
    (tmp_path / "parts.obj").write_text(text)
    surface = read_surface(tmp_path / "parts.obj")
    assert len(surface.faces) == 4  # one triangle without area was dropped, and a vertex merged
    x = surface.vertices[surface.faces].mean(axis=1)[:, 0]
    for group in ("panel", "wing", "black"):
        optics = face_optics(surface, [Material("m", group=group, reflectance=0.9)])
        assert_allclose(optics.diffuse, np.where(x > 0.0, 0.9, 0.5))
    with pytest.raises(
        UsageError, match="no group 'nose' in the model; groups of the model: black, body, panel"
    ):
        face_optics(surface, [Material("m", group="nose")])


def test_colours_of_the_vertices_of_an_obj_model_leave_its_groups(tmp_path):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    lines = [f"v {x} {y} {z} 0.2 0.7 {0.1 * k}" for k, (x, y, z) in enumerate(corners)]
    lines += ["g front", "f 1 2 3", "g side", "f 1 2 4"]
    (tmp_path / "coloured.obj").write_text("\n".join(lines) + "\n")
    surface = read_surface(tmp_path / "coloured.obj")
    centres = surface.vertices[surface.faces].mean(axis=1)
    optics = face_optics(surface, [Material("m", group="side", reflectance=0.9)])
    assert_allclose(optics.diffuse, np.where(centres[:, 2] > 0.1, 0.9, 0.5))
