"""The short fuzz campaign: mutated bytes give scans or a one-line error, within limits of time and
memory.

The long one is ``python tests/benchmarks/fuzz_logs.py``; docs/reliability.md has its figures.
"""

from __future__ import annotations

import struct
import sys
from contextlib import suppress
from pathlib import Path

import fuzz_commands
import numpy as np
import outputs
import pytest
from fuzz_inputs import case, cloud1, digest, seeds
from fuzz_logs import LIMIT_MIB, campaign, check
from hypothesis import given, settings
from hypothesis import strategies as st
from log_cases import scans

from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.canonical import Cloud, canonical, infer
from avsreplay.log.cdr import point_cloud2
from avsreplay.log.options import SourceOptions
from avsreplay.log.ply import read_ply
from avsreplay.log.point_cloud2 import raw_cloud
from avsreplay.log.point_times import TimedCloud
from avsreplay.log.pose_messages import POSE_TYPES, read_pose, read_transforms
from avsreplay.log.scan_files import read_pcd, unpack_lzf
from avsreplay.read_budget import BadFile

CORPUS = seeds()


def decode_cloud(message: bytes, encoding: str) -> Cloud:
    """The canonical cloud of a message that is the only one of its log."""
    raw = raw_cloud(message, encoding)
    return canonical(raw, infer([TimedCloud(raw, raw.stamp_ns)], None, SourceOptions()))


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform == "win32", reason="the campaign limits its processes by means of POSIX"
)
def test_mutated_files_give_scans_or_one_error_line() -> None:
    tally, findings, peak = campaign(7, list(range(800)), 800)
    assert not findings
    assert sum(tally.values()) == 800
    assert min(tally["read"], tally["partly"], tally["refused"]) > 50, "each way out is taken"
    assert peak < LIMIT_MIB


def test_every_input_and_output_of_every_command_has_a_seed() -> None:
    """A new option that names a file joins the campaigns, or this test fails and names it."""
    assert len(fuzz_commands.listed()) > 30
    assert len(outputs.listed()) > 10


def test_a_mutation_depends_only_on_campaign_and_number() -> None:
    assert digest(CORPUS) == digest(seeds())
    assert case(3, 14, CORPUS) == case(3, 14, seeds())
    assert case(3, 14, CORPUS) != case(3, 15, CORPUS)


@pytest.mark.parametrize("name", sorted(CORPUS))
def test_the_seeds_themselves_are_read(tmp_path: Path, name: str) -> None:
    assert check(name, CORPUS[name], tmp_path, deep=True) == "read"


@settings(max_examples=300)
@given(st.binary(max_size=200), st.sampled_from(["cdr", "ros1"]))
def test_any_bytes_as_a_message(data: bytes, encoding: str) -> None:
    """What is read from any bytes is no larger than they are, and finite where it must be;
    the rest is refused.
    """
    for prefix in (b"", b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"):
        message = prefix + data
        with suppress(BadMessage):
            cloud = decode_cloud(message, encoding)
            assert cloud.points.shape[1:] == (3,)
            assert cloud.points.nbytes <= 64 * len(message) + 64
        with suppress(BadMessage):
            found = read_transforms(message, encoding)
            assert 56 * len(found) <= len(message), "a transform has seven numbers of eight bytes"
        for kind in POSE_TYPES:
            with suppress(BadMessage):
                assert np.isfinite(read_pose(kind, message, encoding).pose).all()


WORDS = st.sampled_from([0, 1, 2, 3, 12, 16, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1])


@settings(max_examples=400)
@given(st.lists(st.tuples(st.integers(0, 60), WORDS), min_size=1, max_size=4), st.booleans())
def test_any_number_at_any_place_of_a_cloud(changes: list[tuple[int, int]], ros1: bool) -> None:
    points = scans(1, 5)[0].points
    data = bytearray(cloud1(points) if ros1 else point_cloud2(7, "c", points, None))
    for place, value in changes:
        struct.pack_into("<I", data, min(4 * place, len(data) - 4), value)
    try:
        cloud = decode_cloud(bytes(data), "ros1" if ros1 else "cdr")
    except BadMessage:
        return
    assert cloud.points.shape[1] == 3
    assert cloud.points.nbytes <= 64 * len(data) + 64


@settings(max_examples=200)
@given(st.binary(max_size=400), st.integers(0, 2000))
def test_any_bytes_as_lzf(data: bytes, size: int) -> None:
    with suppress(BadFile):
        assert len(unpack_lzf(data, size)) == size


HEADER_LINES = st.lists(
    st.one_of(
        st.sampled_from(
            [
                "format ascii 1.0",
                "format binary_little_endian 1.0",
                "element vertex 3",
                "element face 2",
                "element x 1",
                "property float x",
                "property double y",
                "property uchar z",
                "property list uchar int vertex_indices",
                "property list float double q",
                "VERSION 0.7",
                "FIELDS x y z",
                "SIZE 4 4 4",
                "TYPE F F F",
                "COUNT 1 1 1",
                "WIDTH 2",
                "HEIGHT 1",
                "POINTS 2",
                "DATA ascii",
                "DATA binary",
                "DATA binary_compressed",
            ]
        ),
        st.text(max_size=20),
    ),
    max_size=14,
)


@settings(max_examples=300)
@given(HEADER_LINES, st.binary(max_size=120))
@pytest.mark.slow
def test_any_header_of_a_scan(lines: list[str], body: bytes) -> None:
    """Any header is refused, or gives points and faces that fit into the bytes behind it."""
    text = "\n".join(lines).encode("utf-8", "replace")
    with suppress(BadFile):
        points = read_ply(b"ply\n" + text + b"\nend_header\n" + body).points()
        assert points.shape[1:] == (3,)
        assert len(points) <= len(text) + len(body), "a vertex takes at least one byte"
    with suppress(BadFile):
        points = read_pcd(text + b"\n" + body)
        assert points.shape[1:] == (3,)
        assert len(points) <= len(text) + len(body)
