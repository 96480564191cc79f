"""Depth images: sensor_msgs/Image and CompressedImage messages and PNG files, as points and rays.

A pixel holds the z coordinate: millimetres as 16-bit numbers, where 0 and 65,535 mean no return, or
metres as 32-bit floats, where a value that is not positive and finite means none. Sizes that a
message declares are compared with its bytes before memory is allocated.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.log.bytes_io import BadMessage
from avsreplay.log.camera import Camera, rays
from avsreplay.log.cdr import Cursor
from avsreplay.log.raw_cloud import RawCloud

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE_TYPES = (IMAGE, COMPRESSED_IMAGE)
_DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEAD = struct.Struct(">8sI4sIIBB")
_CONFIG = struct.Struct("<iff")  # what compressed_depth_image_transport writes before the PNG
_NO_RETURN = (0, 65535)
_MAX_PIXELS = 64 << 20
_DEPTH_NAME = re.compile(r"depth", re.IGNORECASE)


@value_class
class DepthImage:
    """A depth image as it was stored.

    Attributes:
        stamp_ns: header stamp [ns].
        frame: header frame.
        values: (height, width), unsigned 16-bit or 32-bit float; the latter in metres.
    """

    stamp_ns: int
    frame: str
    values: NDArray[Any]


def is_depth(kind: str, topic: str, payload: bytes | memoryview, encoding: str) -> bool:
    """Return whether a message of ``IMAGE_TYPES`` is a depth image, by its stated encoding.

    Args:
        kind: type of the message.
        topic: its topic; 16-bit grey values are depths only where its name says so.
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.
    """
    try:
        cursor = Cursor(payload, encoding)
        cursor.header()
        if kind == IMAGE:
            cursor.u32(), cursor.u32()
            stated = cursor.string()
            return stated in _DEPTHS and (stated != "mono16" or bool(_DEPTH_NAME.search(topic)))
        stated = cursor.string()
        return "compressedDepth" in stated or stated.startswith(("16UC1", "32FC1"))
    except BadMessage:
        return False


def decode_depth(kind: str, payload: bytes | memoryview, encoding: str, limit: int) -> DepthImage:
    """Decode a message of ``IMAGE_TYPES``.

    Args:
        kind: type of the message.
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.
        limit: largest image that is decompressed [bytes].

    Raises:
        BadMessage: the message is malformed, or is not a depth image; the text states why.
    """
    cursor = Cursor(payload, encoding)
    stamp_ns, frame = cursor.header()
    values = _plain(cursor) if kind == IMAGE else _compressed(cursor, limit)
    return DepthImage(stamp_ns, frame, values)


def _plain(cursor: Cursor) -> NDArray[Any]:
    height, width, stated = cursor.u32(), cursor.u32(), cursor.string()
    order, step = (">" if cursor.u8() else "<"), cursor.u32()
    data = cursor.octets()
    if stated not in _DEPTHS:
        raise BadMessage(f"an image of encoding '{stated}', not 16UC1 or 32FC1")
    kind = np.dtype(order + _DEPTHS[stated])
    row = width * kind.itemsize
    if step < row or (height and (height - 1) * step + row > len(data)):
        raise BadMessage(
            f"{height} rows of {step} bytes, {width} pixels each, in {len(data)} bytes"
        )
    values = np.ndarray((height, width), kind, data, 0, (step, kind.itemsize))
    return values.astype(kind.newbyteorder("="), copy=False)


def _compressed(cursor: Cursor, limit: int) -> NDArray[Any]:
    stated, data = cursor.string(), bytes(cursor.octets())
    if data.startswith(_PNG):
        return read_png(data, limit)
    if data[_CONFIG.size :].startswith(_PNG):
        packed = read_png(data[_CONFIG.size :], limit)
        _, a, b = _CONFIG.unpack_from(data)
        return _from_inverse(packed, a, b) if stated.startswith("32FC1") else packed
    what = " (rvl)" if "rvl" in stated else ""
    raise BadMessage(
        f"a compressed image '{stated}'{what} that is not a PNG: decompress it with image_transport"
    )


def _from_inverse(packed: NDArray[np.uint16], a: float, b: float) -> NDArray[np.float32]:
    """Return depths [m] from quantised inverse depths q: a / (q - b), NaN for 0."""
    with np.errstate(all="ignore"):
        depth = a / (packed.astype(np.float64) - b)
    return np.where(packed == 0, np.nan, depth).astype(np.float32)


def read_png(data: bytes, limit: int) -> NDArray[np.uint16]:
    """Return the 16-bit grey values of a PNG.

    Args:
        data: the file.
        limit: largest image that is decompressed [bytes].

    Raises:
        BadMessage: it is not a readable PNG with one channel of 16 bits, or over the limit.
    """
    if len(data) < _PNG_HEAD.size or not data.startswith(_PNG):
        raise BadMessage("not a PNG")
    _, _, name, width, height, bits, colour = _PNG_HEAD.unpack_from(data)
    if name != b"IHDR" or (bits, colour) != (16, 0):
        raise BadMessage(f"a PNG of {bits} bits and colour type {colour}: depth is 16-bit grey")
    if not 0 < width * height <= min(limit // 2, _MAX_PIXELS):
        raise BadMessage(f"a PNG of {width} x {height} pixels is over the limit of {limit} bytes")
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
                values = np.asarray(image)
    except (
        UnidentifiedImageError,
        Image.DecompressionBombError,
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        zlib.error,
        struct.error,
    ) as error:
        raise BadMessage(f"a PNG that cannot be decompressed: {str(error)[:80]}") from None
    if values.shape != (height, width):
        raise BadMessage("a PNG whose pixels do not match its header")
    return values.astype(np.uint16, copy=False)


def depth_cloud(image: DepthImage, camera: Camera) -> RawCloud:
    """Return a depth image as a cloud with a row for each row of pixels, and the ray of each pixel.

    Args:
        image: the image.
        camera: its camera.

    Returns:
        The cloud; the coordinates of a pixel without a return are not a number.

    Raises:
        BadMessage: the image has another size than the camera.
    """
    height, width = shape = image.values.shape
    if camera.size is not None and camera.size != (width, height):
        other = " x ".join(map(str, camera.size))
        raise BadMessage(f"an image of {width} x {height} pixels, its camera has {other}")
    if image.values.dtype.kind == "f":
        unit_m, seen = 1.0, np.isfinite(image.values) & (image.values > 0.0)
    else:
        unit_m, seen = camera.unit_m, ~np.isin(image.values, _NO_RETURN)
    z = np.where(seen, image.values, np.nan).astype(np.float32)
    slopes, directions = rays(camera, width, height)
    fields = {"x": slopes[:, :, 0] * z, "y": slopes[:, :, 1] * z, "z": z}
    return RawCloud(image.stamp_ns, image.frame, fields, shape, None, directions, unit_m)
