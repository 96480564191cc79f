"""Damage of every kind, at every place, under every compression: all intact data is read, and
each loss is listed.
"""

from __future__ import annotations

import os
import shutil
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_cases import SECOND, header, scans, write
from mcap.stream_reader import StreamReader
from true_scans import true_scans

from avsreplay.errors import UnreadableInput
from avsreplay.log import Loss, SourceOptions, open_source
from avsreplay.log import mcap_format as mcap
from avsreplay.records import LogHeader, Scan

CLOUDS = scans(24, 200)
COMPRESSIONS = ("none", "lz4", "zstd")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    head = header(np.random.Generator(np.random.PCG64(1)))
    for name in COMPRESSIONS:
        write(
            folder / f"{name}.mcap", head, CLOUDS, compression=name
        )  # a chunk a second: two scans each
    return {name: folder / f"{name}.mcap" for name in COMPRESSIONS}


def chunks(path: Path) -> list[tuple[int, int]]:
    """(offset, end) of each chunk record, found by walking the frames."""
    data, at, found = path.read_bytes(), 8, []
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == mcap.Opcode.CHUNK:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


def data_end_of(data: bytes, at: int) -> int:
    """The end of the DataEnd record, from the end of the last chunk on."""
    while data[at] == mcap.Opcode.MESSAGE_INDEX:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    assert data[at] == mcap.Opcode.DATA_END
    return at + 13


def read(path: Path, **options: object) -> tuple[list[Scan], list[Loss]]:
    with open_source(path, SourceOptions(**options)) as source:  # type: ignore[arg-type]
        return list(true_scans(source)), source.losses


def same(scan: Scan) -> bool:
    """Is it, bit for bit, the scan that was written at that instant?"""
    (cloud,) = (c for c in CLOUDS if c.t_ns == scan.t_ns)
    return scan.points.tobytes() == cloud.points.tobytes() and scan.log_ns == cloud.log_ns


def flipped(path: Path, out: Path, at: int, bit: int = 0) -> Path:
    data = bytearray(path.read_bytes())
    data[at] ^= 1 << bit
    out.write_bytes(data)
    return out


