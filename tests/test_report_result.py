"""A result directory read back, and the thinned view beside it."""

from __future__ import annotations

import gc
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import Pose, exp
from avsreplay.records import Label, State, Surface
from avsreplay.report.export import write_tum
from avsreplay.report.jsonl import read_rows, write_rows
from avsreplay.report.result import facts_record, load_result, motion_samples
from avsreplay.report.summary import Summary
from avsreplay.report.view import PathView, View, read_view, thin_cloud, thin_surface, write_view

TRUTH = State(
    [0, 0, 0, 1],
    [0.1, 0, 0],
    [0, 0, 5],
    [0, 0, 0],
    [0.25, -0.4],
    [0.5, 0.6, -0.4],
    exp([0, 0, 0.1]),
)
DISC = State(
    [0, 0, 0, 1], [0.1, 0, 0], [0, 0, 5], [0, 0, 0], [-1.0, 0.0], [0.5, 0.6, -0.4], exp([0, 0, 0.1])
)  # no such body


@pytest.fixture(scope="module")
def written(tmp_path_factory, make_rows):
    """A result directory, written once and copied for each test, and its summary."""
    path, rows = tmp_path_factory.mktemp("written"), make_rows(40)
    labels = [Label("full_occlusion", rows[20].t_ns, rows[25].t_ns, True, 0.5)]
    write_rows(path / "rows.jsonl", rows)
    facts = facts_record(labels=labels, truth=TRUTH, counts={"lost": 3})
    (path / "run.json").write_text(json.dumps({"facts": facts, "seed": 7}))
    write_tum(path / "truth.tum", [(r.t_ns, Pose(exp([0, 0, 0.3]), [1, 2, 3])) for r in rows])
    write_view(path / "view.npz", _view())
    return path, Summary.fold(rows, labels=labels, truth=TRUTH, counts={"lost": 3})


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written[0], tmp_path, dirs_exist_ok=True)), written[1]


def _view():
    surface = _ball(20)
    vertices, faces = thin_surface(surface)
    clouds = [
        thin_cloud(0, np.arange(30.0).reshape(10, 3), np.arange(10.0), 3.0 + np.arange(10.0)),
        thin_cloud(1, np.zeros((0, 3))),
        thin_cloud(2, np.ones((5, 3))),
    ]
    paths = [
        PathView(5, np.zeros((4, 3), np.float32)),
        PathView(9, np.ones((2, 3), np.float32), 0.25),
    ]
    return View(vertices, faces, tuple(clouds), tuple(paths))


def _ball(n):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.uv_sphere(radius=1.0, count=[n, n])
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32), "ball", "0" * 64)


def test_the_summary_is_read_back_unchanged(folder):
    path, summary = folder
    result = load_result(path)
    assert result.summary == summary
    assert result.header["seed"] == 7
    assert [t for t, _ in result.poses] == [r.t_ns for r in result.rows]
    np.testing.assert_allclose(result.poses[3][1].q, exp([0, 0, 0.3]), atol=1e-15)


def test_the_garbage_collector_rests_while_rows_are_read(folder, monkeypatch):
    states = []
    monkeypatch.setattr(
        "avsreplay.report.result.read_rows",
        lambda path: states.append(gc.isenabled()) or read_rows(path),
    )
    load_result(folder[0])
    (folder[0] / "rows.jsonl").write_text("{}\n")
    with pytest.raises(UnreadableInput):
        load_result(folder[0])
    assert (states, gc.isenabled()) == ([False, False], True)


def test_a_single_file_of_rows_is_a_result(folder):
    result = load_result(folder[0] / "rows.jsonl")
    assert (result.view, result.header["seed"], len(result.rows)) == (None, 7, 40)


def test_the_view_comes_back_and_its_bytes_are_stable(folder, tmp_path):
    view, back = _view(), read_view(folder[0] / "view.npz")
    np.testing.assert_array_equal(view.faces, back.faces)
    for one, two in zip(view.clouds, back.clouds, strict=True):
        assert one.seq == two.seq
        np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(back.clouds[0].residual_m, np.arange(10.0))
    np.testing.assert_array_equal(back.clouds[0].intensity, 3.0 + np.arange(10.0))
    assert back.clouds[2].residual_m is None
    assert back.clouds[2].intensity is None
    assert [p.miss_m for p in back.paths] == [None, 0.25]
    write_view(tmp_path / "again.npz", view)
    assert (tmp_path / "again.npz").read_bytes() == (folder[0] / "view.npz").read_bytes()


