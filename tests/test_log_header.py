"""The header record: exact in both directions, and other records are not accepted as one."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from log_cases import header

from avsreplay.log import header as record
from avsreplay.records import LogHeader

HEAD = replace(header(np.random.Generator(np.random.PCG64(1))), fixed_frame="map")


def signed(values: dict[str, str]) -> dict[str, str]:
    """With a checksum that holds, as a hand that means ill would write it."""
    rest = {k: v for k, v in values.items() if k != "crc32"}
    return {**rest, "crc32": f"{zlib.crc32(json.dumps(rest, sort_keys=True).encode()):08x}"}


def test_an_empty_header_is_preserved() -> None:
    back = record.decode_header(record.encode_header(LogHeader()))
    assert back.scenario == ""
    assert back.seed is back.start is back.truth is None
    assert back.labels == ()
    assert back.fixed_frame == ""


def test_the_fixed_frame_is_written_where_there_is_one() -> None:
    assert "fixed_frame" not in record.encode_header(LogHeader())
    assert record.decode_header(record.encode_header(HEAD)).fixed_frame == "map"


def test_every_value_is_covered_by_the_checksum() -> None:
    values = record.encode_header(HEAD)
    for name in values:
        with pytest.raises(ValueError, match=r"checksum|format"):
            record.decode_header({**values, name: values[name] + " "})
    for name in values:
        with pytest.raises(ValueError, match="checksum"):
            record.decode_header({k: v for k, v in values.items() if k != name})


def changed(name: str, change: Callable[[object], object]) -> tuple[str, str]:
    return name, json.dumps(change(json.loads(record.encode_header(HEAD)[name])))


def without(name: str) -> Callable[[object], object]:
    return lambda value: {k: v for k, v in value.items() if k != name}  # type: ignore[attr-defined]


def with_(name: str, new: object) -> Callable[[object], object]:
    return lambda value: {**value, name: new}  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("seed", '"7"'),
        ("seed", "7.5"),
        ("seed", "true"),
        ("seed", "NaN"),
        ("seed", "[" * 100_000),
        ("seed", "1" * 10_000),
        ("labels", "7"),
        ("labels", '[{"kind": "x"}]'),
        ("labels", '[{"kind": 1, "start_ns": 0, "end_ns": 1}]'),
        ("labels", '[{"kind": "x", "start_ns": "0", "end_ns": 1}]'),
        ("labels", '[{"evil": 1}]'),
        ("labels", "[null]"),
        ("notes", "7"),
        ("notes", "[1]"),
        ("start", "{}"),
        ("start", "[1]"),
        ("truth", '{"q_ab": "x"}'),
        ("truth", "{"),
        changed("truth", with_("q_ab", [0, 0, 0, 0])),
        changed("truth", with_("sigma", [0.5, 1.0])),
        changed("truth", with_("w_b", [1, 2])),
        changed("truth", with_("r_a", [1e400, 0, 0])),
        changed("truth", without("c_b")),
        ("fixed_frame", "7"),
        ("fixed_frame", "null"),
        ("fixed_frame", json.dumps(257 * "m")),
        changed("start", with_("P", [[1]])),
        changed("start", with_("x", None)),
        changed("start", with_("t_ns", "x")),
    ],
)
def test_an_invalid_header_is_rejected_although_its_checksum_is_correct(
    name: str, text: str
) -> None:
    with pytest.raises(ValueError, match="header record"):
        record.decode_header(signed({**record.encode_header(HEAD), name: text}))
