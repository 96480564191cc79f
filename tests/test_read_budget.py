"""The content of a file takes no more memory, records, depth and work than its budget, which grows
with its size.
"""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from avsreplay import toml_document
from avsreplay.binary_files import read_members
from avsreplay.errors import UsageError
from avsreplay.log.ply import read_ply
from avsreplay.log.scan_files import read_pcd
from avsreplay.read_budget import (
    LEAST_BUDGET_BYTES,
    BadFile,
    OverBudget,
    ReadBudget,
    check_declared,
)


def zipped(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, points=array)
    return out.getvalue()


def test_what_is_taken_is_never_more_than_the_budget():
    budget = ReadBudget(1000, most_bytes=50, records=3, depth=2)
    budget.take_bytes(50, "numbers")
    for take, args in (
        (budget.take_bytes, (1, "numbers")),
        (budget.take_records, (4, "rows")),
        (budget.check_depth, (3, "keys")),
        (budget.take_work, (budget.work + 1, "rows")),
    ):
        with pytest.raises(OverBudget):
            take(*args)
    budget.take_records(3, "rows")
    budget.check_depth(2, "keys")


@pytest.mark.parametrize(("count", "each", "available"), [(-1, 1, 10), (11, 1, 10), (6, 2, 11)])
def test_a_count_that_the_bytes_cannot_hold_is_malformed(count, each, available):
    with pytest.raises(BadFile):
        check_declared(count, each, available, "points")


def test_an_archive_of_zeros_is_refused_by_the_size_that_it_declares():
    data = zipped(np.zeros((LEAST_BUDGET_BYTES // 8, 3), np.float32))
    with pytest.raises(OverBudget, match="MiB"):
        read_members(data, ReadBudget(len(data)))


def test_an_archive_that_declares_less_than_it_contains_is_malformed():
    data = bytearray(zipped(np.zeros((5000, 3))))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = archive.infolist()[0].file_size.to_bytes(4, "little")
    assert size in data
    changed = bytes(data).replace(size, (100).to_bytes(4, "little"))
    with pytest.raises(BadFile):
        read_members(changed, ReadBudget(len(changed)))


@pytest.mark.parametrize(
    "text",
    ["a." * 20_000 + "a=1", "[" + "a." * 20_000 + "a]", '"a" . ' * 9000 + "a=1", "-." * 60_000],
)
def test_deep_keys_are_refused_before_the_parser_takes_the_square_of_their_number(text):
    with pytest.raises(UsageError, match="nested"):
        toml_document.parse(text, "f.toml")


@pytest.mark.parametrize("text", ["a=" + "9" * 5000, "a=0." + "1" * 5000 + "x", "a=" + "[" * 5000])
def test_long_numbers_and_deep_arrays_are_one_line(text):
    with pytest.raises(UsageError, match="not valid TOML"):
        toml_document.parse(text, "f.toml")


def test_ordinary_text_is_no_nested_key():
    text = "#" + "." * 500 + "\na.b.c.d = '1.2.3.4.5 " + "as in a.b.c. " * 100 + "'\n"
    assert "d" in toml_document.parse(text, "f.toml").table["a"]["b"]["c"]


def test_elements_with_many_properties_are_refused():
    names = "".join(f"property double p{i}\n" for i in range(2000))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 20000\n{names}end_header\n"
    with pytest.raises(OverBudget, match="elements"):
        read_ply(head.encode())


def test_a_compressed_cloud_of_zeros_is_refused():
    points = 4_000_000
    size = 12 * points
    packed = b"\x00\x00" + b"\xe0\xff\x00" * (size // 264)
    head = (
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA binary_compressed\n"
    ).encode()
    data = head + len(packed).to_bytes(4, "little") + size.to_bytes(4, "little") + packed
    with pytest.raises(OverBudget, match="points"):
        read_pcd(data)
