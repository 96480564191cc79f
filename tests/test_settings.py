"""Settings declared once, and TOML documents read into them."""

import importlib
import math
import pkgutil
import re
import typing
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import avsreplay
from avsreplay import settings, toml_document
from avsreplay.config import RunConfig, load_config
from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.estimate.batch import FitParams
from avsreplay.log import SourceOptions
from avsreplay.plan.robot import Limits
from avsreplay.register.surface_index import IcpParams
from avsreplay.report.gate import GateRules
from avsreplay.settings import Settings, setting
from avsreplay.simulate.scenario import ScenarioParams
from avsreplay.sweep.campaign import Campaign


class Policy(Enum):
    ANY = "any"
    ALL = "all"


@dataclass(frozen=True)
class Inner(Settings):
    gain: float = setting(1.0, "The gain.", above=0.0)
    axis: tuple[float, float, float] = setting((0.0, 0.0, 1.0), "The axis.", low=-1.0, high=1.0)
    policy: Policy = setting(Policy.ANY, "The policy.")
    limit: float | None = setting(None, "The limit.", unit="m", above=0.0, of_extent=0.25)


@dataclass(frozen=True)
class Outer(Settings):
    name: str = setting(doc="The name.")
    inner: Inner = setting(Inner, "The inner table.")
    items: tuple[Inner, ...] = setting((), "Several of them.")
    count: int = setting(3, "How many.", low=0, below=10)
    on: bool = setting(True, "Whether.")
    weight: float | None = setting(None, "The weight.", low=0.0, high=1.0, unset="none")


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
    return toml_document.build(Outer, toml_document.parse(text, "s.toml"))


def test_builds_nested_tables_and_arrays_of_tables():
    outer = build(TEXT)
    assert outer.inner == Inner(2.0, (1.0, 0.0, 0.0), Policy.ALL)
    assert outer.items == (Inner(0.5), Inner(limit=3.0))
    assert isinstance(outer.inner.gain, float)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (TEXT.replace("gain = 2 ", "gian = 2 "), 6, "did you mean 'inner.gain'"),
        (TEXT.replace("limit = 3", "limitt = 3"), 14, "items.1.limitt"),
        (TEXT.replace("count = 4", 'count = "4"'), 3, "a whole number"),
        (TEXT.replace("count = 4", "count = 4.5"), 3, "a whole number"),
        (TEXT.replace("count = 4", "count = true"), 3, "a whole number"),
        (TEXT.replace("[1, 0, 0]", "[1, 0]"), 7, "3 values"),
        (TEXT.replace('"all"', '"most"'), 8, "one of: any, all"),
        (TEXT.replace("gain = 0.5", "gain = -1"), 11, "above 0"),
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
        toml_document.parse(text, "s.toml")
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(UnreadableInput, match="no such file"):
        toml_document.load(tmp_path / "none.toml")
    binary = tmp_path / "b.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UnreadableInput, match="not UTF-8"):
        toml_document.load(binary)
    bomb = tmp_path / "big.toml"
    bomb.write_bytes(b"#" * (toml_document.MAX_TOML_BYTES + 1))
    with pytest.raises(UnreadableInput, match="larger than"):
        toml_document.load(bomb)
    with pytest.raises(UnreadableInput):
        toml_document.load(tmp_path)


def test_override_beats_the_file_and_builds_the_same_object():
    document = toml_document.override(
        toml_document.parse(TEXT, "s.toml"), ["inner.gain=7", "name=plain", "inner.policy=any"]
    )
    outer = toml_document.build(Outer, document)
    assert (outer.inner.gain, outer.name, outer.inner.policy) == (7.0, "plain", Policy.ANY)
    with pytest.raises(UsageError, match=r"a\.b=value"):
        toml_document.override(document, ["inner.gain"])
    with pytest.raises(UsageError, match="not a table"):
        toml_document.override(document, ["name.deep=1"])


