"""Reading and writing of serialised ROS messages: CDR (ROS 2, both byte orders) and the ROS 1 wire form.

One cursor serves both: they differ in alignment, in the string's closing NUL and in the header's ``seq``.
Every read is checked against the end of the buffer, so that a length that lies is a ``BadMessage``, never more.
"""

from __future__ import annotations

import struct

__all__ = ["BadMessage", "Cursor", "Packer"]

_CDR_LITTLE = {0x0001: "<", 0x0000: ">"}  # plain CDR; parameter lists (0x0002, 0x0003) are no ROS message


class BadMessage(ValueError):
    """A message whose bytes do not say what its type demands."""


class Cursor:
    """A checked walk over one message.

    Attributes:
        data: the bytes walked over (of CDR: after the four-byte encapsulation).  pos: next byte.
        order: ``<`` or ``>``.  ros1: the wire form of ROS 1.
    """

    __slots__ = ("data", "order", "pos", "ros1")

    def __init__(self, payload: bytes | memoryview, encoding: str = "cdr") -> None:
        view = memoryview(payload).cast("B")
        self.pos = 0
        self.ros1 = encoding == "ros1"
        self.order = "<"
        if not self.ros1:
            if len(view) < 4:
                raise BadMessage("shorter than the CDR encapsulation")
            kind = (view[0] << 8) | view[1]
            if kind not in _CDR_LITTLE:
                raise BadMessage(f"unknown CDR encapsulation 0x{kind:04x}")
            self.order = _CDR_LITTLE[kind]
            view = view[4:]
        self.data = view

    def _take(self, fmt: str, size: int) -> int | float:
        start = self.pos if self.ros1 else (self.pos + size - 1) & -size
        try:
            value: int | float = struct.unpack_from(self.order + fmt, self.data, start)[0]
        except struct.error:
            raise BadMessage(f"ends at byte {len(self.data)}, {start + size} needed") from None
        self.pos = start + size
        return value

    def u8(self) -> int:
        """An octet."""
        return int(self._take("B", 1))

    def u32(self) -> int:
        """An unsigned 32-bit number."""
        return int(self._take("I", 4))

    def i32(self) -> int:
        """A signed 32-bit number."""
        return int(self._take("i", 4))

    def f64s(self, count: int) -> tuple[float, ...]:
        """``count`` doubles, without a length before them."""
        start = self.pos if self.ros1 else (self.pos + 7) & -8
        try:
            values = struct.unpack_from(f"{self.order}{count}d", self.data, start)
        except struct.error:
            raise BadMessage(f"ends at byte {len(self.data)}, {start + 8 * count} needed") from None
        self.pos = start + 8 * count
        return values

    def octets(self) -> memoryview:
        """A sequence of octets, as a view."""
        size = self.u32()
        start = self.pos
        if start + size > len(self.data):
            raise BadMessage(f"a sequence of {size} bytes where {len(self.data) - start} are left")
        self.pos = start + size
        return self.data[start : self.pos]

    def string(self) -> str:
        r"""Text; bytes that are not UTF-8 are kept readable as ``\xNN``."""
        raw = bytes(self.octets())
        return (raw if self.ros1 else raw.rstrip(b"\x00")).decode("utf-8", "backslashreplace")

    def stamp(self) -> int:
        """A time [ns]."""
        seconds = self.u32() if self.ros1 else self.i32()
        return seconds * 1_000_000_000 + self.u32()

    def header(self) -> tuple[int, str]:
        """A std_msgs Header: stamp [ns] and frame."""
        if self.ros1:
            self.u32()
        return self.stamp(), self.string()


class Packer:
    """Little-endian CDR, written front to back."""

    __slots__ = ("out",)

    def __init__(self) -> None:
        self.out = bytearray(b"\x00\x01\x00\x00")

    def _align(self, size: int) -> None:
        self.out += b"\x00" * (-(len(self.out) - 4) % size)

    def u8(self, value: int) -> Packer:
        """An octet."""
        self.out.append(value)
        return self

    def u32(self, value: int) -> Packer:
        """An unsigned 32-bit number."""
        self._align(4)
        self.out += struct.pack("<I", value)
        return self

    def i32(self, value: int) -> Packer:
        """A signed 32-bit number."""
        self._align(4)
        self.out += struct.pack("<i", value)
        return self

    def f64s(self, *values: float) -> Packer:
        """Doubles, without a length before them."""
        self._align(8)
        self.out += struct.pack(f"<{len(values)}d", *values)
        return self

    def string(self, text: str) -> Packer:
        """Text with its closing NUL."""
        raw = text.encode("utf-8") + b"\x00"
        self.u32(len(raw))
        self.out += raw
        return self

    def octets(self, raw: bytes) -> Packer:
        """A sequence of octets."""
        self.u32(len(raw))
        self.out += raw
        return self

    def header(self, t_ns: int, frame: str) -> Packer:
        """A std_msgs Header. Raises ValueError where ``t_ns`` does not fit a ROS 2 time."""
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        if not -(2**31) <= seconds < 2**31:
            raise ValueError(f"stamp {t_ns} ns does not fit a ROS 2 time")
        return self.i32(seconds).u32(nanoseconds).string(frame)

    def bytes(self) -> bytes:
        """What was packed."""
        return bytes(self.out)
