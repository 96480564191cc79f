"""Objects, plumes and the Earth: occlusion, returns, motion and labels."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.integrate import quad
from scipy.spatial import cKDTree

from avsreplay import geometry, toml_document
from avsreplay.errors import UsageError
from avsreplay.log import SourceOptions, open_source
from avsreplay.record import RecordOptions, record_scenario
from avsreplay.records import Scan
from avsreplay.register.surface_index import SurfaceIndex
from avsreplay.simulate.rays import FieldOfView, Pattern, ray_grid
from avsreplay.simulate.scenario import load_scenario, scenario_of
from avsreplay.simulate.scene import SceneObject
from avsreplay.simulate.simulation import SIMULATED_EPOCH_NS, simulate
from avsreplay.simulate.target import adapter, builtin_surface, ply_bytes

SURFACE = builtin_surface()
BASE = """
seed = 3
duration_s = 4.0
rate_hz = 1.0
[motion]
position_m = [0.0, 0.0, 5.0]
[scanner]
rays = [60, 60]
noise_m = 0.0
outlier_ratio = 0.0
"""


def scans_of(extra="", meshes=None):
    simulation = simulate(scenario_of(toml_document.parse(BASE + extra, "s.toml")), SURFACE, meshes)
    scans = list(simulation.scans())
    return simulation, scans, [np.asarray(scan.points, dtype=np.float64) for scan in scans]


def test_a_wall_behind_the_target_returns_what_the_target_does_not_cover():
    wall = "[[object]]\nname = 'wall'\nsize_m = [20.0, 20.0, 0.1]\nposition_m = [0.0, 0.0, 9.0]\n"
    flat = "max_incidence_deg = 90.0\n"  # every ray on the target returns
    _, _, alone = scans_of(flat)
    simulation, scans, both = scans_of(flat + wall)
    for target, scene in zip(alone, both, strict=True):
        on_wall = np.abs(scene[:, 2] - 8.95) < 1e-5
        assert len(scene) == 60 * 60
        assert {tuple(p) for p in scene[~on_wall]} == {tuple(p) for p in target}
        assert on_wall.sum() == 60 * 60 - len(target)
    assert simulation.header.labels == ()  # it stays, so it is no fault
    assert all(simulation.truth_of(scan).fault is None for scan in scans)


def test_a_wall_in_front_hides_the_target():
    near = "[[object]]\nname = 'wall'\nsize_m = [9.0, 9.0, 0.1]\nposition_m = [0.0, 0.0, 2.0]\n"
    for points in scans_of(near)[2]:
        assert_allclose(points[:, 2], 1.95, atol=1e-6)


def test_a_black_object_hides_what_is_behind_without_returning_anything():
    near = (
        "[[object]]\nname = 'plate'\nsize_m = [9.0, 9.0, 0.1]\nposition_m = [0.0, 0.0,"
        " 2.0]\nreflectance = 0.0\n"
    )
    _, _, points = scans_of("intensity_min = 1e-6\n" + near)
    assert [len(p) for p in points] == [0] * 4


def test_an_object_for_a_part_of_the_log_is_labelled_like_a_fault():
    arm = "[[object]]\nname = 'arm'\nsize_m = [0.2, 3.0, 0.2]\nposition_m = [0.0, 1.0, 1.5]\n"
    arm += "start_s = 1.0\nduration_s = 2.0\nharmful = true\n"
    _, _, alone = scans_of()
    simulation, scans, both = scans_of(arm)
    (label,) = simulation.header.labels
    second = 1_000_000_000
    assert (label.kind, label.harmful) == ("arm", True)
    assert (label.start_ns - SIMULATED_EPOCH_NS, label.end_ns - SIMULATED_EPOCH_NS) == (
        second,
        3 * second,
    )
    assert [simulation.truth_of(scan).fault for scan in scans] == [None, "arm", "arm", None]
    for k, (target, scene) in enumerate(zip(alone, both, strict=True)):
        assert np.array_equal(target, scene) == (k in (0, 3))
        if k in (1, 2):
            on_arm = scene[:, 2] < 1.7
            assert on_arm.sum() > 50
            assert np.abs(scene[on_arm, 0]).max() <= 0.1 + 1e-6


@pytest.mark.parametrize("pattern", ["flash", "raster"])
def test_an_occluder_is_where_its_motion_puts_it(pattern):
    """A turning and moving box: every point on it is on its surface at the time of its ray."""
    text = "[[object]]\nname = 'box'\nsize_m = [1.0, 0.6, 0.4]\nposition_m = [-0.5, 0.0, 2.0]\n"
    text += "velocity_mps = [0.3, 0.0, 0.05]\nrate_radps = [0.1, 0.4, -0.3]\n"
    scanner = "pattern = 'raster'\nscan_s = 0.9\n" if pattern == "raster" else ""
    _, scans, clouds = scans_of(scanner + text)
    for k, (scan, points) in enumerate(zip(scans, clouds, strict=True)):
        times = k + (
            np.zeros(len(points)) if scan.times_s is None else scan.times_s.astype(np.float64)
        )
        centre = np.array([-0.5, 0.0, 2.0]) + times[:, None] * np.array([0.3, 0.0, 0.05])
        R = geometry.matrix(geometry.exp(times[:, None] * np.array([0.1, 0.4, -0.3])))
        inside = np.abs(np.einsum("nji,nj->ni", R, points - centre)) / np.array([0.5, 0.3, 0.2])
        on_box = inside.max(axis=1) < 1.01
        assert on_box.sum() > 30
        assert_allclose(inside[on_box].max(axis=1), 1.0, atol=1e-4)


def test_objects_leave_the_truth_and_the_noise_of_the_target_alone():
    far = "[[object]]\nname = 'far'\nsize_m = [0.1, 0.1, 0.1]\nposition_m = [0.0, 0.0, -5.0]\n"
    first, _, alone = scans_of()
    second, _, both = scans_of(far)
    assert all(np.array_equal(a, b) for a, b in zip(alone, both, strict=True))
    assert np.array_equal(first.truth(SIMULATED_EPOCH_NS).r_a, second.truth(SIMULATED_EPOCH_NS).r_a)


def test_a_mesh_is_read_from_the_scenario_s_folder_and_recorded(tmp_path):
    (tmp_path / "second.ply").write_bytes(ply_bytes(SURFACE.vertices, SURFACE.faces))
    text = (
        BASE + "[[object]]\nname = 'debris'\nmodel = 'second.ply'\nposition_m = [1.5, 0.0,"
        " 8.0]\nduration_s = 2.0\n"
    )
    (tmp_path / "s.toml").write_text(text)
    done = record_scenario(load_scenario(tmp_path / "s.toml"), tmp_path / "s.mcap", RecordOptions())
    assert [fault[0] for fault in done.faults] == ["debris"]
    with open_source(tmp_path / "s.mcap") as source:
        counts = [len(scan.points) for scan in source.scans()]
        assert [label.kind for label in source.header.labels] == ["debris"]
    assert min(counts[:2]) > max(counts[2:])


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("size_m = [1.0, 1.0, 0.0]", "object.0.size_m"),
        ("attitude_xyzw = [0.0, 0.0, 0.0, 2.0]", "unit quaternion"),
        ("shape = 'wall'", "one of: box, adapter"),
        ("duration_s = 0.0", "above 0"),
    ],
)
def test_a_wrong_object_is_named(text, word):
    with pytest.raises(UsageError, match=word):
        scenario_of(toml_document.parse(f"[[object]]\nname = 'x'\n{text}\n", "s.toml"))


def test_presence_is_half_open():
    thing = SceneObject("x", start_s=1.0, duration_s=2.0)
    assert [thing.present(t) for t in (0.999, 1.0, 2.999, 3.0)] == [False, True, True, False]
    assert replace(thing, duration_s=None).present(math.inf)


def test_a_launcher_adapter_is_a_hollow_cone():
    """Every point that is not on the target is on the cone's wall, whose two surfaces are 5 % of a
    radius apart.
    """
    text = (
        "[[object]]\nname = 'adapter'\nshape = 'adapter'\nsize_m = [4.0, 3.0, 1.0]\nposition_m ="
        " [0.0, 0.0, 9.0]\n"
    )
    _, _, alone = scans_of("range_max_m = 20.0\n")
    _, _, both = scans_of("range_max_m = 20.0\n" + text)
    for target, scene in zip(alone, both, strict=True):
        rest = scene[scene[:, 2] > 8.4]
        assert len(rest) > 100
        assert {tuple(p) for p in scene[scene[:, 2] <= 8.4]} == {tuple(p) for p in target}
        radius, height = np.hypot(rest[:, 0], rest[:, 1]), rest[:, 2] - 8.5
        outer = 2.0 - 0.5 * height
        chord = 1.0 - math.cos(math.pi / 48.0)  # of the polygon in place of the circle
        assert np.all(radius <= outer + 1e-5)
        assert np.all(radius >= (outer - 0.075) * (1.0 - chord) - 1e-5)
        assert radius.min() > 1.3  # open in the middle


@pytest.mark.parametrize(("r0", "r1"), [(2.0, 1.5), (0.5, 0.9), (1.0, 1.0)])
def test_the_surface_of_a_launcher_adapter_is_closed_and_contains_its_wall(r0, r1):
    made = adapter(r0, r1, 0.4)
    places = np.unique(made.vertices.round(9), axis=0, return_inverse=True)[1].ravel()
    corners = places[made.faces]
    directed = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = {tuple(edge) for edge in directed.tolist()}
    assert len(edges) == len(directed)
    assert all((b, a) in edges for a, b in edges)
    a, b, c = made.vertices[made.faces].transpose(1, 0, 2)
    volume = np.einsum("ni,ni->", a, np.cross(b, c)) / 6.0
    wall = 0.05 * min(r0, r1)
    of_circles = np.pi * 0.8 * wall * (r0 + r1 - wall)  # the difference of two truncated cones
    assert volume == pytest.approx(of_circles, rel=0.01)


PLUME = """[[plume]]
nozzle_m = [0.0, -0.3, 0.1]
direction = [0.0, 0.6, 0.8]
half_angle_deg = 25.0
particles_per_metre = 0.6
"""
OPEN = BASE.replace(
    "position_m = [0.0, 0.0, 5.0]", "position_m = [0.0, 0.0, -50.0]"
)  # the target out of view


def plume_depth(params, ray, end):
    """Mean number of particles on a ray from the camera to a range, by adaptive quadrature."""

    def density(s):
        r = s * ray - np.array(params.nozzle_m)
        d = np.linalg.norm(r)
        angle = math.acos(np.clip(r @ np.array(params.direction) / d, -1.0, 1.0))
        spread = math.exp(-((angle / math.radians(params.half_angle_deg)) ** 2))
        return params.particles_per_metre * spread / max(d, 0.1) ** 2

    return quad(density, 0.0, end, limit=200)[0]


def test_particles_of_a_plume_have_the_stated_density():
    """Shares of hit rays and ranges of particles against the integral of the density along the
    rays.
    """
    params = scenario_of(toml_document.parse(PLUME, "p.toml")).params.plume[0]
    many = 20000
    for aim in ([0.0, 0.0, 1.0], [0.0, 0.3, 1.0], [0.2, 0.1, 1.0]):
        ray = np.array(aim) / np.linalg.norm(aim)
        drawn = params.particles(
            np.tile(ray, (many, 1)), np.full(many, 6.0), np.random.default_rng(4)
        )
        hit = 1.0 - math.exp(-plume_depth(params, ray, 6.0))
        share = np.isfinite(drawn).mean()
        assert abs(share - hit) < 4.0 * math.sqrt(hit * (1.0 - hit) / many) + 0.003
        for end in (0.8, 2.0):
            before = 1.0 - math.exp(-plume_depth(params, ray, end))
            assert abs((drawn < end).mean() - before) < 4.0 * math.sqrt(before / many) + 0.003


def test_particles_hide_the_target_and_are_drawn_anew_for_every_scan():
    text = PLUME + "start_s = 1.0\nduration_s = 2.0\n"
    simulation, scans, with_plume = scans_of(text)
    _, _, alone = scans_of()
    (label,) = simulation.header.labels
    assert (label.kind, label.harmful) == ("plume", False)
    assert [simulation.truth_of(scan).fault for scan in scans] == [None, "plume", "plume", None]
    added = []
    for k, (target, scene) in enumerate(zip(alone, with_plume, strict=True)):
        clean, seen = {tuple(p) for p in target}, {tuple(p) for p in scene}
        if k in (0, 3):
            assert np.array_equal(target, scene)
            continue
        assert len(clean - seen) > 50  # hidden by particles
        added.append(seen - clean)
        assert len(added[-1]) > 100
    assert not added[0] & added[1]
    assert all(np.array_equal(a, b) for a, b in zip(with_plume, scans_of(text)[2], strict=True))


LIMB = """[[limb]]
centre_a = [0.0, 1.0, 0.0]
radius_deg = 80.0
false_ratio = 0.3
"""


def angle_from(points, centre):
    return np.degrees(np.arccos(points @ np.array(centre) / np.linalg.norm(points, axis=1)))


def test_false_returns_come_from_the_beams_that_look_at_the_earth():
    """Their share of those beams, and their ranges, are as stated; beams on the target or to
    the sky have none.
    """
    _, _, alone = scans_of("max_incidence_deg = 90.0\n")
    simulation, _, scenes = scans_of("max_incidence_deg = 90.0\n" + LIMB)
    assert simulation.header.labels == ()
    ranges, beams = [], 0
    rays = ray_grid(Pattern.FLASH, FieldOfView.RECTANGLE, (44.0, 44.0), (60, 60), (1, 1), 0.0)[0]
    toward = rays[angle_from(rays, [0.0, 1.0, 0.0]) < 80.0]
    for target, scene in zip(alone, scenes, strict=True):
        assert np.array_equal(scene[: len(target)], target)
        false = scene[len(target) :]
        assert angle_from(false, [0.0, 1.0, 0.0]).max() < 80.0 + 1e-3
        directions = target / np.linalg.norm(target, axis=1)[:, None]
        taken, _ = cKDTree(directions).query(toward)
        beams += int((taken > 1e-5).sum())
        ranges.extend(np.linalg.norm(false, axis=1))
    assert abs(len(ranges) - 0.3 * beams) < 4.0 * math.sqrt(0.21 * beams)
    assert stats.kstest(ranges, stats.uniform(0.5, 11.5).cdf).pvalue > 1e-3


def test_the_earth_moves_with_its_rate_and_with_the_camera():
    turning = LIMB + "rate_radps = [0.0, 0.0, 0.7853981633974483]\n"  # towards -x
    text = OPEN.replace("duration_s = 4.0", "duration_s = 3.0")
    scans = list(
        simulate(scenario_of(toml_document.parse(text + turning, "s.toml")), SURFACE).scans()
    )
    for k, scan in enumerate(scans):
        phase = math.pi / 4.0 * k
        points = scan.points.astype(np.float64)
        assert len(points) > 100
        assert angle_from(points, [-math.sin(phase), math.cos(phase), 0.0]).max() < 80.0 + 1e-3
    camera = "[camera]\nrate_radps = [0.0, 0.0, 0.7853981633974483]\n"
    scans = list(
        simulate(scenario_of(toml_document.parse(text + LIMB + camera, "s.toml")), SURFACE).scans()
    )
    for k, scan in enumerate(scans):
        phase = -math.pi / 4.0 * k
        assert (
            angle_from(
                scan.points.astype(np.float64), [-math.sin(phase), math.cos(phase), 0.0]
            ).max()
            < 80.0 + 1e-3
        )


@pytest.mark.parametrize(
    ("centre", "share"), [([0.0, 0.0, 1.0], 1.0), ([0.0, 1.0, 0.0], 0.5), ([0.0, 0.0, -1.0], 0.0)]
)
def test_glare_of_the_earth_adds_to_the_variance_of_the_ranges(centre, share):
    wall = (
        "[[object]]\nname = 'wall'\nsize_m = [20.0, 20.0, 0.1]\nposition_m = [0.0, 0.0,"
        " 6.0]\nreflectance = 1.0\n"
    )
    text = (
        OPEN.replace("noise_m = 0.0", "noise_m = 0.01").replace(
            "duration_s = 4.0", "duration_s = 2.0"
        )
        + wall
    )
    limb = (
        f"[[limb]]\ncentre_a = {centre}\nradius_deg = 90.0\nglare = 3.0\nstart_s = 1.0\nduration_s"
        " = 1.0\n"
    )
    simulation = simulate(scenario_of(toml_document.parse(text + limb, "s.toml")), SURFACE)
    noises = []
    for scan in simulation.scans():
        points = scan.points.astype(np.float64)
        reach = np.linalg.norm(points, axis=1)
        noises.append(np.std(reach - 5.95 * reach / points[:, 2]))
    assert [label.kind for label in simulation.header.labels] == ["limb"]
    assert_allclose(noises, [0.01, 0.01 * math.sqrt(1.0 + share * 8.0)], rtol=0.05)


def test_the_tables_of_the_documentation_are_valid():
    page = (Path(__file__).parents[1] / "docs" / "scenario.md").read_text("utf-8")
    blocks = [block.partition("```")[0] for block in page.split("```toml\n")[1:]]
    tables = [block for block in blocks if "[[plume]]" in block or "[[limb]]" in block]
    assert len(tables) == 2
    params = scenario_of(toml_document.parse("\n".join(tables), "s.toml")).params
    assert [params.plume[0].duration_s, params.limb[0].duration_s] == [2.0, 20.0]


@pytest.mark.parametrize(
    "text", ["[[plume]]\ndirection = [0.0, 0.0, 2.0]\n", "[[limb]]\ncentre_a = [0.0, 0.0, 0.0]\n"]
)
def test_directions_of_plume_and_earth_are_unit_vectors(text):
    with pytest.raises(UsageError, match="unit vector"):
        scenario_of(toml_document.parse(text, "s.toml"))


def test_an_appendage_swings_about_its_hinge_and_the_rest_stays():
    """The points on a panel, turned back by the swing about the hinge, lie on the rigid model."""
    panel = (
        "[[appendage]]\nname = 'panel'\nbox_m = [-9.0, 0.6, -9.0, 9.0, 9.0, 9.0]\nhinge_m = [-0.7,"
        " 0.6, 0.3]\n"
    )
    panel += "axis_c = [1.0, 0.0, 0.0]\namplitude_deg = 20.0\nfrequency_hz = 0.25\n"
    simulation, scans, swung = scans_of(panel)
    index = SurfaceIndex.build(SURFACE, 0.5)
    away = []
    for scan, points in zip(scans, swung, strict=True):
        T_ac = simulation.truth_of(scan).pose
        p = T_ac.inverse().apply(points)
        angle = math.radians(20.0) * math.sin(
            2.0 * math.pi * 0.25 * scan.seq
        )  # an oracle of its own: a plane rotation
        y, z = p[:, 1] - 0.6, p[:, 2] - 0.3
        back = np.column_stack(
            [
                p[:, 0],
                math.cos(angle) * y + math.sin(angle) * z + 0.6,
                -math.sin(angle) * y + math.cos(angle) * z + 0.3,
            ]
        )
        rigid, turned = (np.sqrt(index.closest(x).d2) for x in (p, back))
        assert np.minimum(rigid, turned).max() < 1e-5
        away.append(rigid.max())
    assert away[0] < 1e-5  # through the middle
    assert away[1] > 0.2


def test_an_appendage_without_a_face_is_refused():
    with pytest.raises(UsageError, match="no face lies in the box of 'tail'"):
        scans_of("[[appendage]]\nname = 'tail'\nbox_m = [50.0, 50.0, 50.0, 51.0, 51.0, 51.0]\n")


CAMERA = """[camera]
velocity_mps = [0.05, -0.02, 0.03]
rate_radps = [0.0, 0.03, 0.01]
vibration_m = 0.002
vibration_deg = 0.2
frequency_hz = 3.3
"""


def test_the_scans_of_a_moving_camera_lie_on_the_target_after_its_pose(tmp_path):
    record_scenario(
        scenario_of(toml_document.parse(BASE + CAMERA, "s.toml")),
        tmp_path / "m.mcap",
        RecordOptions(),
    )
    index = SurfaceIndex.build(SURFACE, 0.5)
    away = {}
    for name, options in (
        ("topic", SourceOptions(sensor_topic="/camera/pose")),
        ("tf", SourceOptions(fixed_frame="map")),
        ("header", SourceOptions()),
        ("own", SourceOptions(fixed_frame="camera")),
    ):
        with open_source(tmp_path / "m.mcap", options) as source:
            far = [
                np.sqrt(
                    index.closest(
                        source.truth_of(scan).pose.inverse().apply(np.float64(scan.points))
                    ).d2
                ).max()
                for scan in source.scans()
            ]
        away[name] = max(far)
    assert away["topic"] < 1e-4
    assert away["tf"] < 1e-4
    assert away["header"] == away["tf"]
    assert away["own"] > 0.05


def test_the_reported_pose_of_the_camera_has_the_stated_error():
    noisy = CAMERA + "pose_std_m = 0.01\npose_std_deg = 0.5\n"
    text = BASE.replace("duration_s = 4.0", "duration_s = 400.0") + noisy
    simulation = simulate(scenario_of(toml_document.parse(text, "s.toml")), SURFACE)
    exact = simulate(
        scenario_of(
            toml_document.parse(
                text.replace("= 0.01\n", "= 0.0\n").replace(
                    "pose_std_deg = 0.5", "pose_std_deg = 0.0"
                ),
                "s.toml",
            )
        ),
        SURFACE,
    )
    empty = np.zeros((0, 3), np.float32)
    scans = [Scan(k, 0, empty, log_ns=SIMULATED_EPOCH_NS + k * 1_000_000_000) for k in range(400)]
    pairs = [
        (simulation.camera_poses(scan)[0][1], exact.camera_poses(scan)[0][1]) for scan in scans
    ]
    shift = np.array([a.t - b.t for a, b in pairs])
    turn = np.array(
        [geometry.log(geometry.multiply(geometry.conjugate(b.q), a.q)) for a, b in pairs]
    )
    assert_allclose(shift.std(), 0.01, rtol=0.1)
    assert_allclose(np.degrees(turn).std(), 0.5, rtol=0.1)
    assert simulation.camera_poses(scans[7])[0][1].t.tolist() == pairs[7][0].t.tolist()  # by seed


def test_intensity_is_written_and_read_back(tmp_path):
    path = tmp_path / "i.mcap"
    _, scans, _ = scans_of("intensity = true\n")
    record_scenario(
        scenario_of(toml_document.parse(BASE + "intensity = true\n", "s.toml")),
        path,
        RecordOptions(),
    )
    with open_source(path, SourceOptions(crop_range=(0.0, 4.9))) as source:
        for scan, made in zip(source.scans(), scans, strict=True):
            near = np.linalg.norm(made.points.astype(np.float64), axis=1) <= 4.9
            np.testing.assert_array_equal(scan.intensities, made.intensities[near])
            assert len(scan.intensities) == len(scan.points) > 0
            r2 = np.sum(scan.points.astype(np.float64) ** 2, axis=1)
            assert np.all(
                scan.intensities <= 0.5 / r2 * (1.0 + 1e-4)
            )  # Lambert: at most the reflectance over r^2
    without = scans_of()[1]
    assert all(scan.intensities is None for scan in without)
