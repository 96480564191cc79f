"""Depth images and clouds in other messages than PointCloud2, against messages of rosbags, PNG
files of Pillow and a projection written out here.
"""

from __future__ import annotations

import base64
import io
import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from PIL import Image
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.log import SourceOptions, open_source
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.camera import Camera, distorted, rays
from avsreplay.log.canonical import coordinates
from avsreplay.log.cloud_messages import read_foxglove, read_livox, read_point_cloud
from avsreplay.log.depth_image import DepthImage, depth_cloud, read_png
from avsreplay.log.point_cloud2 import of_layout

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
LIMIT, SECOND = 1 << 26, 1_000_000_000
W, H = 32, 24
K = (30.0, 0.0, 15.2, 0.0, 31.0, 11.7, 0.0, 0.0, 1.0)
LENSES = {
    "plumb_bob": (-0.25, 0.08, 0.001, -0.002, 0.01),
    "rational_polynomial": (0.4, -0.2, 0.0005, -0.001, 0.02, 0.6, -0.1, 0.03),
    "equidistant": (-0.01, 0.02, -0.004, 0.001),
}


def made(kind, ros1=False, **values):
    """Serialise a message with a header; nested messages are given as dictionaries."""
    store = ROS1 if ros1 else ROS2
    message = store.types[kind](**values)
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    return bytes(pack(message, kind))


