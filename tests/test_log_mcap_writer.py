"""The writer of the MCAP format gives the bytes of the reference library, whatever is written."""

from __future__ import annotations

import io
import random

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from avsreplay.log.mcap_writer import McapWriter

KINDS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "": CompressionType.NONE}


def written(seed: int, compression: str) -> tuple[bytes, bytes, list[tuple[str, int, int, int, bytes]]]:
    """The bytes of this writer and of the library for the same random calls, and the messages."""
    draw, chunk_bytes = random.Random(seed), random.Random(seed).choice((1, 300, 5000, 1 << 30))
    ours, theirs = io.BytesIO(), io.BytesIO()
    a = McapWriter(ours, "ros2", "test", chunk_bytes, compression)
    b = Writer(theirs, chunk_bytes, KINDS[compression], enable_data_crcs=True)
    b.start(profile="ros2", library="test")
    channels: list[str] = []
    messages = []
    for k in range(draw.choice((0, 1, 200))):
        what = draw.choice(("message",) * 8 + ("channel", "metadata", "attachment", "chunk"))
        if what == "channel" or (what == "message" and not channels):
            name, text, topic = f"pkg/Typ{k}é", draw.randbytes(draw.randrange(50)), f"/topic/{k}"
            schema = a.register_schema(name, "ros2msg", text)
            assert schema == b.register_schema(name, "ros2msg", text)
            extra = draw.choice(({}, {"qos": "", "ü": "x" * 40}))
            assert a.register_channel(topic, "cdr", schema, extra) == b.register_channel(topic, "cdr", schema, extra)
            channels.append(topic)
        elif what == "message":
            channel, payload = draw.randrange(len(channels)) + 1, draw.randbytes(draw.randrange(400))
            log_ns, publish_ns = draw.randrange(2**63), draw.randrange(2**63)
            a.add_message(channel, log_ns, payload, publish_ns, k)
            b.add_message(channel, log_ns, payload, publish_ns, k)
            messages.append((channels[channel - 1], log_ns, publish_ns, k, payload))
        elif what == "metadata":
            a.add_metadata(f"note{k}", {"key": "v" * k})
            b.add_metadata(f"note{k}", {"key": "v" * k})
        elif what == "attachment":
            data = draw.randbytes(draw.randrange(300))
            a.add_attachment(k, k + 1, "a.ply", "application/octet-stream", data)
            b.add_attachment(k + 1, k, "a.ply", "application/octet-stream", data)
        else:
            a.end_chunk()
            b.flush()
    a.finish()
    b.finish()
    return ours.getvalue(), theirs.getvalue(), messages


@pytest.mark.parametrize("compression", KINDS)
@pytest.mark.parametrize("seed", range(6))
def test_the_bytes_are_those_of_the_library(seed: int, compression: str) -> None:
    ours, theirs, _ = written(seed, compression)
    assert ours == theirs


@pytest.mark.parametrize("seed", range(6))
def test_the_library_reads_every_message(seed: int) -> None:
    ours, _, messages = written(seed, "zstd")
    reader = make_reader(io.BytesIO(ours), validate_crcs=True)
    found = [
        (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
        for _, channel, m in reader.iter_messages(log_time_order=False)
    ]
    assert sorted(found) == sorted(messages)
