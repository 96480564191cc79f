"""Seeds and mutations of the fuzz campaigns: input i of a campaign depends only on (campaign,
i).
"""

from __future__ import annotations

import io
import json
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from log_cases import SECOND, header, scans, write
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from avsreplay.log import mcap_format as mcap
from avsreplay.log.cdr import point_cloud2, pose_stamped, schema_text

CLOUD, POSE = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped"
NUMBERS = (
    0,
    1,
    2,
    7,
    8,
    12,
    127,
    128,
    255,
    256,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**32,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
WORDS = (
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"4294967296",
    b"99999999999999999999",
    b"",
    b"-",
    b"\x1b[31m",
    b"\xff\xfe",
    b"../../x",
)


def seeds() -> dict[str, bytes]:
    """One small valid file of every kind, by file name."""
    with tempfile.TemporaryDirectory() as folder:
        out = {**_logs(Path(folder)), **_scans(), **_models(), **_poses()}
    out["scenario.toml"] = (
        b'seed = 3\n[target]\nextent_m = 2.0\nname = "box"\n[[faults]]\nkind = "occlusion"\nstart_s'
        b" = 1.0\n"
    )
    return out


def _logs(folder: Path) -> dict[str, bytes]:
    clouds, out = scans(3, 20, timed=True), {}
    head = header(np.random.Generator(np.random.PCG64(1)))
    for name in ("none", "lz4", "zstd"):
        write(folder / f"{name}.mcap", head, clouds, compression=name)
        out[f"{name}.mcap"] = (folder / f"{name}.mcap").read_bytes()
    stream = io.BytesIO()
    writer = McapWriter(stream, use_chunking=False, compression=CompressionType.NONE)
    writer.start("ros2")
    channel = writer.register_channel(
        "/p", "cdr", writer.register_schema(CLOUD, "ros2msg", schema_text(CLOUD))
    )
    for c in clouds:
        writer.add_message(channel, c.log_ns, point_cloud2(c.t_ns, "s", c.points, None), c.log_ns)
    writer.finish()
    out["flat.mcap"] = stream.getvalue()
    for number, compression in enumerate((None, *Ros1Writer.CompressionFormat)):
        out[f"ros{number}.bag"] = _bag1(folder / f"{number}.bag", compression)
    out["ros2.db3"] = _bag2(folder / "bag")
    return out


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def cloud1(points: np.ndarray) -> bytes:  # type: ignore[type-arg]
    """A PointCloud2 in the wire form of ROS 1."""
    fields = b"".join(
        _text(name) + struct.pack("<IBI", 4 * i, 7, 1) for i, name in enumerate("xyz")
    )
    data = np.ascontiguousarray(points, dtype="<f4").tobytes()
    head = struct.pack("<III", 1, 7, 8) + _text("lidar") + struct.pack("<III", 1, len(points), 3)
    return (
        head
        + fields
        + struct.pack("<?II", False, 12, len(data))
        + struct.pack("<I", len(data))
        + data
        + b"\x01"
    )


def _bag1(path: Path, compression: Ros1Writer.CompressionFormat | None) -> bytes:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = 500
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=store)
        for c in scans(3, 20):
            writer.write(connection, c.log_ns, cloud1(c.points))
    return path.read_bytes()


def _bag2(path: Path) -> bytes:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Ros2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        cloud = writer.add_connection("/points", CLOUD, typestore=store)
        truth = writer.add_connection("/truth/pose", POSE, typestore=store)
        for c in scans(3, 20):
            writer.write(cloud, c.log_ns, point_cloud2(c.t_ns, "camera", c.points, None))
            from avsreplay.geometry import Pose

            writer.write(truth, c.log_ns, pose_stamped(c.t_ns, "camera", Pose.identity()))
    return next(path.glob("*.db3")).read_bytes()


