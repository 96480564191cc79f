"""A source of scans, independent of the format of its files."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay import geometry
from avsreplay.errors import UnreadableInput
from avsreplay.geometry import MeasuredPose, Pose
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.canonical import (
    INFERENCE_CLOUDS,
    Cloud,
    Meaning,
    at_stamp,
    canonical,
    infer,
    selected,
    spread,
)
from avsreplay.log.clock import Placed, place
from avsreplay.log.options import (
    ClockChoice,
    ClockSummary,
    LogInfo,
    Loss,
    SourceOptions,
    lost_text,
)
from avsreplay.log.point_cloud2 import Layout
from avsreplay.log.point_times import TimedCloud
from avsreplay.log.streams import CloudStream, GroundTruth, about_grasp, ahead
from avsreplay.records import LogHeader, Scan, ScanStatus, State, Truth

_HASHED_BYTES = 1 << 20  # most bytes of a file that are hashed at once
UNKNOWN_SENSOR = "the pose of the sensor is unknown at the time of the scan"


class Source:
    """The scans of one log or folder in the order of the recorder; a context manager.

    Attributes:
        path: the log or folder.
        header: the header of the log, with the requested model in place of its own.
        options: how the source is read.
        damaged: why scans that were read so far could not be decoded, by their number among the
            selected ones.
    """

    def __init__(
        self,
        path: Path,
        clouds: CloudStream,
        header: LogHeader,
        options: SourceOptions,
        ground_truth: GroundTruth,
        *,
        files: Sequence[Path],
        extra: dict[str, str] | None = None,
        losses: tuple[Loss, ...] = (),
    ) -> None:
        """Combine the parts of an open source; ``open_source`` does this for a path.

        Args:
            path: the log or folder.
            clouds: the clouds of the selected topic, with their recorded times.
            header: the header of the log.
            options: how the source is read.
            ground_truth: true poses and states, as far as they are known.
            files: the files of the source, in the order of the checksum.
            extra: ``profile`` and ``library`` of the file for ``info``, where it states them.
            losses: parts that could not be read, apart from those of ``clouds``.
        """
        if options.grasp is not None:
            header, ground_truth = about_grasp(np.array(options.grasp), header, ground_truth)
        self.path, self.header, self.options = path, header, options
        self._clouds, self._ground_truth, self._files = clouds, ground_truth, tuple(files)
        self._extra = extra or {}
        self._placed, self._clock = place(
            clouds.log_ns, clouds.publish_ns, clouds.header_ns, options.clock
        )
        self._lost, self.damaged = losses, dict[int, str]()
        self._watched: dict[Path, tuple[int, int, int] | None] = {}

    def __enter__(self) -> Source:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __len__(self) -> int:
        """Return the number of selected scans."""
        return len(self._selected)

    @property
    def losses(self) -> list[Loss]:
        """Return the parts that could not be read, in file order, then the files that changed."""
        changed = [
            Loss("changed or removed while it was read", 0, 0, file=path.name)
            for path, before in self._watched.items()
            if _state(path) != before
        ]
        return [*self._clouds.losses, *self._lost, *changed]

    def watch(self) -> None:
        """Report every file that changes from now on as a loss."""
        self._watched = {path: _state(path) for path in self._files}

    def add_loss(self, loss: Loss) -> None:
        """Add a part that is missing for a reason outside of the file.

        Args:
            loss: the part, as it is reported.
        """
        self._lost = (*self._lost, loss)

    @property
    def clock(self) -> ClockSummary:
        """Return how the times of the scans were determined."""
        return self._clock

    @cached_property
    def meaning(self) -> Meaning:
        """What the numbers of the clouds mean, inferred from some that are spread over the log."""
        if self.options.poses:
            return Meaning()
        sound = [k for k, placed in enumerate(self._placed) if placed.note is None]
        sample = list[TimedCloud]()
        for k in spread(len(sound), INFERENCE_CLOUDS):
            with suppress(BadMessage):
                sample.append(TimedCloud(self._clouds.load(sound[k]), self._stamp(sound[k])))
        return infer(sample, self._period_s(), self.options)

    def _period_s(self) -> float | None:
        """Return the usual time between two scans [s], None if it is not known."""
        if not self._clouds.topics() and "assumed" in self.header.notes.get("times", ""):
            return None
        steps = sorted(b.t_ns - a.t_ns for a, b in pairwise(self._placed))
        period_ns = steps[len(steps) // 2] if steps else 0
        return period_ns * 1e-9 if period_ns > 1 else None

    def truth_poses(self) -> list[tuple[int, Pose]]:
        """Return (t_ns, true pose T_ac) of every scan that has one and whose stamp is valid, in
        ascending order.
        """
        truth = self._ground_truth.truth
        if truth is None:
            return []
        valid = [(p.t_ns, place) for place, p in enumerate(self._placed) if not p.note]
        found = {t_ns: truth(t_ns, place, "") for t_ns, place in valid}
        return [
            (t_ns, pose)
            for t_ns, pose in sorted(found.items(), key=lambda item: item[0])
            if pose is not None
        ]

    @cached_property
    def sha256(self) -> str:
        """Return the SHA-256 of the file; for a folder or split log, of the names and bytes
        of its files in order.
        """
        digest = hashlib.sha256()
        for path in self._files:
            if self.path.is_dir():
                digest.update(
                    path.relative_to(self.path).as_posix().encode("utf-8", "surrogateescape")
                    + b"\0"
                )
            with path.open("rb") as file:
                while block := file.read(_HASHED_BYTES):
                    digest.update(block)
        return digest.hexdigest()

    @property
    def first_ns(self) -> int:
        """Return the instant of the first selected scan [ns], 0 without one."""
        return self._placed[self._selected[0]].t_ns if self._selected else 0

    def scans(self, prefetch: int = 0, first: int = 0) -> Generator[Scan]:
        """Yield the selected scans.

        Args:
            prefetch: number of scans decoded ahead on a second thread; 0 decodes each when it is
                requested.
            first: number of the first scan among the selected ones.

        Returns:
            An iterator; a scan that cannot be decoded is yielded without points and with the status
            DAMAGED.
        """
        scans = (self._scan(seq, self._selected[seq]) for seq in range(first, len(self)))
        return ahead(scans, prefetch) if prefetch else scans

    def scan_at(self, seq: int) -> Scan:
        """Return one selected scan, without points and with the status DAMAGED if it cannot be
        decoded.

        Args:
            seq: index among the selected scans, from 0.

        Returns:
            The scan.

        Raises:
            IndexError: there is no such scan.
            UnreadableInput: it cannot be decoded, and the source was opened with ``strict``.
        """
        return self._scan(seq, self._selected[seq])

    def truth_of(self, scan: Scan) -> Truth:
        """Return the ground truth at a scan.

        Args:
            scan: a scan of this source.

        Returns:
            The true pose T_ac, the full state and the injected fault, each None where it is not
            known.
        """
        lookup, place = self._ground_truth.truth, self._selected[scan.seq]
        pose = None if lookup is None else lookup(scan.t_ns, place, scan.frame)
        return Truth(pose, self._body_at(scan.t_ns), self._fault(scan.log_ns))

    def truth_problem(self, scans: Sequence[Scan]) -> tuple[str, str] | None:
        """Return why none of some scans has a true pose, or why the errors would refer to another
        frame.

        Args:
            scans: scans of this source.

        Returns:
            The problem and the option that may solve it, "" if there is none; None without a
            problem.
        """
        if all(self.truth_of(scan).pose is None for scan in scans):
            return self._without_truth(scans) if scans else None
        return self._in_other_frame(scans[0].frame)

    def _without_truth(self, scans: Sequence[Scan]) -> tuple[str, str]:
        """Why none of some scans has a true pose, and the option that may solve it."""
        track, options = self._ground_truth.track, self.options
        if track is None:
            why, gap = "", False
        else:
            why, gap = track.uncovered([scan.t_ns for scan in scans])
        option = "--truth-gap SECONDS" if gap else ""
        if why and not gap and options.truth_file is None and options.clock is ClockChoice.HEADER:
            option = "--clock log"
        return f"no examined scan of {len(scans)} has a true pose{why}", option

    def _in_other_frame(self, frame: str) -> tuple[str, str] | None:
        """Whether the true poses are in another frame than clouds in a frame, and the option that
        may solve it.
        """
        track, options = self._ground_truth.track, self.options
        if track is None or options.truth_file or options.sensor_topic:
            return None
        at, clouds = track.frame.lstrip("/"), (options.fixed_frame or frame).lstrip("/")
        text = f"the true poses are in '{shown(at)}', the clouds in '{shown(clouds)}'"
        if self._apart(at, clouds):
            return f"{text}, and no transform of the log connects them", ""
        if not at or not clouds or at == clouds:
            return None
        frames = self._ground_truth.frames
        known = at in frames if frames else self._has_transforms()
        return (text, f"--fixed-frame {shown(at)}") if known else None

    def _has_transforms(self) -> bool:
        """Whether the log has messages of /tf."""
        topics = self._clouds.topics()
        return any(topic.type.endswith("TFMessage") and topic.count for topic in topics)

    def in_own_frame(self, scan: Scan) -> NDArray[Any]:
        """Return the points (n, 3) of a scan in the frame of its cloud, to which crops refer [m].

        Args:
            scan: of this source.
        """
        frame = self.frame_of(scan)
        return scan.points if frame is None else frame.inverse().apply(scan.points)

    def frame_of(self, scan: Scan) -> Pose | None:
        """Return the pose of the frame of a cloud in {A}; None if it is {A}.

        Args:
            scan: of this source.
        """
        if self._ground_truth.sensor is None or scan.sensor is None:
            return None
        return scan.sensor @ self._sensor_at.inverse()

    def moving_beside(self, frame: str) -> list[str]:
        """Return the frames of /tf that move and do not carry a frame.

        Args:
            frame: name of the frame of a cloud.
        """
        return self._ground_truth.moving_beside(frame)

    def _apart(self, one: str, two: str) -> bool:
        """Whether two named frames are in no common tree of transforms."""
        known = self._ground_truth.frames
        return bool(
            one and two and one != two and one in known
        ) and not self._ground_truth.connected(one, two)

    def moving_in(self, frame: str) -> str | None:
        """Return the root frame in which a frame moves; None if it is fixed or the transforms were
        not collected.

        Args:
            frame: name of the frame of a cloud.
        """
        return self._ground_truth.moving_in(frame)

    def layouts(self) -> Iterator[Layout]:
        """Yield the layouts of the messages of clouds; none for depth images, poses and files."""
        for at in self._selected:
            try:
                found = self._clouds.layout(at)
            except BadMessage:
                continue
            if found is not None:
                yield found

    def info(self) -> LogInfo:
        """Return the description of the source that ``avsreplay info`` prints."""
        topics = tuple(self._clouds.topics())
        starts = [t.first_ns for t in topics if t.first_ns is not None] or list(self._clouds.log_ns)
        ends = [t.last_ns for t in topics if t.last_ns is not None] or list(self._clouds.log_ns)
        start, surface = min(starts, default=None), self.header.surface
        origin = start or 0
        labels = ((lab.kind, lab.start_ns, lab.end_ns, lab.harmful) for lab in self.header.labels)
        return LogInfo(
            path=str(self.path),
            kind=self._clouds.kind,
            bytes=sum(p.stat().st_size for p in self._files),
            topics=topics,
            start_ns=start,
            end_ns=max(ends, default=None),
            cloud_topic=self._clouds.topic,
            scans=len(self._placed),
            profile=self._extra.get("profile", ""),
            library=self._extra.get("library", ""),
            chunks=self._extra.get("chunks", ""),
            model=None if surface is None else surface.name,
            model_vertices=0 if surface is None else len(surface.vertices),
            model_faces=0 if surface is None else len(surface.faces),
            model_extent_m=None if surface is None else surface.extent,
            scenario=bool(self.header.scenario),
            seed=self.header.seed,
            truth=self._ground_truth.truth is not None,
            faults=tuple((k, (a - origin) * 1e-9, (b - origin) * 1e-9, h) for k, a, b, h in labels),
            clock=self._clock,
            losses=tuple(self.losses),
            notes=dict(self.header.notes),
        )

    def close(self) -> None:
        """Close the files."""
        self._clouds.close()

    @cached_property
    def _selected(self) -> list[int]:
        """Return the positions of the selected scans: the window first, then every n-th, then
        at most ``n_scans``.
        """
        if not self._placed:
            return []
        (start, end), first = self.options.window_s, self._placed[0].t_ns
        inside = [i for i, p in enumerate(self._placed) if start <= (p.t_ns - first) * 1e-9 < end]
        return inside[:: self.options.every][: self.options.n_scans]

    def _scan(self, seq: int, place: int) -> Scan:
        placed = self._placed[place]
        try:
            cloud = self._taken(self._canonical(place), placed.t_ns)
        except BadMessage as error:
            self.damaged[seq] = shown(error)
            if self.options.strict:
                refuse_losses(self)
            return self._finish(seq, place, None, self.damaged[seq])
        return self._finish(seq, place, cloud, placed.note)

    def _canonical(self, place: int) -> Cloud:
        """Return one cloud in metres, with its returns and their times only.

        Raises BadMessage if it cannot be decoded.
        """
        raw = self._clouds.load(place)
        trusted = self._placed[place].note is None
        return canonical(raw, self.meaning, self._stamp(place) if trusted else 0)

    def _stamp(self, place: int) -> int:
        """Return the stamp of a cloud, or its time of reception if it has none [ns]."""
        return self._clouds.header_ns[place] or self._clouds.log_ns[place]

    def _finish(self, seq: int, place: int, cloud: Cloud | None, note: str | None) -> Scan:
        placed, log_ns = self._placed[place], self._clouds.log_ns[place]
        return Scan(
            seq=seq,
            t_ns=placed.t_ns,
            points=np.zeros((0, 3), np.float32) if cloud is None else cloud.points,
            status=_status(cloud, placed),
            times_s=None if cloud is None else cloud.times_s,
            dropped_points=0 if cloud is None else cloud.dropped,
            note=note,
            log_ns=log_ns,
            frame="" if cloud is None else cloud.frame,
            pose=None if cloud is None else cloud.pose,
            intensities=None if cloud is None else cloud.intensities,
            places=None if cloud is None else cloud.places,
            sensor=None
            if cloud is None or cloud.pose
            else self._place_of_sensor(placed.t_ns, cloud.frame),
        )

    def _body_at(self, t_ns: int) -> State | None:
        constants, track = self.header.truth, self._ground_truth.body
        return None if track is None or constants is None else track.body(t_ns, constants)

    def _fault(self, log_ns: int) -> str | None:
        """Return the kind of the fault active at ``log_ns``; if there are several, the one
        that began last.
        """
        inside = [label for label in self.header.labels if label.start_ns <= log_ns < label.end_ns]
        return max(inside, key=lambda label: label.start_ns).kind if inside else None

    def _taken(self, cloud: Cloud, t_ns: int) -> Cloud:
        """Select points and transform them to the fixed frame.

        Raises BadMessage if the sensor's pose is unknown.
        """
        if cloud.pose is not None:
            return replace(cloud, pose=self._measured(cloud.pose, t_ns, cloud.frame))
        cloud = selected(cloud, self.options)
        if self._ground_truth.sensor is None:
            return cloud
        if not self.header.sensor_at_stamp:
            cloud = at_stamp(cloud, lambda after_ns: self._sensor(t_ns + after_ns, cloud.frame))
        return replace(cloud, points=self._sensor(t_ns, cloud.frame).apply(cloud.points))

    def _place_of_sensor(self, t_ns: int, frame: str) -> Pose | None:
        """Return the pose of the sensor in {A}; None if that is the frame of the sensor."""
        if self._ground_truth.sensor is None:
            return None if self.options.sensor_m is None else self._sensor_at
        return self._sensor(t_ns, frame) @ self._sensor_at

    @cached_property
    def _sensor_at(self) -> Pose:
        """Return the pose of the sensor in the frame of the clouds."""
        at = self.options.sensor_m
        return Pose.identity() if at is None else Pose(geometry.IDENTITY_QUAT, np.array(at))

    def _sensor(self, t_ns: int, frame: str) -> Pose:
        """Return the pose of the sensor in the fixed frame. Raises BadMessage if it is unknown."""
        lookup = self._ground_truth.sensor
        pose = Pose.identity() if lookup is None else lookup(t_ns, frame)
        if pose is None and self._apart((self.options.fixed_frame or "").lstrip("/"), frame):
            fixed = self.options.fixed_frame
            raise BadMessage(f"no transform connects '{shown(frame)}' to '{shown(fixed)}'")
        if pose is None:
            raise BadMessage(UNKNOWN_SENSOR)
        return pose

    def _measured(self, found: MeasuredPose, t_ns: int, frame: str) -> MeasuredPose:
        """Return a measured pose of the grasp point in the fixed frame with its covariance or that
        of the settings.
        """
        options, C = self.options, found.covariance
        offset = np.zeros(3) if options.grasp is None else np.array(options.grasp)
        if C is not None and options.grasp is not None:
            C = geometry.covariance_about(C, offset)
        if options.pose_sigma is not None:
            sigma = math.radians(options.pose_sigma[1]), 1e-3 * options.pose_sigma[0]
            C = np.diag(np.repeat(sigma, 3) ** 2)
        T_ac = self._sensor(t_ns, frame) @ found.T_ac @ Pose(geometry.IDENTITY_QUAT, offset)
        return MeasuredPose(T_ac, C)


def _state(path: Path) -> tuple[int, int, int] | None:
    """What differs after a change of a file; None if it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _status(cloud: Cloud | None, placed: Placed) -> ScanStatus:
    if cloud is None:
        return ScanStatus.DAMAGED
    if not len(cloud.points) and cloud.pose is None:
        return ScanStatus.EMPTY
    return ScanStatus.CLOCK if placed.note else ScanStatus.OK


def refuse_losses(source: Source) -> None:
    """Raise UnreadableInput if any part, or a scan that was read, was lost (``--strict``)."""
    if text := lost_text(source.losses, source.damaged, len(source)):
        raise UnreadableInput(
            text, where=shown(source.path), hint="leave out --strict to use the intact part"
        )
