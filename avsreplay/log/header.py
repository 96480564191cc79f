"""The header of a log and the model of the target that it names.

The header (scenario, seed, fault labels, start state) is one MCAP metadata record of JSON values.
Floats are written in their shortest exact form, so that a header read back equals the one written,
bit for bit. MCAP has no checksum for metadata records; this record contains one over its own
values.

The model is an attachment or a file of its own: PLY and PCD are read with the readers of this
package, STL, OBJ, OFF and GLB with trimesh.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import mesh
from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput
from avsreplay.files import refuse_pointer
from avsreplay.geometry import Array, frozen
from avsreplay.log.bytes_io import shown
from avsreplay.log.ply import read_ply
from avsreplay.log.returns import MAX_COORDINATE_M
from avsreplay.log.scan_files import read_pcd
from avsreplay.read_budget import BadFile, ReadBudget
from avsreplay.records import STATE_SIZES, Belief, Label, LogHeader, State, Surface

HEADER_RECORD = "avsreplay"
OWN_MODEL = b"comment reconstructed by avsreplay"  # marks a built model
_OWN_MODEL_BYTES = 1024  # begin of a file in which this mark is searched
HEADER_FORMAT = "1"
_MAX_FRAME_CHARACTERS = 256


def encode_header(header: LogHeader) -> dict[str, str]:
    """Return the metadata record of a header; the model itself is an attachment."""
    values = {
        "format": HEADER_FORMAT,
        "scenario": header.scenario,
        "seed": _json(header.seed),
        "labels": _json([_label(label) for label in header.labels]),
        "start": _json(_belief(header.start)),
        "truth": _json(_state(header.truth)),
        "notes": _json(dict(header.notes)),
        "model": _json(None if header.surface is None else header.surface.name),
        "model_sha256": _json(None if header.surface is None else header.surface.sha256),
    }
    moving = {"fixed_frame": header.fixed_frame, "sensor_at_stamp": header.sensor_at_stamp}
    values.update({name: _json(value) for name, value in moving.items() if value})
    return {**values, "crc32": f"{_checksum(values):08x}"}


def decode_header(values: Mapping[str, str]) -> LogHeader:
    """Return the header of a metadata record, without the model.

    Raises ValueError if its checksum or one of its values is wrong.
    """
    rest = {k: v for k, v in values.items() if k != "crc32"}
    if values.get("crc32") != f"{_checksum(rest):08x}":
        raise ValueError("the checksum of the header record is wrong")
    if values.get("format") != HEADER_FORMAT:
        raise ValueError(
            f"header record of format {values.get('format')!r}, this version reads {HEADER_FORMAT}"
        )
    try:
        return LogHeader(
            scenario=values["scenario"],
            seed=_to_seed(_loads(values["seed"])),
            labels=tuple(_to_label(label) for label in _loads(values["labels"])),
            start=_to_belief(_loads(values["start"])),
            truth=_to_state(_loads(values["truth"])),
            notes={str(name): str(text) for name, text in dict(_loads(values["notes"])).items()},
            fixed_frame=_to_frame(_loads(values.get("fixed_frame", '""'))),
            sensor_at_stamp=_loads(values.get("sensor_at_stamp", "false")) is True,
        )
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"header record: {str(error)[:120]}") from None


def _checksum(values: Mapping[str, str]) -> int:
    return zlib.crc32(json.dumps(dict(sorted(values.items()))).encode())


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, sort_keys=True)


def _label(label: Label) -> dict[str, Any]:
    return {
        name: getattr(label, name) for name in ("kind", "start_ns", "end_ns", "harmful", "strength")
    }


def _state(state: State | None) -> dict[str, Any] | None:
    return None if state is None else {name: getattr(state, name).tolist() for name in STATE_SIZES}


def _belief(belief: Belief | None) -> dict[str, Any] | None:
    return (
        None
        if belief is None
        else {"t_ns": belief.t_ns, "x": _state(belief.x), "P": belief.P.tolist()}
    )


def _loads(text: str) -> Any:
    return json.loads(text, parse_constant=_no_number)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is not a number")


def _to_seed(value: Any) -> int | None:
    if value is not None and type(value) is not int:
        raise ValueError(f"a seed of {str(value)[:40]}")
    return value


def _to_frame(value: Any) -> str:
    if not isinstance(value, str) or len(value) > _MAX_FRAME_CHARACTERS:
        raise ValueError(f"a fixed frame of {str(value)[:40]}")
    return value


def _to_label(values: Any) -> Label:
    label = Label(**values)
    whole = (
        type(label.start_ns) is int and type(label.end_ns) is int and type(label.harmful) is bool
    )
    if (
        not isinstance(label.kind, str)
        or not whole
        or not isinstance(label.strength, (int, float, type(None)))
    ):
        raise ValueError("a fault label with a value of the wrong type")
    return label


def _to_state(values: Any) -> State | None:
    if values is None:
        return None
    state = State(**{name: np.array(values[name], dtype=np.float64) for name in STATE_SIZES})
    lengths = np.linalg.norm(state.q_ab), np.linalg.norm(state.q_bc)
    if not all(abs(length - 1.0) < 1e-6 for length in lengths) or np.abs(state.sigma).max() >= 1.0:
        raise ValueError(
            "an invalid state: a quaternion is not of unit length, or a sigma is not below 1"
        )
    return state


def _to_belief(values: Any) -> Belief | None:
    if values is None:
        return None
    state = _to_state(values["x"])
    if state is None:
        raise ValueError("a first belief without a state")
    return Belief(int(values["t_ns"]), state, np.array(values["P"], dtype=np.float64))


MAX_MODEL_BYTES = 512 << 20
_PLACED_VALUE_BYTES = 24  # of a vertex or an index of a placed part of a scene [bytes]
_PLACED_PART_WORK = 100_000  # that a placed part takes to read, about 2 ms of Python
LEAST_EXTENT_M = 1e-6  # squares of a part of it must not underflow
_MODEL_FORMATS = ("ply", "stl", "obj", "off", "glb", "pcd")
MODEL_ENDINGS = tuple(f".{name}" for name in _MODEL_FORMATS)
# Exceptions that trimesh raises for malformed files.
_FOREIGN = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    BufferError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    NameError,
    NotImplementedError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
    zlib.error,
)


def read_surface(path: str | Path, cloud_ok: bool = False) -> Surface:
    """Read a model file.

    Args:
        path: PLY, STL, OBJ, OFF, GLB or (points alone) PCD file; lengths in metres, frame {C} of
            the model.
        cloud_ok: accept a file without faces as a point-cloud model; one that ``avsreplay model``
            built is accepted anyway.

    Returns:
        The model with the bytes and the SHA-256 of its file.

    Raises:
        UnreadableInput: the file does not exist, is not a model, has vertices that are not finite,
            or has no faces although they are needed.
    """
    path = Path(path)
    data = read_limited(path, MAX_MODEL_BYTES, "name a model file of at most 512 MiB")
    own = OWN_MODEL in data[:_OWN_MODEL_BYTES]
    return _parsed(data, path.name, shown(path), cloud_ok or own)


def parse_surface(data: bytes, name: str) -> Surface:
    """Parse the bytes of a model file; one without faces is a point-cloud model.

    Args:
        data: the bytes of the file.
        name: its name; the extension selects the format.

    Returns:
        The model.

    Raises:
        UnreadableInput: as for ``read_surface``.
    """
    return _parsed(data, PurePath(name).name, shown(name), cloud_ok=True)


def scaled(surface: Surface, scale: float) -> Surface:
    """Return the model with its coordinates multiplied by ``scale``; its bytes and SHA-256
    are those of the result.
    """
    return surface if scale == 1.0 else with_vertices(surface, scale * surface.vertices)


def with_vertices(surface: Surface, vertices: Array) -> Surface:
    """Return the model with other coordinates (n, 3) [m]; its bytes and SHA-256 are those of
    the result.
    """
    bare = replace(surface, vertices=frozen(vertices, -1, 3), sha256="", data=b"")
    data = surface_bytes(bare)
    return replace(bare, data=data, sha256=hashlib.sha256(data).hexdigest())


def in_metres(surface: Surface, factor: float, mirror: bool = False) -> Surface:
    """Return the model in metres as the reading options ask for it.

    Args:
        surface: the model as in its file.
        factor: of its coordinates: metres per unit of the file, times the scale that the user
            gives.
        mirror: change the sign of the x coordinates, and the winding of the faces.

    Raises:
        UnreadableInput: the scaled model is too large or too small.
    """
    found = scaled(surface, factor)
    if mirror:
        found = with_vertices(
            replace(found, faces=found.faces[:, ::-1].copy()), found.vertices * [-1.0, 1.0, 1.0]
        )
    if found is not surface:
        _check(found.vertices, found.faces, shown(surface.name), cloud_ok=True)
    return found


def surface_bytes(surface: Surface) -> bytes:
    """Return the bytes of the model's file; if it was not read from one, a binary PLY with
    float64 vertices.
    """
    if surface.data:
        return surface.data
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(surface.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(surface.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(surface.faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
    faces["n"], faces["v"] = 3, surface.faces
    return header.encode() + surface.vertices.astype("<f8").tobytes() + faces.tobytes()


def _parsed(data: bytes, name: str, where: str, cloud_ok: bool) -> Surface:
    suffix = PurePath(name).suffix.lower().lstrip(".")
    refuse_pointer(data, where)
    if not data:
        raise UnreadableInput("the model file is empty", where=where, hint="name a mesh file")
    if data.startswith(b"ply"):
        suffix = "ply"
    if suffix not in _MODEL_FORMATS:
        hint = (
            f"give a model as {', '.join(_MODEL_FORMATS).upper()}; CAD programs export STEP and"
            " IGES files as STL"
        )
        raise UnreadableInput(
            f"'{shown(suffix)}' is not a known model format", where=where, hint=hint
        )
    try:
        reader, budget = _OWN_READERS.get(suffix), ReadBudget(len(data))
        vertices, faces = reader(data, budget) if reader else _trimesh(data, suffix, budget)
    except _FOREIGN as error:
        reason = shown(str(error) or type(error).__name__)[:120]
        raise UnreadableInput(
            f"not a readable {suffix.upper()}: {reason}", where=where, hint="check the file"
        ) from None
    _check(vertices, faces, where, cloud_ok)
    vertices = frozen(vertices, -1, 3)
    faces, reversed_ = mesh.outward(vertices, mesh.with_area(vertices, faces))
    if not cloud_ok and not len(faces):
        raise UnreadableInput(
            "every triangle has zero area", where=where, hint="check the units of the model"
        )
    faces.flags.writeable = False
    return Surface(vertices, faces, name, hashlib.sha256(data).hexdigest(), data, reversed_)


def _ply(data: bytes, budget: ReadBudget) -> tuple[Array, NDArray[np.int64]]:
    ply = read_ply(data, budget)
    return ply.points().astype(np.float64), ply.faces


def _pcd(data: bytes, budget: ReadBudget) -> tuple[Array, NDArray[Any]]:
    """A PCD file is a point-cloud model; points without a return are left out."""
    points = read_pcd(data, budget).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)], np.zeros((0, 3), np.int32)


_OWN_READERS = {"ply": _ply, "pcd": _pcd}


def _take_scene(data: bytes, budget: ReadBudget) -> None:
    """Take what the parts of a GLB scene need; few bytes can place a part many times."""
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    meshes, counts = tree["meshes"], [int(each["count"]) for each in tree["accessors"]]
    placed = Counter(node.get("mesh") for node in tree.get("nodes", ()))
    for number, each in enumerate(meshes):
        times, parts = max(placed[number], 1), each["primitives"]
        used = [i for p in parts for i in (p["attributes"]["POSITION"], p.get("indices"))]
        numbers = sum(max(counts[i], 0) for i in used if i is not None)
        budget.take_work(_PLACED_PART_WORK * times * len(parts), "the parts of its scene")
        budget.take_bytes(_PLACED_VALUE_BYTES * times * numbers, "parts of its scene")


def _trimesh(data: bytes, suffix: str, budget: ReadBudget) -> tuple[Array, NDArray[Any]]:
    import trimesh

    if suffix == "glb":
        _take_scene(data, budget)
    if suffix == "stl" and len(data) >= 84 and not data.lstrip().startswith(b"solid"):
        promised = int.from_bytes(data[80:84], "little")
        if 84 + 50 * promised > len(data):
            raise BadFile(f"declares {promised} triangles in a file of {len(data)} bytes")
    options: dict[str, Any] = {"skip_materials": True} if suffix in ("obj", "glb") else {}
    # process=False keeps the vertices unchanged; force="mesh" joins the parts of a scene.
    _silence_trimesh()
    with np.errstate(all="ignore"):
        loaded: Any = trimesh.load(
            io.BytesIO(data), file_type=suffix, process=False, force="mesh", **options
        )
    vertices, faces = np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces)
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or faces.ndim != 2
        or (len(faces) and faces.shape[1] != 3)
    ):
        raise BadFile("no triangles in three dimensions")
    return _merged(vertices, faces)


@cache
def _silence_trimesh() -> None:
    """Discard the tracebacks that trimesh logs before it tries another way."""
    import logging

    logging.getLogger("trimesh").addHandler(logging.NullHandler())


def _merged(vertices: Array, faces: NDArray[Any]) -> tuple[Array, NDArray[Any]]:
    """Merge equal vertices, which occur in STL files and in OBJ files with normals."""
    if not np.isfinite(vertices).all():
        return vertices, faces
    first, number = mesh.distinct_rows(vertices)
    return vertices[first], number[faces]


def _check(vertices: Array, faces: NDArray[Any], where: str, cloud_ok: bool) -> None:
    if not len(vertices):
        raise UnreadableInput("the model has no vertices", where=where, hint="check the file")
    bad = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
    if bad:
        hint = "remove them in a mesh editor"
        raise UnreadableInput(
            f"{bad} of {len(vertices)} vertices are not finite", where=where, hint=hint
        )
    if np.abs(vertices).max() > MAX_COORDINATE_M:
        what = (
            f"a vertex is at {np.abs(vertices).max():.3g} m; the largest coordinate is"
            f" {MAX_COORDINATE_M:.0g} m"
        )
        raise UnreadableInput(what, where=where, hint="check the units of the model")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise UnreadableInput(
            "a face refers to a vertex that does not exist", where=where, hint="check the file"
        )
    if not len(faces) and not cloud_ok:
        hint = "give a mesh, or --cloud-model to use its points as the model"
        raise UnreadableInput("the model has no faces", where=where, hint=hint)
    if np.ptp(vertices, axis=0).max() < LEAST_EXTENT_M:
        what = (
            f"the model spans {np.ptp(vertices, axis=0).max():.3g} m; the least is"
            f" {LEAST_EXTENT_M:g} m"
        )
        raise UnreadableInput(what, where=where, hint="check the units of the model")


_OCTAHEDRON = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]],
    dtype=np.int32,
)


def octahedron(extent_m: float) -> Surface:
    """Return an octahedron about the origin of {C} that stands for a target without a model.

    Args:
        extent_m: diagonal of its bounding box [m].
    """
    corners = 0.5 * extent_m / np.sqrt(3.0) * np.concatenate([np.eye(3), -np.eye(3)])
    return Surface(corners, _OCTAHEDRON, "none", "")