def _scans() -> dict[str, bytes]:
    points = scans(1, 24)[0].points
    rows = "\n".join(" ".join(repr(float(v)) for v in p) for p in points)
    grid = b"element range_grid 4\nproperty list uchar int vertex_indices\n"
    head = (
        b"ply\nformat %s 1.0\ncomment x\nelement vertex 24\nproperty float x\nproperty float"
        b" y\nproperty float z\n"
    )
    out = {
        "ascii.ply": (
            head % b"ascii" + grid + b"end_header\n" + rows.encode() + b"\n0\n1 3\n2 1 2\n0\n"
        )
    }
    lists = b"\x00\x01\x00\x00\x00\x03\x00\x02\x00\x00\x00\x01\x00\x00\x00\x02\x00"
    out["little.ply"] = (
        head % b"binary_little_endian"
        + grid
        + b"end_header\n"
        + points.astype("<f4").tobytes()
        + lists
    )
    out["big.ply"] = head % b"binary_big_endian" + b"end_header\n" + points.astype(">f4").tobytes()
    pcd = "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    pcd += "WIDTH 24\nHEIGHT 1\nPOINTS 24\nDATA {}\n"
    out["ascii.pcd"] = (
        pcd.format("ascii") + "\n".join(r + " 3" for r in rows.split("\n"))
    ).encode()
    table = np.zeros(24, dtype=[("p", "<f4", (3,)), ("i", "u1")])
    table["p"] = points
    out["binary.pcd"] = pcd.format("binary").encode() + table.tobytes()
    columns = points.T.astype("<f4").tobytes() + bytes(24)
    packed = b"".join(
        bytes([len(columns[i : i + 32]) - 1]) + columns[i : i + 32]
        for i in range(0, len(columns), 32)
    )
    packed = (
        packed[:-25] + b"\x00\x00" + bytes([0xE0, 14, 0])
    )  # a literal zero and a reference 23 long
    sizes = struct.pack("<II", len(packed), len(columns))
    out["packed.pcd"] = pcd.format("binary_compressed").encode() + sizes + packed
    out["kitti.bin"] = np.hstack([points, points[:, :1]]).astype("<f4").tobytes()
    for name, save in (("a.npy", np.save), ("a.npz", np.savez)):
        stream = io.BytesIO()
        save(stream, points)  # type: ignore[operator]
        out[name] = stream.getvalue()
    return out


def _models() -> dict[str, bytes]:
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    out = {
        f"model.{kind}": box.export(file_type=kind) for kind in ("stl", "obj", "off", "glb", "ply")
    }
    out["model.ascii.stl"] = trimesh.exchange.stl.export_stl_ascii(box)
    return {
        name: data.encode() if isinstance(data, str) else bytes(data) for name, data in out.items()
    }


def _poses() -> dict[str, bytes]:
    return {
        "poses.tum": b"# t\n1.0 0 0 1 0 0 0 1\n1.5 0 0 1 0 0 0.1 0.995\n",
        "poses.kitti": b"1 0 0 0 0 1 0 0 0 0 1 5\n1 0 0 0 0 1 0 0 0 0 1 6\n",
        "poses.euroc": b"#t,p\n1000000000,0,0,1,1,0,0,0\n",
        "poses.conf": b"camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 1 0 0 0 1\n",
        "cloud.cdr": point_cloud2(
            5 * SECOND, "camera", scans(1, 9)[0].points, np.zeros(9, np.float32)
        ),
        "cloud.ros1": cloud1(scans(1, 9)[0].points),
    }


def mutate(data: bytes, rng: np.random.Generator, others: list[bytes]) -> bytes:
    """One to eight mutations; an uncompressed MCAP's chunks are given checksums that hold
    again half of the time.
    """
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if out:
            out = bytearray(MUTATIONS[int(rng.integers(len(MUTATIONS)))](out, rng, others))
    if rng.random() < 0.5 and out[:8] == mcap.MCAP_MAGIC:
        _mend(out)
    return bytes(out)


