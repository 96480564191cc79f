"""PLY and PCD files of every form, written here value by value from random content, give back this
content.
"""

from __future__ import annotations

import math
import struct
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from avsreplay.log.ply import read_ply
from avsreplay.log.scan_files import read_pcd, read_points
from avsreplay.read_budget import BadFile

CODES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"},
    **{"float": "f", "double": "d"},
}
WHOLE = ("uchar", "ushort", "uint", "char", "short", "int")
PCD = {
    **{("F", 4): "f", ("F", 8): "d", ("I", 1): "b", ("I", 2): "h", ("I", 4): "i"},
    **{("U", 1): "B", ("U", 2): "H", ("U", 4): "I"},
}

Row = list[tuple[str, str, list[Any]]]
"""Properties of an element: type of the length or "", type of the values, values."""


def value_of(rng: Random, code: str) -> float:
    """A value that a type of ``struct`` holds exactly."""
    if code in "fd":
        return float(np.float32(rng.uniform(-1e6, 1e6)))
    bits = 8 * struct.calcsize("<" + code)
    return rng.randrange(2**bits) - (0 if code.isupper() else 2 ** (bits - 1))


def random_faces(rng: Random) -> tuple[list[str], list[Row]]:
    """Header lines and rows of faces: the list of the corners, of any or of equal length, among
    other properties or alone; without any list at times.
    """
    alone, alike = rng.random() < 0.4, rng.choice([None, None, 0, 3, 4])
    before, after = ([] if alone else rng.choices([*CODES], k=rng.randrange(3)) for _ in range(2))
    listed, second = alone or rng.random() < 0.9, not alone and rng.random() < 0.5
    count_kind, kind = rng.choice(WHOLE[:3]), rng.choice(WHOLE)
    head = [f"property {name} a{i}" for i, name in enumerate(before)]
    head += [f"property list {count_kind} {kind} vertex_indices"] * listed
    head += [f"property {name} b{i}" for i, name in enumerate(after)]
    head += ["property list uchar float weights"] * (second and listed)
    rows = []
    for _ in range(rng.randrange(6) if head else 0):
        size = rng.randrange(7) if alike is None else alike
        row: Row = [("", name, [value_of(rng, CODES[name])]) for name in before]
        row += [(count_kind, kind, [rng.randrange(8) for _ in range(size)])] * listed
        row += [("", name, [value_of(rng, CODES[name])]) for name in after]
        if second and listed:
            row.append(("uchar", "float", [value_of(rng, "f") for _ in range(rng.randrange(3))]))
        rows.append(row)
    return head, rows


def packed(row: Row, order: str) -> bytes:
    """A line of an ascii file, or the bytes of a row in a byte order."""
    if not order:
        words = [([len(values)] if count else []) + values for count, _, values in row]
        return " ".join(repr(word) for part in words for word in part).encode() + b"\n"
    out = b""
    for count, kind, values in row:
        out += struct.pack(order + CODES[count], len(values)) if count else b""
        out += struct.pack(f"{order}{len(values)}{CODES[kind]}", *values)
    return out


def test_a_ply_file_gives_what_was_written() -> None:
    """Ascii and both byte orders; vertices, faces and another element in any order. A file that is
    cut anywhere is refused as malformed, or read.
    """
    rng = Random(7)
    for number in range(400):
        form, order = (
            *(("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")),
        )[number % 3]
        names = rng.sample(["x", "y", "z", "more"], 4)
        kinds = {name: rng.choice(["float", "double", "int"]) for name in names}
        count = rng.randrange(1, 6)
        table = {name: [value_of(rng, CODES[kinds[name]]) for _ in range(count)] for name in names}
        points = [[("", kinds[name], [table[name][k]]) for name in names] for k in range(count)]
        elements = {
            "vertex": ([f"property {kinds[name]} {name}" for name in names], points),
            "face": random_faces(rng),
            "other": random_faces(rng),
        }
        head, body = [f"ply\nformat {form} 1.0"], b""
        for name in rng.sample([*elements], 3):
            lines, rows = elements[name]
            head += [f"element {name} {len(rows)}", *lines]
            body += b"".join(packed(row, order) for row in rows)
        whole = "\n".join([*head, "end_header\n"]).encode() + body
        found = read_ply(whole)
        for name in names:
            assert found.vertex[name].tolist() == table[name]
        corners = [
            next((values for size, _, values in row if size), []) for row in elements["face"][1]
        ]
        fans = [[f[0], f[i], f[i + 1]] for f in corners for i in range(1, len(f) - 1)]
        assert found.faces.tolist() == fans
        with suppress(BadFile):  # cut anywhere
            part = read_ply(whole[: len(whole) - 1 - rng.randrange(len(body))])
            assert list(part.vertex) == list(found.vertex)


