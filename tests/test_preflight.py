"""Checks before a run: unit, background, truth and clock, each with the option to add."""

from __future__ import annotations

import dataclasses
import json
import runpy
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh
from raycast_logs import cast, ray_grid
from rosbags.rosbag1 import Writer
from trimesh.ray.ray_pyembree import RayMeshIntersector

import avsreplay.model_size
from avsreplay.build import target_geometry, task_and_target
from avsreplay.config import RunConfig
from avsreplay.geometry import Pose, exp
from avsreplay.log import open_source
from avsreplay.log.canonical import Meaning
from avsreplay.log.header import parse_surface, scaled, surface_bytes
from avsreplay.log.options import LogInfo, SourceOptions, TopicInfo, Unit
from avsreplay.model_size import compare_sizes
from avsreplay.preflight import preflight
from avsreplay.records import Scan, ScanStatus, Surface
from avsreplay.register.contract import boxes, example_pose, view
from avsreplay.register.sampling import diameter
from avsreplay.simulate.target import builtin_surface
from avsreplay.task import TaskParams

EXAMPLE = Path(__file__).parents[1] / "docs" / "examples" / "own_bag.py"


@dataclasses.dataclass
class Log:
    """A source with given clouds."""

    clouds: list
    topics: tuple = ()
    truth: bool = False
    options: SourceOptions = dataclasses.field(default_factory=SourceOptions)

    def __len__(self):
        return len(self.clouds)

    meaning = Meaning()

    def info(self):
        return LogInfo("x", "mcap", 1, self.topics, 0, 1, truth=self.truth)

    def in_own_frame(self, scan):
        return scan.points

    def moving_beside(self, frame):
        return []

    def scan_at(self, seq):
        return Scan(seq, seq * 100_000_000, np.asarray(self.clouds[seq], np.float64), ScanStatus.OK)


