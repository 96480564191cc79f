"""A small file of each kind that an option accepts, made to take much memory or time, takes what
its budget allows: every input of every command has one.
"""

from __future__ import annotations

import io
import json
import sqlite3
import struct
import tracemalloc

import fuzz_commands
import numpy as np
import pytest
import trimesh  # noqa: F401 (its import is not part of what a reader takes)

from avsreplay import checkpoint, toml_document
from avsreplay.errors import AvsError
from avsreplay.log import SourceOptions, open_source, read_surface
from avsreplay.log.pose_files import read_poses
from avsreplay.log.scan_files import read_points
from avsreplay.read_budget import BYTES_PER_BYTE, LEAST_BUDGET_BYTES, BadFile
from avsreplay.report.jsonl import read_json, read_rows
from avsreplay.report.view import read_view
from avsreplay.result_dir import read_beliefs

LIBRARIES = 24 << 20  # bytes that the import of a library takes
ZEROS = np.zeros((2 << 20, 3))


def zipped(name: str) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **{name: ZEROS})
    return out.getvalue()


def head(kind: str, count: int, *lines: str) -> bytes:
    return "\n".join([kind, *lines, ""]).format(n=count).encode()


def chunk_of_mcap() -> bytes:
    """A chunk that declares 2^60 bytes after decompression."""
    body = struct.pack("<QQQII", 0, 0, 1 << 60, 0, 4) + b"zstd" + struct.pack("<Q", 0)
    magic = b"\x89MCAP0\r\n"
    header = b"\x01" + struct.pack("<QII", 8, 0, 0)
    return magic + header + b"\x06" + struct.pack("<Q", len(body)) + body + magic


def chunk_of_bag() -> bytes:
    """A chunk that declares 4 GiB after decompression."""
    fields = b"".join(
        struct.pack("<I", len(f)) + f
        for f in (b"op=\x05", b"compression=lz4", b"size=\xff\xff\xff\xff")
    )
    return b"#ROSBAG V2.0\n" + struct.pack("<I", len(fields)) + fields + struct.pack("<I", 0)


def computed_column(path) -> None:
    """A database whose data are computed when they are read; its SQL has no word for it."""
    with sqlite3.connect(path) as db:
        db.execute(
            "CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)"
        )
        db.execute(
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB AS (zeroblob(100000000)))"
        )
        db.execute("INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr')")
        db.executemany("INSERT INTO messages VALUES (?, 1, ?)", [(k, k) for k in range(20)])
    db.close()


def opened(path) -> None:
    with open_source(path, SourceOptions()) as source:
        raise BadFile(f"{len(source)} scans")


def points(path) -> None:
    read_points(path, 128 << 20)


def model(path) -> None:
    read_surface(path, cloud_ok=True)


MANY = "9" * 9
CLOUD = (
    f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {MANY}\nHEIGHT 1\nPOINTS {MANY}\n"
)
GLB = json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": 1 << 40}]}).encode()


