"""The channels of an MCAP file: by their definitions, or, where those are lost, by what their messages are."""

from __future__ import annotations

from avsreplay.log.mcap_guess import guess_channel
from avsreplay.log.mcap_records import Channel, Fields
from avsreplay.log.recording import MessageTable, canonical_type

__all__ = ["ChannelTable"]


class ChannelTable:
    """Channels by id; the first definition of an id holds.

    Args:
        table: where their topics are declared.
    """

    def __init__(self, table: MessageTable) -> None:
        self._table = table
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self.by_id: dict[int, Channel] = {}

    def schema(self, fields: Fields) -> None:
        """Take in a schema record. Raises BadMessage."""
        number, name, encoding = fields.number(2), fields.text(), fields.text()
        self._schemas.setdefault(number, (name, encoding, bytes(fields.take(fields.number(4)))))

    def channel(self, fields: Fields) -> None:
        """Take in a channel record. Raises BadMessage."""
        number, schema = fields.number(2), fields.number(2)
        topic, encoding = fields.text(), fields.text()
        name, form, text = self._schemas.get(schema, ("", "", b""))
        self._take(Channel(number, topic, canonical_type(name), encoding, form, text, fields.mapping()))

    def guess(self, number: int, payload: memoryview, library: str) -> Channel | None:
        """Take a channel without a definition for what its message is; None where nothing tells."""
        channel = guess_channel(number, payload, library)
        if channel is not None:
            self._take(channel)
        return channel

    def _take(self, channel: Channel) -> None:
        if channel.id not in self.by_id:
            self.by_id[channel.id] = channel
            self._table.declare(channel.topic, channel.type, channel.encoding)
