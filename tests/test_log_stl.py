"""Binary STL files are read as trimesh reads them, without loading SciPy."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avsreplay.binary_files import BadFile
from avsreplay.log.header import parse_surface
from avsreplay.log.stl import read_binary_stl


def _file(triangles: np.ndarray, head: bytes = b"") -> bytes:
    """A binary STL file of triangles (n, 3, 3), made without this package."""
    records = b"".join(np.zeros(3, "<f4").tobytes() + each.astype("<f4").tobytes() + b"\x07\x00" for each in triangles)
    return head.ljust(80, b"\0") + len(triangles).to_bytes(4, "little") + records


@pytest.mark.parametrize("head", [b"", b"solid of a program that writes this word", b"\xff\xfe"])
def test_corners_and_faces_are_those_of_trimesh(head: bytes) -> None:
    for seed in range(20):
        rng = np.random.Generator(np.random.PCG64(seed))
        data = _file(rng.normal(size=(int(rng.integers(1, 40)), 3, 3)) * 10.0 ** rng.integers(-4, 5), head)
        corners, faces = read_binary_stl(data)
        expected = trimesh.load(io.BytesIO(data), file_type="stl", process=False)
        assert corners.dtype == np.float64
        np.testing.assert_array_equal(corners, expected.vertices)
        np.testing.assert_array_equal(faces, expected.faces)


def test_equal_corners_of_a_model_are_one_vertex() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    surface = parse_surface(_file(ball.triangles), "ball.stl")
    assert len(surface.vertices) == len(ball.vertices)
    volume = trimesh.Trimesh(surface.vertices, surface.faces, process=False).volume
    assert volume == pytest.approx(ball.volume, rel=1e-6)


def test_other_files_are_left_to_trimesh() -> None:
    data = _file(np.ones((2, 3, 3)))
    assert read_binary_stl(b"solid a\nendsolid a\n") is None
    assert read_binary_stl(data + b"\0") is None
    assert read_binary_stl(_file(np.ones((0, 3, 3)))) is None
    assert read_binary_stl(b"solid" + data[5:-1]) is None


def test_a_file_that_is_too_short_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(BadFile, match="declares 4294967295 triangles in a file of 84 bytes"):
        read_binary_stl(bytes(80) + b"\xff" * 4)


def test_a_binary_stl_loads_no_scipy(tmp_path: Path) -> None:
    (tmp_path / "ball.stl").write_bytes(_file(trimesh.creation.icosphere(subdivisions=1).triangles))
    code = (
        "import sys\nfrom avsreplay.log import read_surface\n"
        f"read_surface({str(tmp_path / 'ball.stl')!r})\n"
        "print(sorted({'scipy', 'trimesh'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