def test_dump_is_plain_and_builds_back():
    outer = build(TEXT)
    plain = settings.dump(outer)
    assert plain["inner"]["policy"] == "all"
    document = toml_document.Document("dump", {k: v for k, v in plain.items() if v is not None})
    assert toml_document.build(Outer, document) == outer
    assert settings.dump(Path("a/b")) == "a/b"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"count": 10}, "count is 10, must be at least 0 and below 10"),
        ({"count": -1}, "count is -1"),
        ({"weight": 1.5}, "weight is 1.5, must be at least 0 and at most 1"),
        ({"weight": math.nan}, "weight is nan"),
        ({"inner": {"gain": math.inf}}, "gain is inf, must be above 0"),
        ({"inner": {"gain": 1e308}}, r"gain is 1e\+308, must be at most 1e\+100 in magnitude"),
        ({"inner": {"gain": 0.0}}, "gain is 0.0"),
        ({"inner": {"limit": 0.0}}, r"limit is 0.0, must be above 0 \[m\]"),
        (
            {"inner": {"axis": (0.0, 2.0, 0.0)}},
            r"axis is \[0.0, 2.0, 0.0\], each value must be at least -1",
        ),
    ],
)
def test_a_value_outside_its_declared_range_is_refused(change, what):
    cls, values = (
        (Inner, change["inner"]) if "inner" in change else (Outer, {"name": "x", **change})
    )
    with pytest.raises(ValueError, match=what):
        cls(**values)


@given(st.floats(allow_nan=True), st.sampled_from(["count", "weight", "gain"]))
def test_a_float_is_accepted_exactly_within_the_bounds(value, name):
    allowed = {"count": 0 <= value < 10, "weight": 0 <= value <= 1, "gain": 0 < value <= 1e100}[
        name
    ]
    try:
        Inner(gain=value) if name == "gain" else Outer(name="x", **{name: value})
        accepted = True
    except ValueError:
        accepted = False
    assert accepted == allowed


def test_lengths_that_scale_with_the_target_are_filled_in_and_given_values_are_kept():
    assert Inner().resolved(8.0).limit == 2.0
    assert Inner(limit=3.0).resolved(8.0).limit == 3.0
    for extent in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="extent_m"):
            Inner().resolved(extent)


@pytest.mark.parametrize(
    ("assignment", "hint"),
    [
        ("inner.polcy=all", "did you mean 'inner.policy'"),
        ("gain=2", "did you mean 'inner.gain'"),
        ("iner.gain=2", "did you mean 'inner.gain'"),
        ("outer.gain=2", "did you mean 'inner.gain'"),
        ("inner.cuont=2", "did you mean 'count'"),
    ],
)
def test_a_misspelt_key_is_answered_with_the_nearest_of_the_whole_tree(assignment, hint):
    with pytest.raises(UsageError) as caught:
        toml_document.build(
            Outer, toml_document.override(toml_document.parse(TEXT, "s.toml"), [assignment])
        )
    assert hint in str(caught.value)
    assert str(caught.value).startswith(f"--set {assignment}: ")


def _ends(key):
    return [len(key), *(n for n, letter in enumerate(key) if letter == ".")]


def test_a_hint_names_only_keys_that_exist():
    known = {e.key[:end] for e in settings.entries(RunConfig) for end in _ends(e.key)}
    for assignment in ("foo=1", "register.zzz=1", "foo.bar=2"):
        with pytest.raises(UsageError) as caught:
            load_config(None, {}, [assignment])
        hint = caught.value.hint
        table = "register." if assignment.startswith("register.") else ""
        named = re.findall(r"'([\w.]+)'", hint) or [
            f"{table}{k}" for k in hint.partition(": ")[2].split(", ")
        ]
        assert named
        assert set(named) <= known, hint
    with pytest.raises(UsageError) as caught:
        toml_document.override(toml_document.Document("", {}), ["foo"])
    example = re.search(r"--set ([\w.]+)=", caught.value.hint)[1]
    assert example in known


