"""A saved index gives the same bits as a built one, and a damaged file is not used."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avsreplay import geometry
from avsreplay.geometry import Array, Pose
from avsreplay.records import Surface
from avsreplay.register import index_cache
from avsreplay.register.contract import view
from avsreplay.register.global_search import GlobalSearch
from avsreplay.register.near_symmetry import NearSymmetry
from avsreplay.register.params import RegisterParams
from avsreplay.register.registrar import Registrar
from avsreplay.register.surface_index import SurfaceIndex

kernel = pytest.importorskip("avsreplay.register._kernel", reason="the C++ kernel is not built")

NO_FACES = np.zeros((0, 3), dtype=np.int32)


def rng(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(seed))


@pytest.fixture(params=["mesh", "cloud"])
def surface(request: pytest.FixtureRequest) -> Surface:
    vertices = rng(1).standard_normal((900, 3))
    faces = np.arange(900, dtype=np.int32).reshape(-1, 3) if request.param == "mesh" else NO_FACES
    return Surface(vertices, faces, "test", "")


def answers(model: SurfaceIndex) -> bytes:
    found = model.closest(rng(2).uniform(-3, 3, (2000, 3)))
    arrays: list[Array] = [found.foot, found.d2, found.normal]
    return found.id.tobytes() + b"".join(a.tobytes() for a in arrays)


def saved(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


def test_a_restored_index_gives_the_same_bits(surface: Surface, tmp_path: Path) -> None:
    built = SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
    restored = SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
    assert (built.restored, restored.restored) == (False, True)
    assert answers(built) == answers(restored) == answers(SurfaceIndex.build(surface, 0.5))
    assert saved(tmp_path).suffix == ".avsindex"


def test_another_reach_or_surface_is_another_file(surface: Surface, tmp_path: Path) -> None:
    SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
    moved = Surface(surface.vertices + 1e-9, surface.faces, "test", "")
    assert not SurfaceIndex.build(surface, np.nextafter(0.5, 1), cache_dir=tmp_path).restored
    assert not SurfaceIndex.build(moved, 0.5, cache_dir=tmp_path).restored
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("harm", ["short", "empty", "flipped", "longer", "magic"])
def test_a_damaged_file_is_rebuilt(surface: Surface, tmp_path: Path, harm: str) -> None:
    want = answers(SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path))
    path = saved(tmp_path)
    data = bytearray(path.read_bytes())
    if harm == "flipped":
        data[len(data) // 2] ^= 1
    changed = {
        "short": data[:-1],
        "empty": b"",
        "longer": data + b"\0",
        "magic": b"X" + data[1:],
    }.get(harm, data)
    path.write_bytes(bytes(changed))
    again = SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
    assert not again.restored
    assert answers(again) == want
    assert SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path).restored


@pytest.mark.slow
def test_a_damaged_payload_is_never_used(surface: Surface, tmp_path: Path) -> None:
    """Payloads with a right checksum but random words in them: refused, or searched without
    leaving the arrays.
    """
    SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
    path = saved(tmp_path)
    good = path.read_bytes()[index_cache.HEADER :]
    r = rng(3)
    restored = 0
    for _ in range(40):
        bad = bytearray(good)
        for at in r.integers(0, len(good) // 4, size=r.integers(1, 40)):
            bad[4 * at : 4 * at + 4] = r.integers(0, 2**32, dtype=np.uint32).tobytes()
        path.write_bytes(index_cache.header(bytes(bad), kernel.checksum) + bad)
        model = SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)
        restored += model.restored
        assert len(answers(model)) == len(answers(model))
    assert restored < 40


def test_a_missing_folder_is_made_and_an_unusable_one_changes_nothing(
    surface: Surface, tmp_path: Path
) -> None:
    want = answers(SurfaceIndex.build(surface, 0.5))
    assert not SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path / "a" / "b").restored
    assert SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path / "a" / "b").restored
    (tmp_path / "file").write_bytes(b"")
    built = SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path / "file" / "below")
    assert answers(built) == want
    assert (tmp_path / "file").read_bytes() == b""


def test_writers_at_the_same_time_leave_one_whole_file(surface: Surface, tmp_path: Path) -> None:
    def build() -> None:
        SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path)

    writers = [threading.Thread(target=build) for _ in range(6)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert saved(tmp_path).suffix == ".avsindex"
    assert SurfaceIndex.build(surface, 0.5, cache_dir=tmp_path).restored


def test_the_users_cache_folder_follows_the_platform(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert index_cache.user_folder() == tmp_path / "avsreplay"
    for home in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(home, str(tmp_path / "home"))
    for relative in ("", "cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert index_cache.user_folder() == tmp_path / "home" / ".cache" / "avsreplay"
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    assert index_cache.user_folder() is None


def test_a_registrar_keeps_the_index_of_a_large_model_unless_told_not_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    large = Surface(rng(5).standard_normal((index_cache.LEAST_PRIMITIVES, 3)), NO_FACES, "test", "")
    small = Surface(large.vertices[:100], NO_FACES, "test", "")
    Registrar(large, RegisterParams(index_cache=False))
    Registrar(small)
    assert not list(tmp_path.iterdir())
    registrar = Registrar(large)
    assert len(list((tmp_path / "avsreplay").iterdir())) == 1  # the index
    registrar.acquire(large.vertices[:200])
    assert len(list((tmp_path / "avsreplay").iterdir())) == 2  # and what a search needs


def _searched(registrar: Registrar) -> list[bytes]:
    """What a search uses: the motions, the marks, and their effect on poses from four sides."""
    symmetry = registrar.loop.symmetry
    arrays, contradicted = [symmetry.search.symmetries, symmetry.marks, symmetry.normals], 0.0
    about_axis = Pose(geometry.exp([0.0, 0.0, 1.0]), np.zeros(3))
    for turn in (1.0, 2.0, 4.0, 5.0):
        T_ac = Pose(geometry.exp([turn, 0.0, 0.0]), np.array([0.0, 0.0, 9.0]))
        T_ca = T_ac.inverse()
        rays = symmetry.rays(T_ac.apply(view(registrar.target.surface, 1500, T_ca.t)))
        arrays += [each.matrix for each in symmetry.turned_poses(rays, T_ca, False)]
        measured = symmetry.measured(rays, about_axis @ T_ca)
        contradicted += measured.passed + measured.empty
        arrays += [measured.distance, np.array([measured.passed, measured.empty])]
    assert contradicted > 0.0
    return [a.tobytes() for a in arrays] + [bytes([symmetry.near, symmetry.marked])]


def test_what_a_search_needs_is_kept_with_the_index_and_made_again_if_damaged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A nearly symmetric body: its near-symmetries and marks are the same from the file,
    built, or after damage.
    """
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(index_cache, "LEAST_PRIMITIVES", 10)
    shape = trimesh.util.concatenate(
        [
            trimesh.creation.cylinder(0.5, 2.5, sections=24),
            trimesh.creation.box((0.2, 0.2, 0.2)).apply_translation((0.55, 0, 0)),
        ]
    )
    surface = Surface(np.array(shape.vertices), np.array(shape.faces, dtype=np.int32), "stage", "")
    built = _searched(Registrar(surface, RegisterParams(index_cache=False)))
    assert len(built) > 5
    assert _searched(Registrar(surface)) == built
    with monkeypatch.context() as patched:
        patched.setattr(GlobalSearch, "_near_symmetries", None)
        patched.setattr(NearSymmetry, "_found", None)
        assert _searched(Registrar(surface)) == built
    for path in (tmp_path / "avsreplay").iterdir():
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 1
        path.write_bytes(bytes(data))
    assert _searched(Registrar(surface)) == built


def test_arrays_that_another_program_wrote_are_ignored(tmp_path):
    def checksum(payload):
        return int(np.asarray(payload, np.uint64).sum())

    path = tmp_path / "x.avsindex"
    index_cache.write_arrays(path, {"a": np.arange(300.0)}, checksum)
    payload = bytearray(index_cache.read(path, checksum).tobytes())
    payload[1000] ^= 1
    index_cache.write(path, bytes(payload), checksum)
    assert index_cache.read(path, checksum) is not None
    assert index_cache.read_arrays(path, checksum) == {}
