"""Depth images of a recording in order, each with the camera of the CameraInfo beside it."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence

from avsreplay.errors import UnreadableInput
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.camera import CAMERA_INFO, Camera, read_camera_info
from avsreplay.log.cdr import Cursor
from avsreplay.log.depth_image import IMAGE_TYPES, decode_depth, depth_cloud, is_depth
from avsreplay.log.index import MessageClouds, Recording
from avsreplay.log.options import TopicInfo
from avsreplay.log.raw_cloud import RawCloud

_EXAMINED_IMAGES = 3  # messages of a topic of images that are examined: one may be damaged
_RECTIFIED = re.compile(r"(?<!un)rect", re.IGNORECASE)


def depth_topics(recording: Recording) -> list[TopicInfo]:
    """Return the topics of images whose messages are depths, sorted by name."""
    return [t for t in recording.topics() if t.type in IMAGE_TYPES and _has_depth(recording, t)]


def _has_depth(recording: Recording, topic: TopicInfo) -> bool:
    for place in range(min(topic.count, _EXAMINED_IMAGES)):
        try:
            payload = recording.read(topic.name, place)
        except BadMessage:
            continue
        if is_depth(topic.type, topic.name, payload, topic.encoding):
            return True
    return False


class DepthImages(MessageClouds):
    """The depth images of one topic as clouds; same interface as MessageClouds.

    The camera is that of the CameraInfo topic with the longest common begin of the name, of several
    the one with the frame of the image; of its messages, the one whose stamp is nearest.

    Args:
        recording: the log.
        topic: of ``depth_topics``.
        limit: largest image that is decompressed [bytes].
        stated: camera that is used in place of that of the log.

    Raises:
        UnreadableInput: the log has no CameraInfo and no camera is stated.
    """

    def __init__(
        self, recording: Recording, topic: str, limit: int, stated: Camera | None = None
    ) -> None:
        super().__init__(recording, topic)
        self._limit, self._stated = limit, stated
        self._rectified = bool(_RECTIFIED.search("/".join(topic.split("/")[-2:])))
        infos = [t for t in recording.topics() if t.type == CAMERA_INFO and t.count]
        self._info = "" if stated else self._nearest(infos, topic)
        index = recording.clouds(self._info)
        self._order = sorted(range(len(index.header_ns)), key=index.header_ns.__getitem__)
        self._stamps = [index.header_ns[i] for i in self._order]
        if stated is None and not self._stamps:
            hint = "give --intrinsics FX,FY,CX,CY, or --intrinsics FILE"
            what = f"depth images on {shown(topic)} and no CameraInfo"
            raise UnreadableInput(what, where=shown(recording.path), hint=hint)

    def load(self, place: int) -> RawCloud:
        """Return the points of an image. Raises BadMessage if it cannot be decoded."""
        payload, encoding = self.payload(place)
        image = decode_depth(self.type, payload, encoding, self._limit)
        return depth_cloud(image, self._stated or self._camera(image.stamp_ns))

    def _camera(self, stamp_ns: int) -> Camera:
        """Return the camera of the CameraInfo nearest to a stamp."""
        after = bisect_left(self._stamps, stamp_ns)
        near = self._stamps[max(after - 1, 0) : after + 1]
        k = max(after - 1, 0) + min(range(len(near)), key=lambda i: abs(near[i] - stamp_ns))
        payload = self._recording.read(self._info, self._order[k])
        return read_camera_info(payload, self._encoding, self._rectified)[2]

    def _nearest(self, infos: Sequence[TopicInfo], topic: str) -> str:
        frame = _frame(self._recording, topic, self._encoding)

        def rank(info: TopicInfo) -> tuple[int, bool]:
            return _shared(info.name, topic), _frame(
                self._recording, info.name, info.encoding
            ) == frame

        return max(infos, key=rank).name if infos else ""


def _frame(recording: Recording, topic: str, encoding: str) -> str | None:
    """Return the frame of the first message of a topic, None if it cannot be read."""
    try:
        return Cursor(recording.read(topic, 0), encoding).header()[1]
    except BadMessage:
        return None


def _shared(one: str, two: str) -> int:
    """Return the number of parts that two names of topics have in common at their begin."""
    pairs = zip(one.strip("/").split("/"), two.strip("/").split("/"), strict=False)
    count = 0
    for a, b in pairs:
        if a != b:
            break
        count += 1
    return count
