"""The writer of MCAP files writes the bytes of the library ``mcap``."""

import io
import struct

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from avsreplay.log.mcap_writer import McapWriter

KINDS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "": CompressionType.NONE}


def scalar(value: float) -> bytes:
    return struct.pack("<xBxxd", 1, value)


@pytest.mark.parametrize("compression", KINDS)
def test_every_record_has_the_bytes_of_the_library(compression):
    theirs, ours = io.BytesIO(), io.BytesIO()
    library = Writer(theirs, 300, KINDS[compression], enable_data_crcs=True)
    library.start(profile="ros2", library="x")
    writer = McapWriter(ours, "x", compression, 300)
    library.add_metadata("facts", {"a": "1", "b": "é"})
    writer.metadata("facts", {"a": "1", "b": "é"})
    library.add_attachment(5, 3, "model.ply", "application/octet-stream", b"ply" * 40)
    writer.attachment("model.ply", "application/octet-stream", b"ply" * 40, (3, 5))
    assert library.register_schema("T", "ros2msg", b"float64 data") == writer.schema("T", "ros2msg", b"float64 data")
    for topic in ("/a", "/b"):
        assert library.register_channel(topic, "cdr", 1, {"qos": ""}) == writer.channel(topic, "cdr", 1, {"qos": ""})
    for k, (channel, t_ns) in enumerate(((1, 7), (2, 5), (1, 9), (1, 4), (2, 12))):
        library.add_message(channel, t_ns, bytes(60 + k), t_ns + k, k)
        writer.message(channel, t_ns, bytes(60 + k), k, t_ns + k)
    library.flush()
    writer.flush()
    library.finish()
    writer.finish()
    assert ours.getvalue() == theirs.getvalue()


def test_scalars_are_one_message_of_each_channel():
    one, several = io.BytesIO(), io.BytesIO()
    values = np.array([1.5, np.nan, -2.0])
    for stream in (one, several):
        writer = McapWriter(stream, "x")
        schema = writer.schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channels = [writer.channel(f"/rows/{name}", "cdr", schema, {}) for name in "abc"]
        if stream is one:
            writer.scalars(channels, 11, values, 4)
        else:
            for channel, value in zip(channels, values, strict=True):
                writer.message(channel, 11, scalar(value), 4)
        writer.finish()
    assert one.getvalue() == several.getvalue()