@pytest.mark.parametrize("sizes", [(3, 3), (3, 4)])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e30])
def test_a_corner_that_is_no_number_is_read_without_a_warning(
    sizes: tuple[int, int], value: float
) -> None:
    """Lists of one length are read by other instructions than lists of several."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
    head += "element face 2\nproperty list uchar float vertex_indices\nend_header\n"
    body = struct.pack("<f", 0.0)
    body += b"".join(struct.pack(f"<B{n}f", n, *[value] * n) for n in sizes)
    found = read_ply(head.encode() + body).faces
    assert len(found) == sum(n - 2 for n in sizes)
    assert not (found == 0).any()


def test_a_cloud_of_no_bytes_has_no_points(tmp_path: Path) -> None:
    (tmp_path / "0.bin").write_bytes(b"")
    assert len(read_points(tmp_path / "0.bin", 1 << 20)) == 0


def lzf(data: bytes) -> bytes:
    """Data compressed by copies of what stands before, where at least three bytes recur."""
    out, plain, at = bytearray(), bytearray(), 0
    while at < len(data) or plain:
        back, length = 0, 2
        for start in range(at):
            n = 0
            while at + n < len(data) and n < 264 and data[start + n] == data[at + n]:
                n += 1
            back, length = (at - start, n) if n > length else (back, length)
        if plain and (back or at == len(data) or len(plain) == 32):
            out += bytes([len(plain) - 1]) + plain
            plain.clear()
        elif back:
            n, far = length - 2, back - 1
            out += bytes([min(n, 7) << 5 | far >> 8, *([n - 7] if n >= 7 else []), far & 255])
            at += length
        else:
            plain.append(data[at])
            at += 1
    return bytes(out)


def test_a_pcd_file_gives_what_was_written() -> None:
    """Ascii, binary and compressed; coordinates among other fields of one or more values."""
    rng = Random(8)
    for number in range(150):
        form = ("ascii", "binary", "binary_compressed")[number % 3]
        names = rng.sample(["x", "y", "z", "rgb", "_"], 5)
        kinds = {name: rng.choice([*PCD]) for name in names}
        counts = {name: 1 if name in "xyz" else rng.randrange(1, 4) for name in names}
        n = rng.randrange(1, 9)
        table = {
            name: [[value_of(rng, PCD[kinds[name]]) for _ in range(counts[name])] for _ in range(n)]
            for name in names
        }
        fields = {
            name: [struct.pack(f"<{counts[name]}{PCD[kinds[name]]}", *row) for row in table[name]]
            for name in names
        }
        if form == "ascii":
            rows = ([v for name in names for v in table[name][k]] for k in range(n))
            body = b"".join(" ".join(map(repr, row)).encode() + b"\n" for row in rows)
        elif form == "binary":
            body = b"".join(fields[name][k] for k in range(n) for name in names)
        else:
            whole = b"".join(b"".join(fields[name]) for name in names)
            short = lzf(whole)
            body = struct.pack("<II", len(short), len(whole)) + short
        sizes, types = ([kinds[name][part] for name in names] for part in (1, 0))
        head = {"FIELDS": names, "SIZE": sizes, "TYPE": types, "COUNT": counts.values()}
        lines = [f"{key} {' '.join(map(str, values))}" for key, values in head.items()]
        lines += [f"WIDTH {n}", "HEIGHT 1", f"POINTS {n}", f"DATA {form}\n"]
        found = read_pcd("\n".join(lines).encode() + body)
        want = np.array([[table[axis][k][0] for axis in "xyz"] for k in range(n)], np.float64)
        np.testing.assert_array_equal(found, want)
