"""Flags of the commands that read a recorded source beyond topics and times: frames of a moving sensor, and crops.

``@reading_flags`` adds them to a command; each is named as its field of ``log.SourceOptions`` and None where not given.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from avsreplay.cli.setting_options import source_setting

F = TypeVar("F", bound=Callable[..., Any])


class Numbers(click.ParamType[tuple[float, ...]]):
    """So many numbers, separated by commas."""

    name = "numbers"

    def __init__(self, count: int) -> None:
        self.count = count

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """A tuple of floats; anything else is a usage error."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(word) for word in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(f"'{value}' is not {self.count} numbers separated by commas", param, ctx)
        return numbers


NUMBERS = {"crop_box": Numbers(6), "crop_range": Numbers(2)}
READING_FLAGS = ("truth_frame", "truth_gap_s", "fixed_frame", "sensor_topic", "crop_box", "crop_range")
_OPTIONS = (
    source_setting("--truth-frame"),
    source_setting("--truth-gap", "truth_gap_s", type=float),
    source_setting("--fixed-frame"),
    source_setting("--sensor-topic"),
    source_setting("--crop-box", type=NUMBERS["crop_box"], metavar="X0,Y0,Z0,X1,Y1,Z1"),
    source_setting("--crop-range", type=NUMBERS["crop_range"], metavar="MIN,MAX"),
)


def reading_flags(command: F) -> F:
    """Add the flags to a command's function."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