CHANGES = [
    "register.gate_m=0.123",
    "estimator.start=cold",
    "init=auto",
    "plan.robot_position_m=[1, 2.5, -3]",
]


@pytest.mark.parametrize("assignments", [[], CHANGES])
def test_a_written_configuration_reads_back_as_the_same_object(assignments):
    config = load_config(None, {}, assignments)
    text = toml_document.to_toml(config)
    assert toml_document.build(RunConfig, toml_document.parse(text, "c.toml")) == config
    assert max(len(line) for line in text.splitlines()) <= 120
    assert ("# reach_m is not set: 0.15 of the target's extent" in text.splitlines()) == (
        config.register.reach_m is None
    )


PARAMETER_CLASSES = [
    RunConfig,
    ScenarioParams,
    Campaign,
    SourceOptions,
    Limits,
    GateRules,
    FitParams,
    IcpParams,
]


@pytest.mark.parametrize("cls", PARAMETER_CLASSES, ids=lambda c: c.__name__)
def test_every_setting_is_declared_with_its_meaning(cls):
    for entry in settings.entries(cls):
        assert entry.declared.doc.endswith("."), entry.key
        assert not (entry.declared.of_extent and entry.declared.unset), entry.key
        optional = type(None) in typing.get_args(entry.hint)
        assert optional or entry.declared.of_extent is None, entry.key
        suffixes = {
            "_m": "m",
            "_s": "s",
            "_deg": "deg",
            "_rad": "rad",
            "_mps": "m/s",
            "_radps": "rad/s",
            "_hz": "Hz",
        }
        unit = (
            suffixes.get(f"_{entry.key.rpartition('_')[2]}")
            if "_" in entry.key.rpartition(".")[2]
            else None
        )
        assert unit is None or entry.declared.unit == unit, entry.key


@pytest.mark.parametrize("cls", PARAMETER_CLASSES, ids=lambda c: c.__name__)
def test_every_setting_is_read_by_the_program(cls):
    package = Path(avsreplay.__file__).parent
    code = "\n".join(path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py")))
    read = set(re.findall(r"\.(\w+)", code)) | set(re.findall(r"[\"'](\w+)[\"']", code))
    assert not [
        entry.key for entry in settings.entries(cls) if entry.key.rpartition(".")[2] not in read
    ]


def test_no_parameter_class_validates_by_hand():
    for module in pkgutil.walk_packages(avsreplay.__path__, "avsreplay."):
        if ".cli." in module.name or "kernel" in module.name or "__main__" in module.name:
            continue
        try:
            members = vars(importlib.import_module(module.name)).values()
        except ImportError:
            continue  # an adapter whose library is not installed
        for cls in members:
            if isinstance(cls, type) and issubclass(cls, Settings) and cls is not Settings:
                assert "__post_init__" not in vars(cls), cls
                assert "resolved" not in vars(cls), cls


def test_the_papers_settings_are_settings() -> None:
    """Every assignment of ``--paper`` is accepted and differs from the default."""
    from avsreplay.config import PAPER, load_config

    plain, paper = load_config(None, {}, ()), load_config(None, {}, PAPER)
    for assignment in PAPER:
        first, second = plain, paper
        for name in assignment.partition("=")[0].split("."):
            first, second = getattr(first, name), getattr(second, name)
        assert first != second, assignment


@pytest.mark.parametrize(
    "assignment",
    [
        "estimator.torque_noise_radps15=1e15",
        "estimator.r0_pos_m=1e15",
        "estimator.start_rate_1s_radps=1e15",
        "estimator.start_vel_1s_mps=1e15",
        "estimator.start_log_inertia_1s=1e3",
        "estimator.start_sigma_1s=2",
        "register.threads=1000000",
    ],
)
def test_values_with_which_no_run_can_be_computed_are_refused(assignment):
    """They had ended in an error of the linear algebra, or had taken minutes."""
    with pytest.raises(UsageError, match="at most"):
        load_config(None, {}, (assignment,))
