"""Reading of logs, bags and folders of scans; writing of logs as MCAP."""

from avsreplay.log.growing import GrowingLog
from avsreplay.log.header import parse_surface, read_surface
from avsreplay.log.opening import open_source
from avsreplay.log.options import (
    ClockChoice,
    ClockSummary,
    LogInfo,
    Loss,
    SourceOptions,
    TopicInfo,
)
from avsreplay.log.source import Source
from avsreplay.log.writer import LogWriter

__all__ = [
    "ClockChoice",
    "ClockSummary",
    "GrowingLog",
    "LogInfo",
    "LogWriter",
    "Loss",
    "Source",
    "SourceOptions",
    "TopicInfo",
    "open_source",
    "parse_surface",
    "read_surface",
]