def scene(nodes: int, parts: int) -> bytes:
    """A small mesh that is placed many times, or of many parts of the same numbers."""
    corners, faces = np.zeros((900, 3), "<f4"), np.arange(900, dtype="<u4")
    part = {"attributes": {"POSITION": 0}, "indices": 1}
    views = [(0, corners.nbytes), (corners.nbytes, faces.nbytes)]
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [*range(nodes)]}],
        "nodes": [{"mesh": 0}] * nodes,
        "meshes": [{"primitives": [part] * parts}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 900, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 900, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size in views],
        "buffers": [{"byteLength": corners.nbytes + faces.nbytes}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = corners.tobytes() + faces.tobytes()
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


BOMBS = {
    "toml": (b"a." * 20_000 + b"a=1", toml_document.load),
    "npz": (lambda: zipped("points"), points),
    "npy": (
        b"\x93NUMPY\x01\x00\x76\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (900000000, 3), }".ljust(118),
        points,
    ),
    "pcd": (f"{CLOUD}DATA binary\n".encode(), points),
    "ply": (
        head(
            "ply",
            10**9,
            "format binary_little_endian 1.0",
            "element vertex {n}",
            "property double x",
            "end_header",
        ),
        model,
    ),
    "obj": (
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f " + "1 2 3 " * 5000 + "\nf 1 2 999999999\n").encode(),
        model,
    ),
    "stl": (b"\0" * 80 + struct.pack("<I", 0xFFFFFFFF) + b"\0" * 50, model),
    "ascii.stl": (b"solid a\n" + b"facet normal 0 0 1\n" * 20_000, model),
    "off": (b"OFF\n999999999 999999999 0\n0 0 0\n", model),
    "glb": (struct.pack("<4sIIII", b"glTF", 2, 20 + len(GLB), len(GLB), 0x4E4F534A) + GLB, model),
    "placed.glb": (lambda: scene(8000, 1), model),
    "parts.glb": (lambda: scene(1, 3000), model),
    "mcap": (chunk_of_mcap, opened),
    "bag": (chunk_of_bag, opened),
    "db3": (computed_column, opened),
    "tum": (b"1 " + b"9" * 400_000 + b" 0 0 0 0 0 1\n", read_poses),
    "kitti": (b"1e9999 " * 12 + b"\n", read_poses),
    "csv": (b"t," * 20_000 + b"\n", read_poses),
    "txt": (b"1 " * 200_000 + b"\n", read_poses),
    "jsonl": (b'{"seq": ' + b"[" * 200_000 + b"\n", read_rows),
    "json": (b"[" * 400_000, lambda path: read_json(path, hint="")),
    "view.npz": (lambda: zipped("vertices"), read_view),
    "beliefs.npz": (lambda: zipped("P"), read_beliefs),
    "resume.npz": (lambda: zipped("state.json"), lambda path: checkpoint.unpack(path, {})),
}
GIVEN = {  # arguments of a command that reads the bomb; LOG is a sound log
    **dict.fromkeys(
        ("stl", "ascii.stl", "off", "glb", "placed.glb", "parts.glb", "ply"),
        ("info", "LOG", "--model", "BOMB"),
    ),
    **dict.fromkeys(("tum", "csv", "txt"), ("info", "LOG", "--truth", "BOMB")),
    **dict.fromkeys(("mcap", "bag", "db3"), ("info", "BOMB")),
    "jsonl": ("compare", "BOMB", "BOMB"),
}
FOLDERS = {
    "clouds": ("npy", "npz", "pcd", "ply"),
    "scans": ("npy", "npz", "pcd", "ply"),
    "result": ("json", "jsonl", "tum", "view.npz", "beliefs.npz"),
    "interrupted": ("json", "jsonl", "resume.npz"),
    "sweep": ("jsonl",),
    "cache": ("npz",),
}


def test_every_input_of_every_command_has_a_bomb_of_its_kind():
    listed = fuzz_commands.listed()
    seeds = {seed for case in listed for seed in fuzz_commands.CASES[case][1]}
    kinds = {kind for seed in seeds for kind in FOLDERS.get(seed, (seed.partition(".")[2],))}
    assert kinds <= BOMBS.keys()
    assert len(listed) > 30


def written(folder, kind):
    content, path = BOMBS[kind][0], folder / f"bomb.{kind}"
    if kind == "db3":
        content(path)
    else:
        path.write_bytes(content() if callable(content) else content)
    return path


@pytest.mark.parametrize("kind", BOMBS)
def test_a_bomb_is_refused_within_its_budget(tmp_path, kind):
    path, read = written(tmp_path, kind), BOMBS[kind][1]
    tracemalloc.start()
    try:
        with pytest.raises((AvsError, BadFile)):
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < LEAST_BUDGET_BYTES + BYTES_PER_BYTE * path.stat().st_size + LIBRARIES


@pytest.mark.parametrize("kind", GIVEN)
def test_a_command_refuses_a_bomb_in_one_line(cli, fixtures_folder, tmp_path, kind):
    named = {"LOG": fixtures_folder / "tumble.mcap", "BOMB": written(tmp_path, kind)}
    done = cli(*(named.get(word, word) for word in GIVEN[kind]))
    assert done.code == (4 if kind in ("mcap", "bag") else 3), done.err  # 4: a chunk is left out
    assert len(done.err.splitlines()) == 1