@pytest.mark.parametrize("name", COMPRESSIONS)
@pytest.mark.parametrize("which", [0, 3, -1])
@pytest.mark.parametrize(
    "place", ["opcode", "length", "start", "size", "crc", "compression", "inner", "data", "end"]
)
def test_a_flipped_bit_loses_only_its_chunk(
    whole: dict[str, Path], tmp_path: Path, name: str, which: int, place: str
) -> None:
    spans = chunks(whole[name])
    begin, end = spans[which]
    offset = {
        "opcode": 0,
        "length": 3,
        "start": 15,
        "size": 27,
        "crc": 34,
        "compression": 37,
        "inner": 45,
    }
    at = {"data": (begin + end) // 2, "end": end - 1}.get(place, begin + offset.get(place, 0))
    path = flipped(whole[name], tmp_path / "x.mcap", at, 4)
    found, losses = read(path)
    assert all(same(scan) for scan in found)
    lost = {c.t_ns for c in CLOUDS} - {s.t_ns for s in found}
    if place == "start" and not lost:
        return  # the span in a chunk's head is told again by its messages
    assert len(lost) == 2, losses
    assert sum(loss.bytes for loss in losses) >= end - begin - 64
    assert any(loss.messages for loss in losses) or which == -1
    with pytest.raises(UnreadableInput, match="strict"):
        open_source(path, SourceOptions(strict=True))


@pytest.mark.parametrize("name", COMPRESSIONS)
def test_a_truncated_file_gives_every_complete_chunk(
    whole: dict[str, Path], tmp_path: Path, name: str
) -> None:
    data, spans = whole[name].read_bytes(), chunks(whole[name])
    rng = np.random.Generator(np.random.PCG64(3))
    data_end = data_end_of(data, spans[-1][1])
    cuts = [*rng.integers(spans[1][1], len(data) - 1, 25).tolist(), spans[5][1], spans[-1][1]]
    for cut in cuts:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        found, losses = read(path)
        assert len(found) == 2 * sum(end <= cut for _, end in spans)
        assert all(same(scan) for scan in found)
        assert bool(losses) == (cut < data_end)


@pytest.mark.parametrize("name", COMPRESSIONS)
@pytest.mark.parametrize("size", [1, 13, 700])
def test_inserted_or_removed_bytes_damage_one_place(
    whole: dict[str, Path], tmp_path: Path, name: str, size: int
) -> None:
    data, (begin, end) = whole[name].read_bytes(), chunks(whole[name])[4]
    middle = (begin + end) // 2
    for broken in (
        data[:middle] + b"\x06" * size + data[middle:],
        data[: middle - size] + data[middle:],
    ):
        (tmp_path / "x.mcap").write_bytes(broken)
        found, losses = read(tmp_path / "x.mcap")
        assert len(found) == len(CLOUDS) - 2
        assert all(same(scan) for scan in found)
        assert losses


def test_a_second_log_behind_the_first_one_is_a_loss(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    data, other = whole["none"].read_bytes(), whole["lz4"].read_bytes()
    for behind, count in ((other, 1), (bytes(1000), 0)):
        (tmp_path / "joined.mcap").write_bytes(data + behind)
        found, losses = read(tmp_path / "joined.mcap")
        assert len(found) == len(CLOUDS)
        assert all(map(same, found))
        assert [(loss.offset, loss.bytes) for loss in losses] == [(len(data), len(other))] * count


def test_a_lost_first_chunk_keeps_the_topics_of_the_summary(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    begin, end = chunks(whole["zstd"])[0]
    found, losses = read(flipped(whole["zstd"], tmp_path / "x.mcap", (begin + end) // 2))
    assert len(found) == len(CLOUDS) - 2
    assert losses[0].chunks == 1
    assert losses[0].start_ns == CLOUDS[0].log_ns
    assert losses[0].end_ns == 2 * SECOND  # a label begins there
    assert losses[0].messages == 8  # /tf_static, two clouds, two poses, two bodies, a label


def test_a_lost_first_chunk_of_a_truncated_recording_loses_only_that_chunk(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    """Nothing defines the channels any more: clouds and truth are told by their bytes."""
    data, spans = bytearray(whole["zstd"].read_bytes()), chunks(whole["zstd"])
    data[sum(spans[0]) // 2] ^= 1
    (tmp_path / "x.mcap").write_bytes(data[: spans[-2][1]])
    found, losses = read(tmp_path / "x.mcap")
    assert len(found) == len(CLOUDS) - 4
    assert all(same(scan) for scan in found)
    assert all(scan.truth is not None and scan.body is not None for scan in found)
    assert (
        sum("definition" in loss.what for loss in losses) == 4
    )  # three channels taken, the labels' one not


def test_without_a_summary_nothing_is_lost(whole: dict[str, Path], tmp_path: Path) -> None:
    data = whole["zstd"].read_bytes()
    footer = struct.pack("<BQQQI", mcap.Opcode.FOOTER, 20, 0, 0, 0)
    (tmp_path / "x.mcap").write_bytes(
        data[: data_end_of(data, chunks(whole["zstd"])[-1][1])] + footer + mcap.MCAP_MAGIC
    )
    found, losses = read(tmp_path / "x.mcap")
    assert len(found) == len(CLOUDS)
    assert not losses


def test_a_damaged_model_is_a_loss_and_not_a_wrong_model(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    at = whole["zstd"].read_bytes().index(b"property double x")
    path = flipped(whole["zstd"], tmp_path / "x.mcap", at + 200)
    with open_source(path) as source:
        assert source.header.surface is None
        assert "attachment" in source.losses[0].what
        assert len(list(source.scans())) == len(CLOUDS)


def test_a_damaged_header_record_is_a_loss_and_not_a_wrong_header(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    at = whole["zstd"].read_bytes().index(b'"strength"')
    path = flipped(whole["zstd"], tmp_path / "x.mcap", at + 1)
    with open_source(path) as source:
        assert source.header.labels == ()
        assert "header record" in source.losses[0].what


def test_a_chunk_that_declares_too_many_bytes_is_not_read(
    whole: dict[str, Path], tmp_path: Path
) -> None:
    data, (begin, _) = bytearray(whole["zstd"].read_bytes()), chunks(whole["zstd"])[2]
    struct.pack_into("<Q", data, begin + 25, 1 << 60)
    (tmp_path / "x.mcap").write_bytes(data)
    found, losses = read(tmp_path / "x.mcap")
    assert len(found) == len(CLOUDS) - 2
    assert "over the limit" in losses[0].what


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_decompression_bomb_is_rejected(tmp_path: Path, compression: str) -> None:
    import lz4.frame
    import zstandard

    squeeze = zstandard.compress if compression == "zstd" else lz4.frame.compress
    bomb = squeeze(bytes(64 << 20))
    for promised in (1000, 64 << 20):
        head = (
            struct.pack("<QQQI", 0, 1, promised, 0)
            + struct.pack("<I", len(compression))
            + compression.encode()
        )
        chunk = head + struct.pack("<Q", len(bomb)) + bomb
        record = struct.pack("<BQ", mcap.Opcode.CHUNK, len(chunk)) + chunk
        intact = tmp_path / "good.mcap"
        write(intact, LogHeader(), CLOUDS[:4], overwrite=True)
        data = intact.read_bytes()
        first = chunks(intact)[0][0]
        (tmp_path / "bomb.mcap").write_bytes(data[:first] + record + data[first:])
        found, losses = read(tmp_path / "bomb.mcap", max_message_mib=4)
        assert len(found) == 4
        assert losses
        assert losses[0].chunks == 1


def chunk_of(content: bytes) -> bytes:
    """A chunk record, compressed with zstd."""
    import zstandard

    packed = zstandard.compress(content)
    head = struct.pack("<QQQII", 0, 1, len(content), 0, 4) + b"zstd"
    chunk = head + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", mcap.Opcode.CHUNK, len(chunk)) + chunk


@pytest.mark.parametrize("count", [0, 3, 40])
def test_the_chunks_of_a_file_declare_no_more_than_its_bytes_can_hold(
    tmp_path: Path, count: int
) -> None:
    """Messages of zeros of an unknown channel, 4 MiB each and valid; a few are no attack."""
    write(tmp_path / "good.mcap", LogHeader(), CLOUDS[:4])
    data, first = (tmp_path / "good.mcap").read_bytes(), chunks(tmp_path / "good.mcap")[0][0]
    zeros = chunk_of(struct.pack("<BQ", mcap.Opcode.MESSAGE, (4 << 20) - 9) + bytes((4 << 20) - 9))
    (tmp_path / "zeros.mcap").write_bytes(data[:first] + zeros * count + data[first:])
    found, losses = read(tmp_path / "zeros.mcap")
    refused = [loss for loss in losses if "left for this file" in loss.what]
    most = ((16 << 20) + 1000 * (len(data) + len(zeros) * count)) // (4 << 20)
    assert len(found) == 4
    assert sum(loss.chunks for loss in refused) >= max(0, count - most)
    assert bool(refused) == (count == 40)


def test_millions_of_records_of_length_zero_take_little_memory(tmp_path: Path) -> None:
    """A chunk of 12 MiB of zeros is 1.4 million records; compressed it takes 400 bytes."""
    import tracemalloc

    size = 12 << 20
    record = chunk_of(bytes(size))
    intact = tmp_path / "good.mcap"
    write(intact, LogHeader(), CLOUDS[:4])
    data, first = intact.read_bytes(), chunks(intact)[0][0]
    (tmp_path / "zeros.mcap").write_bytes(data[:first] + record + data[first:])
    tracemalloc.start()
    found, losses = read(tmp_path / "zeros.mcap")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == 4
    assert [loss.what for loss in losses] == ["records of unknown kinds"]
    assert peak < 3 * size


def test_a_file_without_chunks_is_read_beyond_damage(tmp_path: Path) -> None:
    from mcap.writer import CompressionType, Writer

    from avsreplay.log.cdr import point_cloud2, schema_text

    with (tmp_path / "flat.mcap").open("wb") as file:
        writer = Writer(file, use_chunking=False, compression=CompressionType.NONE)
        writer.start("ros2")
        kind = "sensor_msgs/msg/PointCloud2"
        channel = writer.register_channel(
            "/p", "cdr", writer.register_schema(kind, "ros2msg", schema_text(kind))
        )
        for c in CLOUDS:
            writer.add_message(
                channel, c.log_ns, point_cloud2(c.t_ns, "s", c.points, None), c.log_ns
            )
        writer.finish()
    found, losses = read(tmp_path / "flat.mcap")
    assert len(found) == len(CLOUDS)
    assert not losses
    data = bytearray((tmp_path / "flat.mcap").read_bytes())
    at = data.index(struct.pack("<Q", CLOUDS[7].log_ns)) - 15  # the opcode of the eighth message
    data[at + 4] ^= 0x10
    (tmp_path / "x.mcap").write_bytes(data)
    found, losses = read(tmp_path / "x.mcap")
    assert len(found) == len(CLOUDS) - 1
    assert all(same(scan) for scan in found)
    assert losses[0].messages == 1


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89MCAP0", b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"hello world, no log", bytes(4096)],
)
def test_a_file_of_another_format_gives_one_error_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(UnreadableInput) as caught:
        open_source(tmp_path / "x.mcap")
    assert "\n" not in str(caught.value)


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(UnreadableInput, match="no such file"):
        open_source(tmp_path / "no.mcap")
    with pytest.raises(UnreadableInput, match="too long" if os.name == "posix" else "no such file"):
        open_source(tmp_path / ("n" * 5000))
    if os.name != "posix":
        return
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UnreadableInput, match="neither a file nor a folder"):
        open_source(tmp_path / "pipe")


def test_all_messages_agree_with_the_mcap_library(whole: dict[str, Path]) -> None:
    """Topic counts against the library's own linear reader."""
    counts: dict[int, int] = {}
    with whole["lz4"].open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if type(record).__name__ == "Message":
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
    with open_source(whole["lz4"]) as source:
        assert sorted(counts.values()) == sorted(t.count for t in source.info().topics)


def test_a_checksum_of_zero_means_none(whole: dict[str, Path], tmp_path: Path) -> None:
    data = bytearray(whole["none"].read_bytes())
    for begin, _ in chunks(whole["none"]):
        struct.pack_into("<I", data, begin + 33, 0)
    (tmp_path / "x.mcap").write_bytes(data)
    found, losses = read(tmp_path / "x.mcap")
    assert len(found) == len(CLOUDS)
    assert not losses
    assert zlib.crc32(b"") == 0
    shutil.rmtree(tmp_path)


def test_times_between_chunks_do_not_matter_to_the_order(tmp_path: Path) -> None:
    """Messages out of order in the file come in the recorder's order."""
    shuffled = [CLOUDS[i] for i in (3, 0, 1, 2, 7, 4)]
    write(tmp_path / "x.mcap", LogHeader(), shuffled)
    found, _ = read(tmp_path / "x.mcap")
    assert [s.t_ns for s in found] == sorted(c.t_ns for c in shuffled)
    assert all(same(scan) for scan in found)
    assert found[0].t_ns == SECOND


@pytest.mark.parametrize(
    "what", ["private records", "bad chunks", "chunk heads", "index records", "noise"]
)
@pytest.mark.slow
def test_the_work_for_hostile_bytes_grows_with_their_number(tmp_path: Path, what: str) -> None:
    """Records that make a careless search quadratic."""
    name = struct.pack("<I", 0)
    empty = struct.pack("<QQQI", 0, 0, 1, 7) + name + struct.pack("<Q", 1) + b"x"
    pieces = {
        "private records": struct.pack("<BQ", 0x90, 0),
        "bad chunks": struct.pack("<BQ", mcap.Opcode.CHUNK, len(empty)) + empty + b"\x11",
        "chunk heads": struct.pack("<BQ", mcap.Opcode.CHUNK, 1 << 40) + empty,
        "index records": struct.pack("<BQ", mcap.Opcode.MESSAGE_INDEX, 6)
        + struct.pack("<HI", 1, 0),
        "noise": np.random.Generator(np.random.PCG64(1))
        .integers(0, 256, 4096, dtype=np.uint8)
        .tobytes(),
    }
    assert_linear(tmp_path / "x.mcap", mcap.MCAP_MAGIC, pieces[what])


@pytest.mark.parametrize("what", ["chunk marks", "bad chunks", "noise"])
@pytest.mark.slow
def test_the_work_for_a_hostile_bag_grows_with_its_size(tmp_path: Path, what: str) -> None:
    fields = [b"compression=none", b"op=\x05", b"size=\x01\x00\x00\x00"]
    head = b"".join(struct.pack("<I", len(f)) + f for f in fields)
    pieces = {
        "chunk marks": b"\x30\x00\x00\x00\x04\x00\x00\x00op=\x05",
        "bad chunks": struct.pack("<I", len(head))
        + head
        + struct.pack("<I", 3)
        + b"xyz"
        + b"\xff" * 5,
        "noise": np.random.Generator(np.random.PCG64(1))
        .integers(0, 256, 4096, dtype=np.uint8)
        .tobytes(),
    }
    assert_linear(tmp_path / "x.bag", b"#ROSBAG V2.0\n", pieces[what])


def assert_linear(path: Path, head: bytes, piece: bytes) -> None:
    """Four times the bytes need at most five times the calls and the copied bytes."""
    calls, read = np.transpose(
        [work(path, head + piece * (size // len(piece))) for size in (1 << 17, 1 << 19)]
    )
    assert calls[1] <= 5 * calls[0] + 1000
    assert read[1] <= 5 * read[0] + (1 << 16)


def work(path: Path, data: bytes) -> tuple[int, int]:
    """Function calls, and bytes that are copied by reads, while a damaged file is opened."""
    path.write_bytes(data)
    calls = read = 0

    def count(frame: Any, event: str, arg: Any) -> None:
        nonlocal calls, read
        calls += event in ("call", "c_call")
        if event == "return" and frame.f_code.co_name == "read" and isinstance(arg, bytes):
            read += len(arg)

    sys.setprofile(count)
    try:
        with open_source(path, inspect=True) as source:
            assert source.losses
    finally:
        sys.setprofile(None)
    return calls, read


def test_an_attachment_over_the_limit_is_skipped(tmp_path: Path) -> None:
    """Even one that is a log itself, whose chunks are not ours."""
    from mcap.writer import Writer

    from avsreplay.log.cdr import point_cloud2, schema_text

    rng = np.random.Generator(np.random.PCG64(2))
    inner = [
        Scan(i, t, rng.normal(size=(9000, 3)).astype(np.float32), log_ns=t)
        for i, t in enumerate(range(1, 40))
    ]
    write(tmp_path / "inner.mcap", LogHeader(), inner, compression="none", chunk_bytes=300_000)
    kind = "sensor_msgs/msg/PointCloud2"
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_attachment(
            0, 0, "inner.mcap", "application/octet-stream", (tmp_path / "inner.mcap").read_bytes()
        )
        channel = writer.register_channel(
            "/p", "cdr", writer.register_schema(kind, "ros2msg", schema_text(kind))
        )
        for c in CLOUDS:
            writer.add_message(
                channel, c.log_ns, point_cloud2(c.t_ns, "s", c.points, None), c.log_ns
            )
        writer.finish()
    found, losses = read(tmp_path / "x.mcap", max_message_mib=2)
    assert len(found) == len(CLOUDS)
    assert all(same(scan) for scan in found)
    assert "over the limit" in losses[0].what
    assert not read(tmp_path / "x.mcap")[1]