def in_place(data: bytes, rng: np.random.Generator) -> bytes:
    """One to three changes that keep the length; the checksums of an uncompressed MCAP hold
    again.
    """
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        if out:
            size, change = len(out), (_flip, _set, _number)[int(rng.integers(3))]
            out = change(out, rng, [])[:size]
    if out[:8] == mcap.MCAP_MAGIC:
        _mend(out)
    return bytes(out)


def _flip(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    at = int(rng.integers(len(out)))
    out[at] ^= 1 << int(rng.integers(8))
    return out


def _set(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    out[int(rng.integers(len(out)))] = int(rng.integers(256))
    return out


def _number(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    size = int(rng.choice([2, 4, 8]))
    at = int(rng.integers(len(out)))
    value = NUMBERS[int(rng.integers(len(NUMBERS)))] & ((1 << 8 * size) - 1)
    out[at : at + size] = value.to_bytes(size, "little" if rng.random() < 0.8 else "big")
    return out


def _cut(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    return out[: int(rng.integers(len(out) + 1))]


def _delete(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    at = int(rng.integers(len(out)))
    del out[at : at + int(rng.integers(1, 65))]
    return out


def _insert(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    at = int(rng.integers(len(out) + 1))
    out[at:at] = rng.integers(0, 256, int(rng.integers(1, 65)), dtype=np.uint8).tobytes()
    return out


def _repeat(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    at, size = int(rng.integers(len(out))), int(rng.integers(1, 257))
    out[at:at] = out[at : at + size] * int(rng.integers(1, 5))
    return out


def _splice(out: bytearray, rng: np.random.Generator, others: list[bytes]) -> bytearray:
    other = others[int(rng.integers(len(others)))]
    at, there = int(rng.integers(len(out))), int(rng.integers(max(len(other), 1)))
    return out[:at] + other[there : there + int(rng.integers(1, 2049))] + out[at:]


def _word(out: bytearray, rng: np.random.Generator, _: list[bytes]) -> bytearray:
    """A number in a text becomes another."""
    at = int(rng.integers(len(out)))
    end = at
    while end < len(out) and out[end : end + 1].isalnum():
        end += 1
    out[at:end] = WORDS[int(rng.integers(len(WORDS)))]
    return out


MUTATIONS: tuple[Callable[[bytearray, np.random.Generator, list[bytes]], bytearray], ...] = (
    _flip,
    _flip,
    _set,
    _number,
    _number,
    _cut,
    _delete,
    _insert,
    _repeat,
    _splice,
    _word,
)


def _mend(out: bytearray) -> None:
    """Checksums of the uncompressed chunks that can still be walked to, so that what is inside them
    is parsed.
    """
    at = 8
    while at + 49 <= len(out):
        opcode, length = struct.unpack_from("<BQ", out, at)
        if (
            opcode == mcap.Opcode.CHUNK
            and length > 40
            and at + 9 + length <= len(out)
            and out[at + 37 : at + 41] == bytes(4)
        ):
            data = bytes(out[at + 49 : at + 9 + length])
            struct.pack_into("<QI", out, at + 25, len(data), zlib.crc32(data))
            struct.pack_into("<Q", out, at + 41, len(data))
        if opcode == mcap.Opcode.ATTACHMENT and length > 4 and at + 9 + length <= len(out):
            struct.pack_into(
                "<I", out, at + 5 + length, zlib.crc32(bytes(out[at + 9 : at + 5 + length]))
            )
        at += 9 + length


def case(campaign: int, number: int, corpus: dict[str, bytes]) -> tuple[str, bytes]:
    """Input ``number`` of a campaign: the name of its seed and its bytes."""
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([campaign, number])))
    names = sorted(corpus)
    name = names[int(rng.integers(len(names)))]
    kind = name.rsplit(".", 1)[-1]
    others = [corpus[n] for n in names if n.rsplit(".", 1)[-1] == kind]
    return name, mutate(corpus[name], rng, others)


def digest(corpus: dict[str, bytes]) -> str:
    """One line that tells whether two machines start from the same seeds."""
    return json.dumps({name: zlib.crc32(data) for name, data in sorted(corpus.items())})
