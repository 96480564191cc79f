"""Options that several commands share."""

from __future__ import annotations

import dataclasses

import click
import pytest
from click.testing import CliRunner

from avsreplay.cli.options import read_options, source_options
from avsreplay.errors import UsageError
from avsreplay.log import SourceOptions


@pytest.fixture
def parse():
    seen: dict[str, object] = {}

    @click.command()
    @source_options
    def command(**flags: object) -> None:
        seen.update(flags)

    def run(*args: str) -> tuple[int, dict[str, object]]:
        return CliRunner().invoke(command, list(args)).exit_code, seen

    return run


def test_each_option_is_a_field_of_source_options_and_off_by_default(parse):
    code, seen = parse()
    assert code == 0
    assert set(seen) <= {f.name for f in dataclasses.fields(SourceOptions)}
    assert not any(seen.values())
    assert read_options(seen) == SourceOptions()


def test_values_reach_the_source(parse):
    args = ["--crop-box", "-1,-2,-3,1,2,3", "--crop-range", "0.5,9", "--fixed-frame", "map", "--truth-gap", "0.3"]
    code, seen = parse(*args, "--clock", "log")
    options = read_options(seen)
    assert code == 0
    assert options.crop_box == (-1.0, -2.0, -3.0, 1.0, 2.0, 3.0)
    assert (options.truth_gap_s, options.fixed_frame, options.clock.value) == (0.3, "map", "log")


def test_a_wrong_count_of_numbers_is_a_usage_error(parse):
    assert parse("--crop-range", "1,2,3")[0] == 2


def test_a_value_the_reader_refuses_is_one_line():
    with pytest.raises(UsageError, match="crop_range"):
        read_options({"crop_range": (2.0, 1.0)})
