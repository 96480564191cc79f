"""Parts that plug in own their parameters: any installed class, without a change of the core."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from avsreplay import parts, settings
from avsreplay.config import RunConfig, load_config
from avsreplay.errors import UsageError
from avsreplay.parts import BACKENDS, Parts
from avsreplay.register.backend import Target, create_backend, load_backend
from avsreplay.register.contract import Bench
from avsreplay.register.params import RegisterParams
from avsreplay.register.visibility import Visibility
from avsreplay.report.compare import changed_settings
from avsreplay.settings import Settings, Tables, setting
from avsreplay.toml_document import parse, to_toml

EXAMPLE = Path(__file__).parent.parent / "docs" / "examples" / "own_backend"


@pytest.fixture(autouse=True)
def own(tmp_path, monkeypatch):
    """The back end of the tutorial, installed as its package would be."""
    info = tmp_path / "own_backend-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-backend\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(
        "[avsreplay.backends]\nown = own_backend:OwnBackend\nlost = no_such_module:Lost\n"
        "text = os:sep\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(EXAMPLE))
    parts.installed.cache_clear()
    yield
    parts.installed.cache_clear()
    sys.modules.pop("own_backend", None)


def config(*assignments):
    return load_config(None, {}, assignments)


@pytest.mark.parametrize("key", ["register.own.tighten", "register.kiss.voxel_m"])
def test_a_parameter_of_a_part_is_set_listed_and_saved(key):
    found = config(f"{key}=2.5")
    assert settings.value_of(found, key) == 2.5
    assert key in [entry.key for entry in settings.entries(RunConfig)]
    _, name, leaf = key.split(".")
    assert settings.dump(found)["register"][name][leaf] == 2.5
    assert any(line.startswith(f"{key} = 2.5 (default") for line in changed_settings(found))
    again = load_config(None, parse(to_toml(found), "printed").table, ())
    assert settings.value_of(again, key) == 2.5


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("register.own.tightn=2", "did you mean 'register.own.tighten'"),
        ("register.own.tighten=0.5", "register.own.tighten is 0.5, must be above 1"),
        ("register.own.tighten=wide", "'register.own.tighten' must be a number"),
        ("register.own=3", "'register.own' must be a table"),
        ("register.reference.voxel_m=1", "unknown key 'register.reference.voxel_m'"),
        ("register.lost.voxel_m=1", "unknown key 'register.lost'"),
    ],
)
def test_a_wrong_parameter_of_a_part_is_one_line(assignment, words):
    with pytest.raises(UsageError) as caught:
        config(assignment)
    assert words in str(caught.value)
    assert f"--set {assignment}" in str(caught.value)


def test_the_back_end_receives_its_parameters():
    """With a wide rejection distance, points beside the target draw the pose away from it."""
    bench = Bench("own")
    scan = bench.scan.copy()
    scan[::5, 0] += 0.1 * bench.surface.extent

    def off(**values):
        made = config(*(f"register.own.{k}={v}" for k, v in values.items())).register
        params = RegisterParams(backend="own", own=made.own)
        limits = made.limits(bench.surface.extent)
        visibility = Visibility(bench.surface)
        target = Target(bench.surface, bench.registrar.index, limits, visibility)
        backend = create_backend(params, load_backend("own"), target)
        return bench.gap(bench.T_ac, backend.align(scan, bench.T_ac.inverse()).T_ca.inverse())[1]

    assert off() == off(tighten=3.0)
    assert off(tighten=1.5) < 0.5 * off(tighten=1e9)


def test_the_parameters_in_force_are_those_given_or_the_defaults():
    params = RegisterParams(backend="own").with_own()
    assert settings.dump(params)["own"] == {"tighten": 3.0}
    given = config("register.own.tighten=4", "register.kiss.voxel_m=0.1").register
    in_force = settings.dump(RegisterParams(backend="own", own=given.own).with_own())
    assert in_force["own"] == {"tighten": 4.0}
    assert in_force["kiss"]["voxel_m"] == 0.1


def test_a_class_that_is_no_back_end_is_refused():
    with pytest.raises(UsageError, match="does not derive from Backend"):
        load_backend("text")


@pytest.mark.parametrize("group", ["avsreplay.backends"])
def test_every_built_in_part_is_described(group):
    for name in Parts(group, "part").names():
        if name in ("lost", "text"):
            continue
        part = BACKENDS.load(name)
        assert part.name == name
        assert part.about
        assert issubclass(part.parameters, Settings)


def test_names_are_sorted_and_one_of_two_equal_names_is_taken(tmp_path):
    info = tmp_path / "other-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[avsreplay.backends]\nown = another:Other\n")
    parts.installed.cache_clear()
    names = BACKENDS.names()
    assert list(names) == sorted(set(names))
    values = {e.value for e in metadata.entry_points(group="avsreplay.backends") if e.name == "own"}
    assert values == {"another:Other", "own_backend:OwnBackend"}
    with pytest.raises(ImportError):
        BACKENDS.load("own")


@dataclass(frozen=True)
class Wheel(Settings):
    radius_m: float | None = setting(None, "The radius.", unit="m", above=0.0, of_extent=0.1)


class Cart:
    name = "cart"
    about = "a part of the test"
    parameters = Wheel


@dataclass(frozen=True)
class Vehicle(Settings):
    speed_mps: float = setting(1.0, "The speed.", unit="m/s")
    own: Tables = setting(Tables, "Tables of parts.", parts=Parts("none", "part", built_in=[Cart]))


def test_any_settings_class_can_have_tables_of_parts():
    from avsreplay.toml_document import build

    made = build(Vehicle, parse("speed_mps = 2.0\n[cart]\nradius_m = 0.5\n", "v.toml"))
    assert made.own.of("cart", Wheel).radius_m == 0.5
    assert Vehicle().own.of("cart", Wheel) == Wheel()
    assert [e.key for e in settings.entries(Vehicle)] == ["speed_mps", "cart.radius_m"]
    assert Tables((("cart", Wheel(0.5)),)) == made.own.with_part("cart", Wheel) == made.own
    assert np.isclose(made.own.of("cart", Wheel).resolved(3.0).radius_m, 0.5)
    with pytest.raises(UsageError, match=r"v.toml:2: cart.radius_m is -1.0"):
        build(Vehicle, parse("[cart]\nradius_m = -1.0\n", "v.toml"))