def test_a_view_of_an_earlier_version_has_no_intensities(folder):
    path = folder[0] / "view.npz"
    with np.load(path) as found:
        np.savez(path, **{name: found[name] for name in found.files if name != "cloud_intensity"})
    back = read_view(path)
    assert len(back.clouds) == 3
    assert all(cloud.intensity is None for cloud in back.clouds)
    np.testing.assert_array_equal(back.clouds[0].residual_m, np.arange(10.0))


@pytest.mark.parametrize("most", [50, 300, 2000])
def test_a_thinned_cloud_keeps_its_extremes(most):
    points = np.random.default_rng(0).normal(size=(1234, 3))
    cloud = thin_cloud(0, points, points[:, 0], most=most)
    assert len(cloud.points) == min(most, 1234)
    np.testing.assert_allclose(cloud.points[[0, -1]], points[[0, -1]], rtol=1e-6)
    np.testing.assert_array_equal(cloud.points[:, 0], cloud.residual_m)


def test_a_thinned_surface_is_small_and_complete():
    ball = _ball(80)
    vertices, faces = thin_surface(ball, most=1000)
    assert 200 < len(faces) <= 1000
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
    radius = np.linalg.norm(vertices, axis=1)
    assert radius.max() <= 1.0 + 1e-6
    assert radius.min() > 0.9


def test_a_small_surface_is_not_changed():
    ball = _ball(10)
    vertices, faces = thin_surface(ball)
    np.testing.assert_array_equal(faces, ball.faces)
    np.testing.assert_array_equal(vertices, ball.vertices.astype(np.float32))


def test_a_bare_cloud_is_thinned_by_its_vertices():
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    vertices, faces = thin_surface(Surface(points, np.zeros((0, 3), np.int32), "c", ""))
    assert faces.shape == (0, 3)
    assert 500 < len(vertices) <= 4000


def test_no_rows_is_one_line(tmp_path):
    with pytest.raises(UnreadableInput, match=r"holds no rows\.jsonl; name the directory"):
        load_result(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("run.json", "{", "not valid JSON"),
        ("run.json", "[]", "not a JSON object"),
        ("run.json", '{"facts": {"labels": [{"no": 1}]}}', "not as written"),
        ("run.json", '{"facts": {"truth": {"q_ab": 1}}}', "not as written"),
        (
            "run.json",
            json.dumps({"facts": facts_record(labels=None, truth=DISC, counts={})}),
            "not as written",
        ),
        ("run.json", '{"facts": []}', None),
        ("run.json", '{"facts": [1]}', "not as written"),
        ("truth.tum", "1 2 3", r"truth\.tum:1: not 'stamp"),
        ("truth.tum", "x 0 0 0 0 0 0 1", "not 'stamp"),
        ("truth.tum", "1 0.5 nan 0 0 0 0 1", "not 'stamp"),
        ("truth.tum", "nan 0 0 0 0 0 0 1", "not 'stamp"),
        ("view.npz", "nothing", "not a valid npz"),
    ],
)
def test_a_damaged_file_is_one_line(folder, name, text, match):
    (folder[0] / name).write_text(text)
    if match is None:
        load_result(folder[0])
        return
    with pytest.raises(UnreadableInput, match=match):
        load_result(folder[0])


@pytest.mark.parametrize("missing", ["faces", "cloud_size", "path_miss"])
def test_a_view_with_a_part_missing_or_wrong(folder, missing):
    path = folder[0] / "view.npz"
    arrays = dict(np.load(path))
    del arrays[missing]
    np.savez(path, **arrays)
    with pytest.raises(UnreadableInput):
        read_view(path)
    np.savez(path, **arrays, **{missing: np.array([[0, 1, 10**6]], np.int32)})
    with pytest.raises(UnreadableInput):
        read_view(path)


def test_samples_of_a_motion_ascend():
    """A log may contain a scan twice, and times that go back."""
    poses = [Pose.identity() for _ in range(4)]
    times, kept = motion_samples(
        list(zip([5_000_000_000, 1_000_000_000, 5_000_000_000, 2**62], poses, strict=True)), 0
    )
    assert times.tolist() == [1.0, 5.0, 2**62 * 1e-9]
    assert [id(p) for p in kept] == [id(poses[k]) for k in (1, 0, 3)]
