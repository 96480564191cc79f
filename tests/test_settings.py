"""The one door from TOML to parameter classes."""

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import pytest

from avsreplay import settings
from avsreplay.errors import UnreadableInput, UsageError


class Policy(Enum):
    ANY = "any"
    ALL = "all"


@dataclass(frozen=True)
class Inner:
    gain: float = 1.0
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    policy: Policy = Policy.ANY
    limit: float | None = None

    def __post_init__(self):
        if self.gain <= 0.0:
            raise ValueError(f"gain must be above 0, not {self.gain}")


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=Inner)
    items: tuple[Inner, ...] = ()
    count: int = 3
    on: bool = True


TEXT = """
name = "x"
count = 4

[inner]
gain = 2          # whole numbers are numbers
axis = [1, 0, 0]
policy = "all"

[[items]]
gain = 0.5

[[items]]
limit = 3
"""


def build(text):
    return settings.build(Outer, settings.parse(text, "s.toml"))


def test_builds_nested_tables_and_arrays_of_tables():
    outer = build(TEXT)
    assert outer.inner == Inner(2.0, (1.0, 0.0, 0.0), Policy.ALL)
    assert outer.items == (Inner(0.5), Inner(limit=3.0))
    assert isinstance(outer.inner.gain, float)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (TEXT.replace("gain = 2 ", "gian = 2 "), 6, "did you mean 'gain'"),
        (TEXT.replace("limit = 3", "limitt = 3"), 14, "items.1.limitt"),
        (TEXT.replace("count = 4", 'count = "4"'), 3, "a whole number"),
        (TEXT.replace("count = 4", "count = 4.5"), 3, "a whole number"),
        (TEXT.replace("count = 4", "count = true"), 3, "a whole number"),
        (TEXT.replace("[1, 0, 0]", "[1, 0]"), 7, "3 values"),
        (TEXT.replace('"all"', '"most"'), 8, "one of: any, all"),
        (TEXT.replace("gain = 0.5", "gain = -1"), 10, "above 0"),
    ],
)
def test_a_wrong_key_or_value_names_file_and_line(text, line, what):
    with pytest.raises(UsageError) as caught:
        build(text)
    assert str(caught.value).startswith(f"s.toml:{line}: ")
    assert what in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_key_is_named():
    with pytest.raises(UsageError, match="missing key 'name'"):
        build("count = 1")


def test_a_table_where_a_value_belongs_is_named():
    with pytest.raises(UsageError, match=r"'inner' must be a table"):
        build('name = "x"\ninner = 3')


@pytest.mark.parametrize("text", ["a = ", "[a\n", "a" + "[" * 5000])
def test_text_that_is_not_toml_is_one_line(text):
    with pytest.raises(UsageError, match="not valid TOML") as caught:
        settings.parse(text, "s.toml")
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(UnreadableInput, match="no such file"):
        settings.load(tmp_path / "none.toml")
    binary = tmp_path / "b.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnreadableInput, match="not UTF-8"):
        settings.load(binary)
    bomb = tmp_path / "big.toml"
    bomb.write_bytes(b"#" * (settings.MAX_BYTES + 1))
    with pytest.raises(UnreadableInput, match="larger than"):
        settings.load(bomb)
    with pytest.raises(UnreadableInput):
        settings.load(tmp_path)


def test_override_beats_the_file_and_builds_the_same_object():
    document = settings.override(settings.parse(TEXT, "s.toml"), ["inner.gain=7", "name=plain", "inner.policy=any"])
    outer = settings.build(Outer, document)
    assert (outer.inner.gain, outer.name, outer.inner.policy) == (7.0, "plain", Policy.ANY)
    with pytest.raises(UsageError, match=r"a\.b=value"):
        settings.override(document, ["inner.gain"])
    with pytest.raises(UsageError, match="not a table"):
        settings.override(document, ["name.deep=1"])


def test_dump_is_plain_and_builds_back():
    outer = build(TEXT)
    plain = settings.dump(outer)
    assert plain["inner"]["policy"] == "all"
    document = settings.Document("dump", {k: v for k, v in plain.items() if v is not None})
    assert settings.build(Outer, document) == outer
    assert settings.dump(Path("a/b")) == "a/b"
