"""The writer of MCAP files writes the bytes of the mcap library."""

from __future__ import annotations

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from avsreplay.log.mcap_writer import McapWriter

COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
NUMBER = np.dtype([("head", "<u4"), ("value", "<f8")])


class _Both:
    """Gives the same records to the library and to this writer."""

    def __init__(self, compression: str, chunk_bytes: int) -> None:
        self.streams = io.BytesIO(), io.BytesIO()
        self._library = Writer(self.streams[0], chunk_bytes, COMPRESSIONS[compression], enable_data_crcs=True)
        self._library.start("ros2", "test")
        self._ours = McapWriter(self.streams[1], "ros2", "test", compression, chunk_bytes)

    def __getattr__(self, name: str):
        def call(*args: object) -> object:
            first, second = (getattr(writer, name)(*args) for writer in (self._library, self._ours))
            assert first == second
            return first

        return call

    def add_messages(self, channels: tuple[int, ...], t_ns: int, values: np.ndarray, sequence: int) -> None:
        for channel, value in zip(channels, values, strict=True):
            self._library.add_message(channel, t_ns, value.tobytes(), t_ns, sequence)
        self._ours.add_messages(channels, t_ns, values, sequence)

    def bytes(self) -> tuple[bytes, bytes]:
        self.finish()
        library, ours = self.streams
        return library.getvalue(), ours.getvalue()


@pytest.mark.parametrize("compression", sorted(COMPRESSIONS))
@pytest.mark.parametrize("chunk_bytes", [1, 700, 1 << 20])
def test_records_in_any_order_give_the_bytes_of_the_library(compression: str, chunk_bytes: int) -> None:
    for seed in range(8):
        rng = np.random.Generator(np.random.PCG64(seed))
        both = _Both(compression, chunk_bytes)
        channels = [both.register_channel("/x", "cdr", both.register_schema("a/msg/B", "ros2msg", b"int8 a"), {})]
        for k in range(40):
            kind, t_ns = rng.choice(8), int(rng.integers(0, 1 << 62))
            payload = rng.bytes(int(rng.integers(0, 200)))
            if kind == 0:
                both.add_metadata(f"m{k}", {"key": "value \u00b5", "": str(k)} if rng.random() < 0.5 else {})
            elif kind == 1:
                both.add_attachment(t_ns, t_ns // 2, f"a{k}.ply", "text/\u00e9", payload)
            elif kind == 2:
                schema = both.register_schema(f"s{k}", "ros2msg", payload)
                channels.append(both.register_channel(f"/t\u00e4{k}", "cdr", schema, {"qos": "x"} if k % 2 else {}))
            elif kind == 3:
                both.flush()
            elif kind in (4, 5):
                chosen = tuple(int(c) for c in rng.permutation(channels)[: int(rng.integers(0, 9))])
                values = np.array([(256, v) for v in rng.normal(size=len(chosen))], NUMBER)
                both.add_messages(chosen, t_ns, values, k)
            else:
                both.add_message(int(rng.choice(channels)), t_ns, payload, t_ns // 3, k)
        library, ours = both.bytes()
        assert ours == library, seed


def test_a_file_without_messages_gives_the_bytes_of_the_library() -> None:
    library, ours = _Both("zstd", 100).bytes()
    assert ours == library


def test_definitions_of_many_channels_before_the_first_message_give_the_bytes_of_the_library() -> None:
    """The chunk is larger than its limit before it has a message."""
    both = _Both("lz4", 300)
    schema = both.register_schema("a", "ros2msg", b"int8 a")
    channels = [both.register_channel(f"/{k}", "cdr", schema, {}) for k in range(20)]
    both.add_messages(tuple(channels), 5, np.zeros(20, NUMBER), 1)
    library, ours = both.bytes()
    assert ours == library


def test_messages_of_one_array_are_read_back_one_by_one() -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, "ros2", "test", "lz4")
    schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
    channels = tuple(writer.register_channel(f"/{k}", "cdr", schema, {}) for k in range(3))
    writer.add_messages(channels, 7, np.array([(256, 1.5), (256, -2.0), (256, 1e300)], NUMBER), 4)
    writer.finish()
    stream.seek(0)
    read = [
        (channel.topic, message.log_time, message.sequence, np.frombuffer(message.data, NUMBER)["value"][0])
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
    ]
    assert read == [("/0", 7, 4, 1.5), ("/1", 7, 4, -2.0), ("/2", 7, 4, 1e300)]