def _seen(surface, n=6, wall=False, seed=1):
    """Points of the half that faces the sensor while the target turns and moves, some with a wall
    behind.
    """
    rng = np.random.default_rng(seed)
    corners = surface.vertices[surface.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    clouds = []
    for k in range(n):
        pick = rng.choice(len(corners), 4000, p=area / area.sum())
        u = np.sort(rng.uniform(size=(2, len(pick))), axis=0)
        weights = np.stack([u[0], u[1] - u[0], 1 - u[1]], axis=1)
        points = Pose(exp([0.3 * k, 0.2, 0.1]), [0.3 * k, 0.0, 12.0]).apply(
            np.einsum("ij,ijk->ik", weights, corners[pick])
        )
        points = points[points[:, 2] < np.median(points[:, 2])]
        if wall:
            flat = rng.uniform([-15, -10, 25.0], [15, 10, 25.1], (9000, 3))
            points = np.concatenate([points, flat])
        clouds.append(points)
    return clouds


def _found(found, about):
    return next(advice for advice in found if advice.about == about)


def test_a_fitting_model_is_ok(surface):
    found = preflight(Log(_seen(surface)), surface)
    assert _found(found, "size").grade == "ok"
    assert not any(advice.grade == "fail" for advice in found)


@pytest.mark.parametrize(
    ("factor", "option", "unit"),
    [
        (1000.0, "--model-unit mm", "millimetres"),
        (100.0, "--model-unit cm", "centimetres"),
        (39.37, "--model-unit inch", "inches"),
        (0.001, "--model-scale 1000", "scans are in millimetres"),
    ],
)
def test_a_wrong_unit_is_named_with_the_factor(surface, factor, option, unit):
    found = _found(preflight(Log(_seen(surface)), scaled(surface, factor)), "unit")
    assert (found.grade, found.option) == ("fail", option)
    assert unit in found.text


def test_the_suggested_factor_makes_the_sizes_agree(surface):
    log, wrong = Log(_seen(surface)), scaled(surface, 1000.0)
    factor = Unit(_found(preflight(log, wrong), "unit").option.split()[1]).metres
    assert _found(preflight(log, scaled(wrong, factor)), "size").grade == "ok"


def test_a_wall_is_background_and_the_crop_keeps_the_target(surface):
    clouds = _seen(surface, wall=True)
    found = _found(preflight(Log(clouds), surface), "background")
    flag, values = found.option.split()
    numbers = [float(v) for v in values.split(",")]
    for cloud in clouds:
        away = np.linalg.norm(cloud, axis=1)
        kept = (
            (away >= numbers[0]) & (away <= numbers[1])
            if flag == "--crop-range"
            else ((cloud >= numbers[:3]) & (cloud <= numbers[3:])).all(axis=1)
        )
        target = cloud[:, 2] < 20.0
        assert kept[target].mean() > 0.99
        assert kept[~target].mean() < 0.05


class Located:
    """A registrar that finds the target of `_seen` in every scan, whose poses follow one
    another.
    """

    def __init__(self, surface):
        self.scans = 0

    def acquire(self, cloud):
        pose = Pose(exp([0.3 * self.scans, 0.2, 0.1]), [0.3 * self.scans, 0.0, 12.0])
        self.scans += 1
        return types.SimpleNamespace(measured=True, T_ac=pose)


def test_points_that_remain_inside_the_suggested_crop_lead_to_no_other_crop(surface, monkeypatch):
    rng = np.random.default_rng(3)
    clouds = _seen(surface, n=5)
    low, high = (
        np.min([c.min(axis=0) for c in clouds], axis=0),
        np.max([c.max(axis=0) for c in clouds], axis=0),
    )
    around = 0.15 * surface.extent
    cluttered = [
        np.vstack([cloud, rng.uniform(low - around, high + around, (600, 3))]) for cloud in clouds
    ]
    monkeypatch.setattr(avsreplay.model_size, "Registrar", Located)
    found = _found(preflight(Log(cluttered), surface), "size")
    assert (found.grade, found.option) == ("ok", "")
    assert "the model was found in 5 of 5 examined scans" in found.text


@pytest.mark.parametrize(
    ("factor", "grade"), [(0.7, "check"), (0.8, "check"), (1.0, "ok"), (1.05, "ok")]
)
def test_a_model_that_is_smaller_than_a_scan_is_doubtful(surface, factor, grade):
    found = _found(preflight(Log(_seen(surface)), scaled(surface, factor)), "size")
    assert found.grade == grade
    assert ("too small" in found.text) == (grade == "check")


@dataclasses.dataclass
class Undecodable(Log):
    """A source of which some clouds cannot be decoded."""

    bad: tuple = ()

    def scan_at(self, seq):
        scan = super().scan_at(seq)
        if seq not in self.bad:
            return scan
        note = "no field 'x' among intensity"
        return dataclasses.replace(
            scan, points=np.zeros((0, 3)), status=ScanStatus.DAMAGED, note=note
        )


@pytest.mark.parametrize(("bad", "grade"), [((0, 1, 2, 3, 4), "fail"), ((2,), "check")])
def test_clouds_that_cannot_be_decoded_are_named_with_the_reason(surface, bad, grade):
    """Not as scans without points: their fields have other names, or the message is damaged."""
    found = preflight(Undecodable(_seen(surface, n=5), bad=bad), surface)
    advice = _found(found, "scans")
    assert advice.grade == grade
    assert (
        advice.text
        == f"{len(bad)} of 5 examined scans cannot be used, the first: no field 'x' among intensity"
    )
    assert any(other.about == "size" for other in found) == (grade == "check")


def test_sizes_beyond_any_target_are_doubtful_though_they_agree(surface):
    found = preflight(Log([1000.0 * cloud for cloud in _seen(surface)]), scaled(surface, 1000.0))
    assert _found(found, "unit").grade == "check"
    assert "1000 times too large" in _found(found, "unit").text


def test_a_model_in_feet_is_named_though_a_narrow_view_explains_the_sizes_too(surface):
    found = _found(preflight(Log(_seen(surface)), scaled(surface, 3.28084)), "size")
    assert (found.grade, "--model-scale 0.3048" in found.text) == ("ok", True)
    assert "feet" not in _found(preflight(Log(_seen(surface)), surface), "size").text


def test_no_unit_is_guessed_where_none_fits(surface):
    found = preflight(Log([7000.0 * cloud for cloud in _seen(surface)]), surface)
    assert "no common unit" in _found(found, "size").text


def test_unit_and_background_are_found_together(surface):
    small = dataclasses.replace(surface, vertices=0.001 * surface.vertices)
    found = preflight(Log(_seen(surface, wall=True)), small)
    assert _found(found, "unit").option == "--model-scale 1000"
    assert _found(found, "background").option.startswith("--crop-")


@pytest.mark.parametrize("given", ["m", "inch"])
def test_the_registration_decides_between_two_units_that_explain_the_sizes(surface, given):
    """With its wall a scan has the size of the model in centimetres, a group of points that in
    millimetres.
    """
    rng, clouds = np.random.default_rng(1), []
    for k in range(3):
        T_ac = Pose(exp([0.3 * k, 0.2, 0.1]), [0.0, 0.0, 20.0])
        target = T_ac.apply(view(surface, 3000, T_ac.inverse().t))
        wall = np.column_stack([rng.uniform(-20.0, 20.0, (6000, 2)), np.full(6000, 33.0)])
        clouds.append(0.1 * np.concatenate([target, wall]))
    options = SourceOptions(model_unit=Unit(given))
    read = dataclasses.replace(surface, vertices=100.0 * surface.vertices * options.model_factor)
    found = preflight(Log(clouds, options=options), read, search=True)
    assert _found(found, "unit").option == "--model-unit mm"
    assert "another object" not in _found(found, "unit").text
    assert _found(found, "background").option.startswith("--crop-")
    assert _found(found, "pose").grade == "ok"


def test_a_model_that_no_scan_shows_is_doubtful_though_the_sizes_agree(surface):
    cloud = np.random.default_rng(1).normal([0.0, 0.0, 12.0], 1.0, (2000, 3))
    found = preflight(Log([cloud]), surface, search=True)
    assert _found(found, "size").grade == "ok"
    assert _found(found, "pose").grade == "check"
    assert "is it the right model" in _found(found, "pose").text


@pytest.mark.parametrize("size", [18.0, 37.0, 95.0])
def test_a_scene_without_the_model_suggests_no_unit(surface, size):
    """Six spheres in a cube that is ``size`` times the model, which inches or
    centimetres would explain as well.
    """
    rng = np.random.default_rng(5)
    extent = size * np.linalg.norm(np.ptp(surface.vertices, axis=0)) / np.sqrt(3.0)
    centres = extent * np.array(
        [[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 1], [0, 1, 1]]
    )
    directions = rng.normal(size=(6, 400, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    cloud = (centres[:, None] + 0.12 * extent * directions).reshape(-1, 3)
    cloud[:, 2] += 2 * extent  # in front of the sensor
    found = [a for a in preflight(Log([cloud] * 3), surface) if a.about in ("unit", "size")]
    assert [a.grade for a in found] == ["fail"]
    assert "unit" not in found[0].option


def test_a_unit_in_which_no_scan_shows_the_model_may_be_another_object(surface):
    cloud = np.random.default_rng(1).normal([0.0, 0.0, 12.0], 1.0, (2000, 3))
    unit = _found(preflight(Log([cloud]), scaled(surface, 1000.0)), "unit")
    assert (unit.grade, unit.option) == ("fail", "--model-unit mm")
    assert "another object" in unit.text


@pytest.fixture(scope="module")
def own_bag(tmp_path_factory):
    """The log and the model of the tutorial: a camera that moves, a wall, a model in
    millimetres.
    """
    folder = tmp_path_factory.mktemp("own")
    subprocess.run([sys.executable, EXAMPLE, folder], check=True)
    return folder


def _checks(folder, **options):
    wanted = SourceOptions(model=folder / "target.stl", model_unit=Unit.MM, **options)
    with open_source(folder / "own.bag", wanted, inspect=True) as source:
        return {advice.about: advice for advice in preflight(source, source.header.surface)}


def test_truth_at_other_times_and_in_another_frame_is_doubtful(own_bag, tmp_path):
    assert _checks(own_bag, truth_topic="/mocap/pose")["truth"].option == "--fixed-frame map"
    assert _checks(own_bag, truth_topic="/mocap/pose", fixed_frame="map")["truth"].grade == "ok"
    late = tmp_path / "late.tum"
    late.write_text("1700007200 0 0 0 0 0 0 1\n1700007201 0 0 0 0 0 0 1\n", encoding="utf-8")
    truth = _checks(own_bag, truth_file=late)["truth"]
    assert truth.grade == "check"
    assert "they begin 7200 s after the first" in truth.text
    late.write_text("1699999999 0 0 0 0 0 0 1\n1700007201 0 0 0 0 0 0 1\n", encoding="utf-8")
    assert _checks(own_bag, truth_file=late)["truth"].option == "--truth-gap SECONDS"


def test_a_crop_refers_to_the_frame_of_the_cloud_also_with_a_fixed_frame(own_bag):
    suggested = [
        _checks(own_bag, fixed_frame=frame)["background"].option for frame in (None, "map")
    ]
    assert suggested[0] == suggested[1]


def test_background_is_the_first_reason_of_a_run_without_used_scans(cli, own_bag):
    model = ("--model", own_bag / "target.stl", "--model-unit", "mm")
    done = cli("run", own_bag / "own.bag", *model, "--fixed-frame", "map", "--n-scans", 3, "--json")
    assert done.code == 1, done.err
    verdict = json.loads(done.out)["verdict"]
    assert verdict["grade"] == "FAIL"
    assert "add --crop-range" in verdict["reasons"][0]["text"]
    assert "right model" not in done.err


def test_the_options_are_printed_in_one_line_and_are_accepted(cli, own_bag):
    done = cli("info", own_bag / "own.bag", "--model", own_bag / "target.stl")
    (line,) = [line for line in done.out.splitlines() if line.startswith("options to add: ")]
    options = line.removeprefix("options to add: ").split()
    assert options[:2] == ["--model-unit", "mm"]
    again = cli("info", own_bag / "own.bag", "--model", own_bag / "target.stl", *options, "--json")
    assert {check["grade"] for check in json.loads(again.out)["checks"]} == {"ok"}


def test_of_several_topics_that_which_shows_the_target_is_suggested(cli, surface, tmp_path):
    """One topic shows the room, of the size of the model in its file, and comes first."""
    example, rng, target = runpy.run_path(str(EXAMPLE)), np.random.default_rng(3), _seen(surface, 4)
    store, cloud = example["STORE"], example["cloud"]
    with Writer(tmp_path / "two.bag") as bag:
        kind = "sensor_msgs/msg/PointCloud2"
        topics = {
            name: bag.add_connection(name, kind, typestore=store)
            for name in ("/another", "/camera")
        }
        for k, points in enumerate(target):
            t_ns = (1_700_000_000 + k) * 10**9
            for name, seen in (
                ("/another", rng.uniform(-100.0, 100.0, (2000, 3))),
                ("/camera", points),
            ):
                bag.write(topics[name], t_ns, store.serialize_ros1(cloud(t_ns, seen), kind))
    in_inches = dataclasses.replace(scaled(surface, 1.0 / 0.0254), data=b"")
    (tmp_path / "m.ply").write_bytes(surface_bytes(in_inches))
    done = cli("info", tmp_path / "two.bag", "--model", tmp_path / "m.ply", "--json")
    checks = {check["about"]: check for check in json.loads(done.out)["checks"]}
    assert (checks["topic"]["option"], checks["unit"]["option"]) == (
        "--topic /camera",
        "--model-unit inch",
    )


def test_some_background_around_the_target_is_not_taken_for_a_unit(surface):
    """A scan of about 1.5 times the model's diameter is not said to be in feet."""
    far = 1.6 * diameter(surface.vertices, trimmed=False)
    clouds = []
    for cloud in _seen(surface):
        line = cloud.mean(axis=0) + np.outer(
            np.linspace(-0.5, 0.5, len(cloud) // 2), [far, 0.0, 0.0]
        )
        clouds.append(np.concatenate([cloud, line]))
    found = preflight(Log(clouds), surface)
    assert all(advice.about != "unit" and "--model-scale" not in advice.option for advice in found)
    assert "around the target" in _found(found, "background").text


def test_info_with_a_model_built_from_the_scans(cli, tmp_path):
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", np.random.default_rng(k).normal(size=(50, 3)).astype("f4"))
    done = cli("info", tmp_path, "--model", "auto", "--json")
    assert done.code == 0, done.err
    (model,) = [a for a in json.loads(done.out)["checks"] if a["about"] == "model"]
    assert (model["grade"], model["option"]) == ("ok", "--model auto")


def test_info_says_why_a_run_refuses_a_log_without_scans(cli, shared_data):
    bag = shared_data / "ros1-bags" / "ouster_512x10_raw.bag"
    done = cli("info", bag, "--json")
    assert done.code == 0, done.err
    (scans,) = json.loads(done.out)["checks"]
    assert scans["grade"] == "fail"
    assert "raw sensor packets" in scans["text"]
    assert scans["text"] in cli("run", bag, "--model", "auto").err


def test_an_assumed_rate_of_scans_is_doubtful_until_it_is_given(cli, tmp_path):
    """Files without times: every velocity depends on a rate that nobody has stated."""
    for number in range(4):
        np.save(tmp_path / f"scan_{number}.npy", np.random.default_rng(number).normal(size=(50, 3)))
    assumed = json.loads(cli("info", tmp_path, "--json").out)["checks"]
    (finding,) = [c for c in assumed if c["about"] == "time stamps"]
    assert (finding["grade"], finding["option"]) == ("check", "--rate HZ")
    assert "1 Hz is assumed" in finding["text"]
    given = json.loads(cli("info", tmp_path, "--rate", 1, "--json").out)["checks"]
    assert [c["grade"] for c in given if c["about"] == "time stamps"] == ["ok"]
    (tmp_path / "times.txt").write_text("".join(f"{0.5 * k}\n" for k in range(4)))
    timed = json.loads(cli("info", tmp_path, "--json").out)["checks"]
    assert [c["grade"] for c in timed if c["about"] == "time stamps"] == ["ok"]


def test_no_model_asks_for_one(surface):
    assert (
        _found(preflight(Log(_seen(surface)), None), "model").option
        == "--model FILE or --model auto"
    )


def test_empty_scans_are_said():
    assert _found(preflight(Log([np.zeros((0, 3))] * 3), None), "scans").grade == "check"


def test_a_selection_without_a_scan_is_one_line(cli, fixtures_folder):
    done = cli("run", fixtures_folder / "tumble.mcap", "--start", "99")
    assert done.code == 3
    assert done.err.splitlines() == [
        f"avsreplay: {fixtures_folder / 'tumble.mcap'}: no scan to replay; widen the selection, or"
        " see 'avsreplay info'"
    ]


def test_a_crop_that_leaves_no_point_is_named(cli, fixtures_folder):
    done = cli(
        "run",
        fixtures_folder / "tumble.mcap",
        "--crop-range",
        "500,600",
        "--n-scans",
        "3",
        "--json",
    )
    assert "no points are left in the examined scans; widen the crop" in done.err
    assert "mostly no usable points" in done.err


def test_a_pose_topic_is_offered_as_truth(surface):
    topics = (TopicInfo("/mocap/pose", "geometry_msgs/msg/PoseStamped", "cdr", 9, 0, 1),)
    assert (
        _found(preflight(Log(_seen(surface), topics), surface), "truth").option
        == "--truth-topic /mocap/pose"
    )
    assert _found(preflight(Log(_seen(surface)), surface), "truth").option == "--reference fit"


def test_the_diameter_does_not_depend_on_the_attitude_or_a_stray_point():
    rng = np.random.default_rng(2)
    points = rng.uniform([-1, -0.5, -0.2], [1, 0.5, 0.2], (4000, 3))
    turned = Pose(exp([0.4, 1.0, -2.0]), [5.0, 6.0, 7.0]).apply(points)
    assert diameter(turned) == pytest.approx(diameter(points), rel=0.02)
    assert diameter(np.vstack([points, [[900.0, 0, 0]]])) == pytest.approx(
        diameter(points), rel=0.05
    )
    assert diameter(np.zeros((0, 3))) == 0.0


def test_a_scaled_model_keeps_its_shape_and_can_be_written(surface):
    half = scaled(surface, 0.5)
    assert half.extent == pytest.approx(0.5 * surface.extent)
    assert half.sha256 != surface.sha256
    again = parse_surface(surface_bytes(half), "m.ply")
    np.testing.assert_array_equal(again.vertices, half.vertices)
    assert scaled(surface, 1.0) is surface


@pytest.fixture(scope="module")
def model_in_mm(tmp_path_factory, fixtures_folder):
    with open_source(fixtures_folder / "tumble.mcap") as source:
        path = tmp_path_factory.mktemp("model") / "target.ply"
        path.write_bytes(surface_bytes(scaled(source.header.surface, 1000.0)))
    return path


def test_a_model_in_millimetres_is_said_before_any_table(cli, fixtures_folder, model_in_mm):
    log = fixtures_folder / "tumble.mcap"
    info = json.loads(cli("info", log, "--model", model_in_mm, "--json").out)
    assert [c["option"] for c in info["checks"] if c["grade"] == "fail"] == ["--model-unit mm"]
    done = cli("run", log, "--model", model_in_mm, "--n-scans", 5)
    assert "--model-unit mm" in done.err.splitlines()[0]
    assert "--model-unit mm" in done.out.split("Scans:")[0]
    assert "model explains" not in done.err  # the shape is not judged in a wrong unit
    assert "mirror" not in done.err
    right = cli("run", log, "--model", model_in_mm, "--model-unit", "mm", "--n-scans", 5)
    assert "model-unit" not in right.err.splitlines()[0]
    assert "TRACKING PASS." in right.out


def test_a_mirrored_model_is_named_with_the_option_that_repairs_it(cli, fixtures_folder, tmp_path):
    """The mirror image is made with trimesh; the run with --model-mirror has the poses of the
    model turned about x.
    """
    log, mirrored = fixtures_folder / "tumble.mcap", tmp_path / "mirrored.ply"
    with open_source(log) as source:
        own = source.header.surface
    turned = trimesh.Trimesh(own.vertices * [1.0, -1.0, 1.0], own.faces[:, ::-1], process=False)
    mirrored.write_bytes(turned.export(file_type="ply", encoding="binary", vertex_normal=False))

    def options(path, *given):
        checks = json.loads(cli("info", log, "--model", path, *given, "--json").out)["checks"]
        return [(c["about"], c["grade"], c["option"]) for c in checks if "mirror" in c["about"]]

    assert options(mirrored) == [("mirror", "fail", "--model-mirror")]
    assert options(mirrored, "--model-mirror") == []
    (tmp_path / "own.ply").write_bytes(surface_bytes(own))
    assert options(tmp_path / "own.ply", "--model-mirror") == [("mirror", "fail", "")]
    with open_source(log, SourceOptions(model=mirrored, model_mirror=True)) as source:
        again = source.header.surface
    half_turn = np.diag([-1.0, -1.0, 1.0])  # the sign of x after that of y
    np.testing.assert_allclose(again.vertices, own.vertices @ half_turn, atol=1e-6)
    volume = trimesh.Trimesh(again.vertices, again.faces, process=False).volume
    assert volume == pytest.approx(
        trimesh.Trimesh(own.vertices, own.faces, process=False).volume, rel=1e-5
    )
    done = cli(
        "run",
        log,
        "--model",
        mirrored,
        "--model-mirror",
        "--init",
        "auto",
        "--n-scans",
        6,
        "--tables",
        "run",
    )
    assert "6 healthy" in done.out


def test_a_wrong_model_is_the_first_reason_of_a_run_without_used_scans(
    cli, fixtures_folder, tmp_path
):
    trimesh.creation.icosphere(subdivisions=2, radius=1.2).export(tmp_path / "ball.stl")
    options = ["--model", tmp_path / "ball.stl", "--init", "auto", "--n-scans", 3, "--json"]
    done = cli("run", fixtures_folder / "tumble.mcap", *options)
    assert done.code == 1, done.err
    verdict = json.loads(done.out)["verdict"]
    assert verdict["grade"] == "FAIL"
    assert "is it the right model" in verdict["reasons"][0]["text"]


@pytest.mark.parametrize(("offset", "reported"), [(0.0, False), (0.2, False), (5.0, True)])
def test_an_origin_far_outside_of_the_model_is_reported_as_the_grasp_point(
    surface, offset, reported
):
    vertices = surface.vertices + np.array([offset, 0.0, 0.0])
    moved = dataclasses.replace(surface, vertices=vertices, sha256="a")
    advice = [a for a in preflight(Log(_seen(surface)), moved) if a.about == "grasp point"]
    assert [a.option for a in advice] == ["--grasp X,Y,Z"] * reported


@pytest.mark.parametrize("usable", [True, False])
def test_patches_that_a_gripper_reaches_are_proposed(usable):
    mesh = trimesh.creation.box([1.0, 0.6, 0.4])
    at = np.array([0.0, 0.0, -0.2] if usable else [0.1, 0.0, 0.0])  # of the origin, along +z
    body = Surface(mesh.vertices + at, mesh.faces.astype(np.int32), "box", "a")
    found = preflight(Log([]), body, search=True)
    at_origin = [a for a in found if a.about == "grasp point"]
    offered = [a for a in found if a.about == "grasp patch"]
    assert [a.option for a in at_origin] == ([] if usable else ["--set task.patch=flat-1"])
    assert len(offered) == 3
    for advice in offered:
        name = advice.text.split(":")[0].removeprefix("--set task.patch=")
        config = RunConfig(task=TaskParams(patch=name))
        task, target = task_and_target(config, body, target_geometry(body, config.fixture_axis_c))
        assert not task.problem
        away = target.surface(np.linspace(0.01, 1.0, 20)[:, None] * task.axis_c)[1]
        assert (away > 0.0).all()  # the approach does not meet the body


def test_points_far_from_the_origin_of_their_frame_are_named(surface):
    far = Log([np.zeros((0, 3))] * 3)
    far.scan_at = lambda seq: Scan(seq, seq, np.zeros((0, 3)), ScanStatus.EMPTY, dropped_points=900)
    (advice,) = [a for a in preflight(far, surface) if a.about == "scans"]
    assert advice.grade == "fail"
    assert "the 900 points of a scan" in advice.text
    assert "1e+06 m" in advice.text


def test_a_sensor_that_is_not_at_the_origin_is_named():
    """Ray-cast views by a sensor at the origin, and the same points in a frame whose origin is 60 m
    away.
    """
    surface = builtin_surface()
    caster, rays = (
        RayMeshIntersector(trimesh.Trimesh(surface.vertices, surface.faces)),
        ray_grid(8.0, 50),
    )
    clouds = []
    for k in range(3):
        pose = Pose(exp([0.3 * k, 0.2, 0.1]), [0.3 * k, 0.0, 12.0])
        ranges, rows, _ = cast(caster, rays, pose.R, pose.t)
        clouds.append(ranges[:, None] * rays[rows])
    plain = [
        a for a in preflight(Log(clouds), surface, search=True) if a.about in ("pose", "sensor")
    ]
    assert [a.option for a in plain] == [""]
    moved = [cloud + np.array([0.0, 45.0, -40.0]) for cloud in clouds]
    found = [
        a for a in preflight(Log(moved), surface, search=True) if a.about in ("pose", "sensor")
    ]
    assert [a.option for a in found] == ["--set register.camera=none"]


def test_scans_in_millimetres_are_named_with_the_option_and_the_crop_in_metres(surface):
    clouds = [1000.0 * cloud for cloud in _seen(surface, wall=True)]
    found = preflight(Log(clouds), surface)
    assert _found(found, "unit").option == "--scan-unit mm"
    crop = _found(found, "background").option.split()[1]
    assert max(abs(float(v)) for v in crop.split(",")) < 100.0
    both = preflight(Log(clouds), scaled(surface, 1000.0))
    assert _found(both, "unit").option == "--model-unit mm --scan-unit mm"


def _on_a_floor(distances, few, every):
    """A model, its size [m], and scans of it on a floor at distances in units of that size; each
    of the first ``few`` has one of ``every`` so many points of the target.
    """
    surface, pose = boxes(), example_pose()
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    seen = pose.apply(view(surface, 600, pose.inverse().t)) - pose.t
    x, y = np.meshgrid(np.linspace(-6, 6, 40), np.linspace(-6, 6, 40))
    floor = np.stack([x.ravel(), y.ravel(), np.full(x.size, -2.0)], axis=1) * size
    clouds = []
    for k, distance in enumerate(distances):
        at = np.array([distance * size, 0.0, 0.0])
        clouds.append(np.concatenate([seen[:: every if k < few else 1] + at, floor + at]))
    return surface, size, clouds


@pytest.mark.parametrize("approaches", [True, False])
def test_no_crop_is_advised_that_loses_a_target_that_approaches(approaches):
    """The target stands on a floor; in the first scan it has too few points for a group."""
    sizes = [30.0 - 6.0 * k if approaches else 6.0 for k in range(5)]
    surface, _, clouds = _on_a_floor(sizes, few=1, every=120)
    (advice,) = compare_sizes(clouds, surface, None, SourceOptions())
    assert advice.about == "background"
    wanted = ("--region",) if approaches else ("--crop-box", "--crop-range")
    assert advice.option.split()[0] in wanted


def test_the_region_begins_where_the_target_is_at_the_first_scan():
    """The target comes from 30 to 6 sizes over 41 scans; in the first one it has few points."""
    sizes = [30.0 - 0.6 * k for k in range(41)]
    surface, size, clouds = _on_a_floor(sizes, few=8, every=40)
    advice = _found(preflight(Log(clouds), surface), "background")
    option, position = advice.option.split()
    assert option == "--region"
    first = np.array([float(v) for v in position.split(",")])
    assert np.linalg.norm(first - [30.0 * size, 0.0, 0.0]) < 0.5 * size
    followed = preflight(Log(clouds), surface, followed=True)
    assert not [each for each in followed if each.about == "background"]