def header(t_ns, frame="depth_optical", ros1=False):
    types = (ROS1 if ros1 else ROS2).types
    stamp = types["builtin_interfaces/msg/Time"](t_ns // SECOND, t_ns % SECOND)
    made_of = types["std_msgs/msg/Header"]
    return made_of(seq=1, stamp=stamp, frame_id=frame) if ros1 else made_of(stamp, frame)


def image(t_ns, values, encoding, *, big=0, pad=0, ros1=False, frame="depth_optical"):
    rows = np.zeros((values.shape[0], values.shape[1] * values.itemsize + pad), np.uint8)
    ordered = values.astype(values.dtype.newbyteorder(">" if big else "<"))
    rows[:, : rows.shape[1] - pad] = np.frombuffer(ordered.tobytes(), np.uint8).reshape(
        len(rows), -1
    )
    return made(
        "sensor_msgs/msg/Image",
        ros1,
        header=header(t_ns, frame, ros1),
        height=values.shape[0],
        width=values.shape[1],
        encoding=encoding,
        is_bigendian=big,
        step=rows.shape[1],
        data=rows.reshape(-1),
    )


def png(values):
    out = io.BytesIO()
    Image.fromarray(values).save(out, "PNG")
    return out.getvalue()


def compressed(t_ns, stated, data):
    return made(
        "sensor_msgs/msg/CompressedImage",
        header=header(t_ns),
        format=stated,
        data=np.frombuffer(data, np.uint8),
    )


def camera_info(
    t_ns, k=K, lens="plumb_bob", d=(), p=None, frame="depth_optical", ros1=False, **more
):
    roi = (ROS1 if ros1 else ROS2).types["sensor_msgs/msg/RegionOfInterest"]
    x0, y0, width, height = more.get("roi", (0, 0, 0, 0))
    binning = more.get("binning", 0)
    values = {
        "D": np.array(d, float),
        "K": np.array(k),
        "R": np.eye(3).ravel(),
        "P": np.array(p or (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)),
    }
    return made(
        "sensor_msgs/msg/CameraInfo",
        ros1,
        header=header(t_ns, frame, ros1),
        height=more.get("size", (W, H))[1],
        width=more.get("size", (W, H))[0],
        distortion_model=lens,
        binning_x=binning,
        binning_y=binning,
        roi=roi(x0, y0, height, width, False),
        **(values if ros1 else {name.lower(): v for name, v in values.items()}),
    )


def log(path, messages, profile="ros2"):
    """Write (topic, type, encoding, time, payload) in this order."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        channels = {}
        for topic, kind, encoding, t_ns, payload in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], t_ns, payload, t_ns)
        writer.finish()
    return path


IMAGE, PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"


def depth_log(path, payloads, infos=None, topic="/cam/depth/image_raw", kind=IMAGE):
    made_of = [(topic, kind, "cdr", (k + 1) * SECOND, p) for k, p in enumerate(payloads)]
    infos = [("/cam/depth/camera_info", SECOND, camera_info(SECOND))] if infos is None else infos
    return log(path, [*((t, INFO, "cdr", at, p) for t, at, p in infos), *made_of])


def points_of(path, **options):
    with open_source(path, SourceOptions(**options)) as source:
        return [scan.points for scan in source.scans()]


def expected(depth, k=K):
    """The points of a depth image [m] without distortion, pixel by pixel."""
    out = []
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = float(depth[v, u])
            if z > 0.0 and np.isfinite(z):
                out.append(((u - k[2]) / k[0] * z, (v - k[5]) / k[4] * z, z))
    return np.array(out)


def depths(seed=0):
    rng = np.random.Generator(np.random.PCG64(seed))
    out = rng.integers(300, 5000, (H, W)).astype(np.uint16)
    out[rng.random((H, W)) < 0.3] = 0
    out[0, 0] = 65535
    return out


def metres(values):
    return np.where(np.isin(values, (0, 65535)), 0.0, values * 1e-3)


@pytest.mark.parametrize("stated", ["16UC1", "mono16", "32FC1"])
@pytest.mark.parametrize(("big", "pad"), [(0, 0), (1, 6)])
@pytest.mark.parametrize("ros1", [False, True])
def test_each_encoding_gives_the_points_of_the_pixels(tmp_path, stated, big, pad, ros1):
    values = depths()
    stored = values if stated != "32FC1" else metres(values).astype(np.float32)
    if stated == "32FC1":
        stored[1, :3] = np.nan, np.inf, -np.inf
    payload = image(SECOND, stored, stated, big=big, pad=pad, ros1=ros1)
    info = camera_info(SECOND, ros1=ros1)
    encoding = "ros1" if ros1 else "cdr"
    path = log(
        tmp_path / "a.mcap",
        [
            ("/depth/camera_info", INFO, encoding, SECOND, info),
            ("/depth/image", IMAGE, encoding, SECOND, payload),
        ],
    )
    truth = metres(values) if stated != "32FC1" else np.nan_to_num(stored, posinf=0, neginf=0)
    (found,) = points_of(path)
    np.testing.assert_allclose(found, expected(truth), atol=1e-6)
    with open_source(path) as source:
        scan = source.scan_at(0)
    assert (scan.frame, scan.t_ns) == ("depth_optical", SECOND)
    assert scan.dropped_points == W * H - len(found)


@pytest.mark.parametrize(
    ("stated", "head"),
    [
        ("16UC1; compressedDepth", bytes(12)),
        ("16UC1; compressedDepth png", struct.pack("<iff", 0, 100.0, -0.2)),
        ("16UC1; png compressed ", b""),
    ],
)
def test_compressed_depth_and_plain_png_are_read(tmp_path, stated, head):
    values = depths()
    payload = compressed(SECOND, stated, head + png(values))
    path = depth_log(tmp_path / "a.mcap", [payload], topic="/cam/depth/image/x", kind=PACKED)
    np.testing.assert_allclose(points_of(path)[0], expected(metres(values)), atol=1e-6)


def test_compressed_depth_of_floats_holds_inverse_depths(tmp_path):
    rng = np.random.Generator(np.random.PCG64(2))
    depth, a, b = rng.uniform(0.5, 8.0, (H, W)), 1000.0, -20.0
    packed = np.rint(a / depth + b).astype(np.uint16)
    data = struct.pack("<iff", 1, a, b) + png(packed)
    path = depth_log(
        tmp_path / "a.mcap",
        [compressed(SECOND, "32FC1; compressedDepth png", data)],
        topic="/cam/depth/image/compressedDepth",
        kind=PACKED,
    )
    np.testing.assert_allclose(points_of(path)[0][:, 2], (a / (packed - b)).ravel(), rtol=1e-6)


def seen_by(lens, d, xy):
    """Where a lens images (x, y, 1), as OpenCV documents it, for one direction."""
    x, y = xy
    r = (x * x + y * y) ** 0.5
    if lens == "equidistant":
        t = np.arctan(r)
        s = t * (1 + d[0] * t**2 + d[1] * t**4 + d[2] * t**6 + d[3] * t**8)
        return (x * s / r, y * s / r) if r else (x, y)
    d = (*d, *(0.0,) * (8 - len(d)))
    f = (1 + d[0] * r**2 + d[1] * r**4 + d[4] * r**6) / (
        1 + d[5] * r**2 + d[6] * r**4 + d[7] * r**6
    )
    return (
        x * f + 2 * d[2] * x * y + d[3] * (r**2 + 2 * x * x),
        y * f + d[2] * (r**2 + 2 * y * y) + 2 * d[3] * x * y,
    )


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_is_undone_for_every_pixel_of_a_raw_image(tmp_path, lens):
    payload = image(SECOND, np.full((H, W), 2000, np.uint16), "16UC1")
    info = camera_info(SECOND, lens=lens, d=LENSES[lens])
    path = depth_log(tmp_path / "a.mcap", [payload], [("/cam/depth/camera_info", SECOND, info)])
    (found,) = points_of(path)
    assert len(found) == W * H
    pixels = [
        (K[0] * x + K[2], K[4] * y + K[5])
        for x, y in (seen_by(lens, LENSES[lens], p[:2] / p[2]) for p in found.astype(float))
    ]
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], 1), atol=1e-4)


@settings(max_examples=10)
@given(st.data())
def test_rays_of_any_lens_are_those_that_it_images_at_the_pixels(data):
    lens = data.draw(st.sampled_from(sorted(LENSES)))
    d = tuple(v * data.draw(st.floats(-2.0, 2.0)) for v in LENSES[lens])
    camera = Camera((20.0, 22.0), (7.5, 6.0), None, lens, d)
    unit = rays(camera, 16, 12)[1]
    found = unit[:, :2] / unit[:, 2:]
    known = np.isfinite(found[:, 0])
    u, v = np.meshgrid(np.arange(16), np.arange(12))
    pixels = distorted(camera, found[known]) * camera.focal + camera.centre
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], 1)[known], atol=0.011)
    assert known.mean() > 0.5


@pytest.mark.parametrize("k1", [-0.6, -0.2, -0.05])
@pytest.mark.parametrize("share", [0.5, 0.9, 0.97])
def test_directions_are_found_nearly_up_to_the_fold_of_a_lens(k1, share):
    """Of a radial lens the image of a direction of slope r grows up to r^2 = 1 / (3 |k1|)."""
    for angle in np.radians([0.0, 30.0, 60.0, 135.0, 250.0]):
        r = share / np.sqrt(-3.0 * k1)
        direction = r * np.array([np.cos(angle), np.sin(angle)])
        seen = direction * (1.0 + k1 * r * r)
        centre = (-500.0 * seen[0], -400.0 * seen[1])
        camera = Camera((500.0, 400.0), centre, None, "plumb_bob", (k1, 0.0, 0.0, 0.0, 0.0))
        np.testing.assert_allclose(rays(camera, 1, 1)[0][0, 0], direction, atol=1e-4)


def test_pixels_beyond_the_fold_of_a_lens_give_no_point():
    camera = Camera((10.0, 10.0), (16.0, 12.0), None, "plumb_bob", (-0.6, 0.0, 0.0, 0.0, 0.0))
    raw = depth_cloud(DepthImage(0, "", np.full((H, W), 1000, np.uint16)), camera)
    seen = np.isfinite(raw.column("x"))
    assert 0 < np.count_nonzero(seen) < W * H
    np.testing.assert_array_equal(np.isfinite(raw.rays).all(axis=1), seen)


def test_missing_returns_are_the_rays_of_the_empty_pixels():
    values = np.full((H, W), 1500, np.uint16)
    values[5, 7] = values[20, 3] = 0
    camera = Camera((30.0, 31.0), (15.2, 11.7))
    raw = depth_cloud(DepthImage(0, "", values), camera)
    rays_3d = np.array(
        [[(7 - 15.2) / 30, (5 - 11.7) / 31, 1], [(3 - 15.2) / 30, (20 - 11.7) / 31, 1]]
    )
    truth = rays_3d / np.linalg.norm(rays_3d, axis=1)[:, None]
    np.testing.assert_allclose(raw.rays[np.isnan(raw.column("z"))], truth, atol=1e-7)


def test_a_rectified_image_uses_the_projection_and_a_raw_one_the_lens(tmp_path):
    values = depths()
    P = (25.0, 0.0, 14.0, 0.0, 0.0, 26.0, 12.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    info = camera_info(SECOND, d=LENSES["plumb_bob"], p=P)
    infos = [("/cam/depth/camera_info", SECOND, info)]
    payload = image(SECOND, values, "16UC1")
    path = depth_log(tmp_path / "a.mcap", [payload], infos, topic="/cam/depth/image_rect_raw")
    truth = expected(metres(values), (25.0, 0, 14.0, 0, 26.0, 12.0))
    np.testing.assert_allclose(points_of(path)[0], truth, atol=1e-6)
    raw = depth_log(tmp_path / "b.mcap", [payload], infos, topic="/cam/depth/image_unrectified")
    assert np.abs(points_of(raw)[0] - truth).max() > 0.05


def test_region_and_binning_of_the_camera_are_used(tmp_path):
    values = depths()
    k = (60.0, 0.0, 40.0, 0.0, 62.0, 30.0, 0.0, 0.0, 1.0)
    info = camera_info(SECOND, k, size=(128, 96), binning=2, roi=(10, 6, 2 * W, 2 * H))
    path = depth_log(
        tmp_path / "a.mcap",
        [image(SECOND, values, "16UC1")],
        [("/cam/depth/camera_info", SECOND, info)],
    )
    truth = expected(metres(values), (30.0, 0, 15.0, 0, 31.0, 12.0))
    np.testing.assert_allclose(points_of(path)[0], truth, atol=1e-6)


def test_each_image_has_the_camera_that_is_next_to_it_by_name_then_frame_then_time(tmp_path):
    values, other = depths(), (99.0, *K[1:])
    focal = {1: 30.0, 2: 30.0, 3: 45.0, 4: 45.0}
    infos = [("/cam/colour/camera_info", SECOND, camera_info(SECOND, other))]
    for t, f in ((1, 30.0), (4, 45.0)):
        k = (f, *K[1:])
        infos.append(("/cam/depth/camera_info", t * SECOND, camera_info(t * SECOND, k)))
    payloads = [image(t * SECOND, values, "16UC1") for t in focal]
    path = depth_log(tmp_path / "a.mcap", payloads, infos)
    for found, f in zip(points_of(path), focal.values(), strict=True):
        np.testing.assert_allclose(found, expected(metres(values), (f, *K[1:])), atol=1e-6)
    infos = [
        ("/a/camera_info", SECOND, camera_info(SECOND, other, frame="elsewhere")),
        ("/b/camera_info", SECOND, camera_info(SECOND)),
        ("/c/camera_info", SECOND, camera_info(SECOND, other, frame="elsewhere")),
    ]
    path = depth_log(tmp_path / "b.mcap", payloads[:1], infos)
    np.testing.assert_allclose(points_of(path)[0], expected(metres(values)), atol=1e-6)


def test_a_log_without_camera_or_of_another_size_is_refused_by_name(tmp_path):
    payload = image(SECOND, depths(), "16UC1")
    path = depth_log(tmp_path / "a.mcap", [payload], [])
    with pytest.raises(UnreadableInput, match="no CameraInfo"):
        open_source(path)
    given_ = points_of(path, intrinsics="30,31,15.2,11.7")[0]
    np.testing.assert_allclose(given_, expected(metres(depths())), atol=1e-6)
    with pytest.raises(UnreadableInput, match="not the intrinsics"):
        points_of(path, intrinsics="30,31,x,11.7")
    infos = [("/cam/depth/camera_info", SECOND, camera_info(SECOND, size=(64, 48)))]
    with open_source(depth_log(tmp_path / "b.mcap", [payload], infos)) as source:
        scan = source.scan_at(0)
    assert scan.status.value == "damaged"
    assert "32 x 24" in str(scan.note)
    assert "64 x 48" in str(scan.note)


def test_colour_images_are_no_scans_and_clouds_come_first(tmp_path):
    depth, colour = (
        image(SECOND, depths(), "16UC1"),
        image(SECOND, np.zeros((H, W), np.uint8), "8UC1"),
    )
    base = [
        ("/cam/depth/camera_info", INFO, "cdr", SECOND, camera_info(SECOND)),
        ("/cam/colour/image", IMAGE, "cdr", SECOND, colour),
        ("/cam/ir/image", IMAGE, "cdr", SECOND, image(SECOND, depths(), "mono16")),
    ]
    alone = log(tmp_path / "a.mcap", base)
    with pytest.raises(UnreadableInput, match="no cloud topic"):
        open_source(alone)
    both = [*base, ("/cam/depth/image", IMAGE, "cdr", SECOND, depth)]
    with open_source(log(tmp_path / "b.mcap", both)) as source:
        assert source.info().cloud_topic == "/cam/depth/image"
    more = [*both, ("/cam/depth/other", IMAGE, "cdr", SECOND, depth)]
    path = log(tmp_path / "c.mcap", more)
    with pytest.raises(UsageError, match="2 cloud topics"):
        open_source(path)
    assert len(points_of(path, topic="/cam/depth/other")) == 1


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "Draco"),
        ("foxglove.CompressedPointCloud", "Draco"),
        ("velodyne_msgs/msg/VelodyneScan", "driver"),
        ("ouster_sensor_msgs/msg/PacketMsg", "driver"),
        ("sensor_msgs/msg/LaserScan", "laser_assembler"),
    ],
)
def test_messages_that_must_be_converted_say_how(tmp_path, kind, word):
    path = log(tmp_path / "a.mcap", [("/x", kind, "cdr", SECOND, bytes(40))])
    with pytest.raises(UnreadableInput, match=word):
        open_source(path)


def test_a_png_of_another_kind_or_size_is_refused_before_it_is_decompressed():
    values = depths()
    whole = png(values)
    np.testing.assert_array_equal(read_png(whole, LIMIT), values)
    for broken, why in (
        (png((values >> 8).astype(np.uint8)), "8 bits"),
        (whole[:-40], "cannot be decompressed"),
        (b"\x89PNG\r\n\x1a\n", "not a PNG"),
        (whole[:16] + struct.pack(">II", 60000, 60000) + whole[24:], "over the limit"),
        (whole[:16] + struct.pack(">II", 33, 24) + whole[24:], r"decompressed|match"),
    ):
        with pytest.raises(BadMessage, match=why):
            read_png(broken, LIMIT)


FILES = {
    "Intrinsic.txt": "30 0 15.2\n0 31 11.7\n0 0 1\n",
    "camera.txt": "30, 31, 15.2, 11.7",
    "intrinsics.json": json.dumps(
        {"fx": 30, "fy": 31, "cx": 15.2, "cy": 11.7, "width": W, "height": H}
    ),
    "camera_intrinsic.json": json.dumps(
        {"width": W, "height": H, "intrinsic_matrix": [30, 0, 0, 0, 31, 0, 15.2, 11.7, 1]}
    ),
    "scene_camera.json": json.dumps({"0": {"cam_K": list(K), "depth_scale": 1.0}}),
    "camera_info.yaml": (
        "image_width: 32\nimage_height: 24\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [30, 0, 15.2, 0, 31, 11.7, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_a_folder_of_depth_images_is_read_with_the_intrinsics_beside_it(tmp_path, name):
    folder = tmp_path / "depth"
    folder.mkdir()
    for k in (10, 9):
        (folder / f"depth_{k}.png").write_bytes(png(depths(k)))
    (tmp_path / name).write_text(FILES[name])
    for found, k in zip(points_of(folder), (9, 10), strict=True):
        np.testing.assert_allclose(found, expected(metres(depths(k))), atol=1e-6)


def test_the_intrinsics_of_a_folder_are_asked_for_and_checked(tmp_path):
    (tmp_path / "depth").mkdir()
    folder = tmp_path / "depth"
    (folder / "1.png").write_bytes(png(depths()))
    with pytest.raises(UnreadableInput, match="without intrinsics"):
        open_source(folder)
    for name, text in (
        ("camera.txt", "1 2 3"),
        ("camera.txt", "0 0 0 0"),
        ("camera.json", "[1]"),
        ("camera.json", '{"fx": {}}'),
        ("camera.yaml", "a: [1\n:"),
        ("camera.yaml", "camera_matrix: {data: [1, 2]}"),
    ):
        (folder / name).write_text(text)
        with pytest.raises(UnreadableInput, match=r"intrinsics|calibrated|YAML"):
            open_source(folder)
        (folder / name).unlink()
    (folder / "camera.json").write_text(json.dumps({"cam_K": list(K), "depth_scale": 5000}))
    truth = np.where(np.isin(depths(), (0, 65535)), 0, depths() / 5000.0)
    np.testing.assert_allclose(points_of(folder)[0], expected(truth), atol=1e-6)


def test_points_beside_other_pictures_are_the_scans_of_a_folder(tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.png").write_bytes(png(depths()))
    np.save(tmp_path / "0.npy", np.ones((5, 3)))
    assert [len(p) for p in points_of(tmp_path)] == [5]


# ---- other messages of points ----

POINTS = np.random.Generator(np.random.PCG64(5)).normal(size=(7, 3)).astype(np.float32)
TIMES = np.arange(7, dtype=np.uint32) * 1_000_000


def table():
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("pad", "u1")]
    out = np.zeros(7, kinds)
    for k, axis in enumerate("xyz"):
        out[axis] = POINTS[:, k]
    out["t"] = TIMES
    return out


FOX_FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("t", 12, 5)]
POSE = (1.0, 2.0, 3.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # 90 degrees about z
MOVED = np.stack([1 - POINTS[:, 1], 2 + POINTS[:, 0], 3 + POINTS[:, 2]], axis=1)


def proto(number, value):
    """One field of a protobuf message."""
    if isinstance(value, float):
        return bytes([number << 3 | 1]) + struct.pack("<d", value)
    if isinstance(value, int):
        return bytes([number << 3 | 5]) + struct.pack("<I", value)
    size = len(value)
    head = bytes([number << 3 | 2])
    while size > 127:
        head, size = head + bytes([size & 127 | 128]), size >> 7
    return head + bytes([size]) + value


def foxglove(encoding, pose=POSE):
    data = table().tobytes()
    if encoding == "protobuf":
        stamp = bytes([1 << 3, 5, 2 << 3, 7])
        position = b"".join(proto(i + 1, v) for i, v in enumerate(pose[:3]))
        turn = b"".join(proto(i + 1, float(v)) for i, v in enumerate(pose[3:]))
        fields = b"".join(
            proto(5, proto(1, n.encode()) + proto(2, o) + bytes([3 << 3, k]))
            for n, o, k in FOX_FIELDS
        )
        return (
            proto(1, stamp) + proto(2, b"lidar") + proto(3, proto(1, position) + proto(2, turn))
        ) + (proto(4, 17) + fields + proto(6, data))
    if encoding == "json":
        turn = dict(zip("xyzw", map(float, pose[3:]), strict=True))
        return json.dumps(
            {
                "timestamp": {"sec": 5, "nsec": 7},
                "frame_id": "lidar",
                "pose": {"position": dict(zip("xyz", pose[:3], strict=True)), "orientation": turn},
                "point_stride": 17,
                "fields": [{"name": n, "offset": o, "type": k} for n, o, k in FOX_FIELDS],
                "data": base64.b64encode(data).decode(),
            }
        ).encode()
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg(
            "string name\nuint32 offset\nuint8 type\n", "foxglove_msgs/msg/PackedElementField"
        )
    )
    store.register(
        get_types_from_msg(
            "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
            "uint32 point_stride\nfoxglove_msgs/PackedElementField[] fields\nuint8[] data\n",
            "foxglove_msgs/msg/PointCloud",
        )
    )
    t = store.types
    message = t["foxglove_msgs/msg/PointCloud"](
        t["builtin_interfaces/msg/Time"](5, 7),
        "lidar",
        t["geometry_msgs/msg/Pose"](
            t["geometry_msgs/msg/Point"](*pose[:3]), t["geometry_msgs/msg/Quaternion"](*pose[3:])
        ),
        17,
        [t["foxglove_msgs/msg/PackedElementField"](*f) for f in FOX_FIELDS],
        np.frombuffer(data, np.uint8),
    )
    return bytes(store.serialize_cdr(message, "foxglove_msgs/msg/PointCloud"))


@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_a_foxglove_cloud_of_each_encoding_is_read_with_its_pose(tmp_path, encoding):
    kind = "foxglove_msgs/msg/PointCloud" if encoding == "cdr" else "foxglove.PointCloud"
    path = log(tmp_path / "a.mcap", [("/p", kind, encoding, SECOND, foxglove(encoding))])
    with open_source(path) as source:
        scan = source.scan_at(0)
    assert scan.frame == "lidar"
    np.testing.assert_allclose(scan.points, MOVED, atol=1e-6)
    np.testing.assert_allclose(scan.times_s, TIMES * 1e-9, rtol=1e-6)
    unmoved = of_layout(read_foxglove(foxglove(encoding, (0.0,) * 6 + (1.0,)), encoding))
    np.testing.assert_array_equal(coordinates(unmoved), POINTS)
    assert unmoved.stamp_ns == 5 * SECOND + 7


WHOLE = {encoding: foxglove(encoding) for encoding in ("protobuf", "json", "cdr")}


@pytest.mark.parametrize("encoding", WHOLE)
@settings(max_examples=20)
@given(data=st.data())
def test_a_damaged_foxglove_cloud_is_refused_or_read_but_raises_nothing_else(encoding, data):
    whole = bytearray(WHOLE[encoding])
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(whole)))
    try:
        layout = read_foxglove(bytes(whole[:cut]), encoding)
        of_layout(layout)
    except BadMessage:
        return
    assert layout.shape[1] * layout.point_step <= 2 * len(whole)


def livox(ros1):
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    name = "livox_ros_driver2/msg/"
    point = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    point += "uint8 reflectivity\nuint8 tag\nuint8 line\n"
    store.register(get_types_from_msg(point, f"{name}CustomPoint"))
    text = (
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        "livox_ros_driver2/CustomPoint[] points\n"
    )
    store.register(get_types_from_msg(text, f"{name}CustomMsg"))
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](5, 7)
    head = (
        t["std_msgs/msg/Header"](seq=1, stamp=stamp, frame_id="livox")
        if ros1
        else t["std_msgs/msg/Header"](stamp, "livox")
    )
    points = [
        t[f"{name}CustomPoint"](int(at), *map(float, p), 9, 16, k)
        for k, (at, p) in enumerate(zip(TIMES, POINTS, strict=True))
    ]
    message = t[f"{name}CustomMsg"](head, 5 * SECOND + 7, 7, 1, np.zeros(3, np.uint8), points)
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    return bytes(pack(message, f"{name}CustomMsg"))


@pytest.mark.parametrize("ros1", [False, True])
def test_a_livox_message_is_read_with_its_times(tmp_path, ros1):
    payload, encoding = livox(ros1), "ros1" if ros1 else "cdr"
    kind = "livox_ros_driver2/msg/CustomMsg"
    with open_source(log(tmp_path / "a.mcap", [("/p", kind, encoding, SECOND, payload)])) as source:
        scan = source.scan_at(0)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.times_s, TIMES * 1e-9, rtol=1e-6)
    np.testing.assert_array_equal(scan.intensities, [9.0] * 7)
    for size in range(0, len(payload) - 1, 3):
        with pytest.raises(BadMessage):
            read_livox(payload[:size], encoding)


@pytest.mark.parametrize("ros1", [False, True])
def test_a_point_cloud_of_the_first_kind_is_read_with_its_channels(tmp_path, ros1):
    types = (ROS1 if ros1 else ROS2).types
    payload = made(
        "sensor_msgs/msg/PointCloud",
        ros1,
        header=header(5 * SECOND, ros1=ros1),
        points=[types["geometry_msgs/msg/Point32"](*map(float, p)) for p in POINTS],
        channels=[
            types["sensor_msgs/msg/ChannelFloat32"]("intensity", np.arange(7, dtype=np.float32)),
            types["sensor_msgs/msg/ChannelFloat32"]("one", np.ones(1, np.float32)),
        ],
    )
    encoding = "ros1" if ros1 else "cdr"
    path = log(
        tmp_path / "a.mcap", [("/p", "sensor_msgs/msg/PointCloud", encoding, SECOND, payload)]
    )
    with open_source(path) as source:
        scan = source.scan_at(0)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.intensities, np.arange(7))
    for size in range(0, len(payload) - 1, 3):
        with pytest.raises(BadMessage):
            read_point_cloud(payload[:size], encoding)


@pytest.mark.slow
def test_real_depth_images_register_as_well_as_the_clouds_made_of_them(cli, shared_data):
    folder = shared_data / "primesense-bunny"
    errors = {}
    for name in ("depth", "scans"):
        done = cli("run", folder / name, "--model", folder / "model_bun_zipper.ply", "--json")
        assert done.code == 0, done.err
        rows = json.loads(done.out)["rows"]
        assert sum(row["gamma"] for row in rows) >= 33
        errors[name] = np.mean([row["rms_m"] for row in rows])
    assert errors["depth"] < 1.05 * errors["scans"]
