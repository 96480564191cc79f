"""Files of poses of every form, written here from random poses, give back these poses."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from random import Random

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avsreplay.errors import UnreadableInput
from avsreplay.geometry import angle_between
from avsreplay.log.pose_files import read_poses
from avsreplay.records import MeasuredPose

PER_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
PER_M = {"m": 1, "cm": 100, "mm": 1000}
NAMES = {
    "t": ["t", "time", "Timestamp", "stamp", "seconds"],
    **{axis: [axis, f"p_{axis}", f"t{axis}", f"position.{axis}", f"Pos_{axis}"] for axis in "xyz"},
    **{f"q{axis}": [f"q{axis}", f"q_{axis}", f"orientation.{axis}"] for axis in "xyzw"},
}


def random_poses(rng: Random) -> list[tuple[int, list[float], list[float]]]:
    """Instants [ns], positions [m] and quaternions x, y, z, w."""
    out, t_ns = [], rng.randrange(2 * 10**18)
    for _ in range(rng.randrange(1, 5)):
        t_ns += rng.randrange(1, 10**10)
        q = Rotation.random(random_state=rng.randrange(2**32)).as_quat().tolist()
        out.append((t_ns, [rng.uniform(-50.0, 50.0) for _ in range(3)], q))
    return out


def in_unit(t_ns: int, unit: str) -> str:
    """An instant as a decimal number without rounding."""
    return str(Decimal(t_ns) * PER_S[unit] / 10**9)


def with_columns(rng: Random, poses: list[tuple[int, list[float], list[float]]]) -> str:
    """A table whose first line names its columns, in any order, with others among them."""
    mark = rng.choice([",", ";", "\t"])
    time_unit, unit = rng.choice([*PER_S]), rng.choice([*PER_M])
    keys = [*NAMES, "frame", "error"]
    rng.shuffle(keys)
    style = rng.randrange(3)  # the same for all coordinates
    heads = []
    for key in keys:
        name = rng.choice(NAMES[key]) if key == "t" else NAMES.get(key, [key] * 3)[style]
        name += {"t": f"_{time_unit}"}.get(key, f" [{unit}]" if key in "xyz" else "")
        heads.append(name)
    lines = [mark.join(heads)]
    for t_ns, r, q in poses:
        values = {"t": in_unit(t_ns, time_unit), "frame": "7", "error": "0.1"}
        values |= {axis: repr(v * PER_M[unit]) for axis, v in zip("xyz", r, strict=True)}
        values |= {f"q{axis}": repr(v) for axis, v in zip("xyzw", q, strict=True)}
        words = [values[key] for key in keys]
        lines.append(mark.join(word.replace(".", ",") if mark == ";" else word for word in words))
    return "\n".join(lines)


def without(form: str, poses: list[tuple[int, list[float], list[float]]]) -> str:
    """A file in a form of fixed columns."""
    lines = ["# a comment", ""]
    for t_ns, r, q in poses:
        if form == "tum":
            words = [in_unit(t_ns, "s"), *map(repr, (*r, *q))]
        elif form == "kitti":
            T = np.column_stack([Rotation.from_quat(q).as_matrix(), r])
            words = [*map(repr, T.ravel().tolist())]
        else:
            words = [str(t_ns), *map(repr, (*r, q[3], *q[:3]))]
        lines.append(("," if form == "euroc" else " ").join(words))
    return "\n".join(lines)


@pytest.mark.parametrize("form", ["tum", "kitti", "euroc", "csv"])
def test_a_file_of_poses_gives_what_was_written(tmp_path: Path, form: str) -> None:
    rng, path = Random(form), tmp_path / "poses"
    for _ in range(40):
        poses = random_poses(rng)
        text = with_columns(rng, poses) if form == "csv" else without(form, poses)
        code = rng.choice(["utf-8", "utf-8-sig", "utf-16"])
        path.write_bytes(text.replace("\n", rng.choice(["\n", "\r\n"])).encode(code))
        found = read_poses(path)
        assert len(found.poses) == len(poses)
        if form == "kitti":
            assert found.t_ns is None
        else:
            assert list(found.t_ns or ()) == [t_ns for t_ns, _, _ in poses]
        for measured, (_, r, q) in zip(found.poses, poses, strict=True):
            assert isinstance(measured, MeasuredPose)
            assert measured.T_ac.t == pytest.approx(np.array(r), rel=1e-12, abs=1e-12)
            assert angle_between(measured.T_ac.q, np.array(q)) < 1e-5


@pytest.mark.parametrize(
    ("head", "says"),
    [
        ("t,x,y,z,qx,qy,qz,qw,p_x", "two columns for px"),
        ("t,x,y,z,qx,qy,qz,qw,q_w", "two columns for qw"),
        ("t,x_mm,y,z,qx,qy,qz,qw", "coordinates in different units"),
        ("t,x,y,z,qx,qz,qw,p_y", "no column for qy"),
        ("t_s,x,y,z,qx,qy,qz,qw,stamp_ns", ""),
    ],
)
def test_a_header_names_each_coordinate_once_and_in_one_unit(
    tmp_path: Path, head: str, says: str
) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(f"{head}\n{','.join(['0.5'] * (head.count(',') + 1))}\n")
    if not says:
        assert list(read_poses(path).t_ns or ()) == [500_000_000]
        return
    with pytest.raises(UnreadableInput, match=says) as refused:
        read_poses(path)
    assert "poses.csv:1" in str(refused.value)
