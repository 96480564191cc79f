"""The suite file: scenarios with their descriptions, and the data that real ones need.

A simulated scenario is a scenario file (``simulate.scenario``) whose motion is drawn from a seed:
the fixture faces the camera within TILT_DEG, and the axis of rotation is within CONE_DEG of the
fixture's axis, so that a capture is possible.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import tomli_w

from avsreplay import geometry, toml_document
from avsreplay.errors import UsageError, value_class
from avsreplay.settings import Settings, setting
from avsreplay.simulate.target import Shape

CAPTURE_1 = "capture-1"
GROUPS = ("clean", "blocked", "wrong", "moved", "hard", "real")
TILT_DEG = 35.0  # largest angle between the fixture's axis and the line of sight at the begin
CONE_DEG = (20.0, 60.0)  # angles between the axis of rotation and that of the fixture
OFF_CENTRE = 0.02  # 1 sigma of the first position off the line of sight, over the distance
CREEP = 5e-4  # 1 sigma of the velocity over the distance [1/s]
DIGITS = 6  # decimals of what is drawn, so that every machine has the same text
FACING = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))  # q_ac at which +x of {C} points to the camera


@dataclass(frozen=True, slots=True)
class SuiteScenario(Settings):
    """One table [[scenario]] of a suite."""

    name: str = setting(doc="Name of the scenario.")
    group: str = setting(doc="Its group.")
    about: str = setting(doc="What happens in it, a paragraph.")
    data: str = setting("", "Data that it replays; empty for a simulated one.")
    body: str = setting("", "Mesh of the target in the suite; empty for a built-in shape.")
    shape: Shape = setting(Shape.SATELLITE, "Built-in shape of the target.")
    model: str = setting("", "Mesh that is replayed with; empty for that of the target.")
    model_scale: float = setting(1.0, "Size of the model over that of the target.", above=0.0)
    distance_m: float = setting(5.0, "Distance of the mass centre.", unit="m", above=0.0)
    speed_radps: float = setting(0.1, "Angular rate.", unit="rad/s", above=0.0)
    simulate: Any = setting(dict, "Tables of the scenario file.")

    def check(self) -> None:
        """Raise ValueError where the group is unknown."""
        if self.group not in GROUPS:
            raise ValueError(f"group '{self.group}' is none of: {', '.join(GROUPS)}")


@dataclass(frozen=True, slots=True)
class SuiteData(Settings):
    """One table [[data]]: recordings of others."""

    name: str = setting(doc="Name of its folder.")
    fetch: str = setting(doc="Where it is found, in words.")
    sha256: str = setting("", "Digest of the files that are used.")


@dataclass(frozen=True, slots=True)
class SuiteParams(Settings):
    """A suite file."""

    name: str = setting(doc="Name and version of the suite.")
    seed: int = setting(doc="Seed of everything that is drawn.", low=0, below=2**63)
    repeats: int = setting(1, "Motions of every simulated scenario.", low=1)
    quick: tuple[str, ...] = setting((), "Scenarios of the quick part.")
    simulate: Any = setting(dict, "Tables of every scenario file.")
    run: Any = setting(dict, "Settings of the replay of simulated scenarios.")
    scenario: tuple[SuiteScenario, ...] = setting((), "The scenarios.")
    data: tuple[SuiteData, ...] = setting((), "Data that real scenarios need.")


@value_class(eq=True)
class Suite:
    """A suite as read.

    Attributes:
        params: its parameters.
        sha256: hash of the file and of all bodies.
        bodies: folder of the meshes.
    """

    params: SuiteParams
    sha256: str
    bodies: Traversable

    def select(self, only: Sequence[str]) -> tuple[SuiteScenario, ...]:
        """Return the scenarios with these names or of these groups, in the order of the suite.

        Args:
            only: names and groups; all scenarios where there is none.

        Raises:
            UsageError: a name is neither.
        """
        every = self.params.scenario
        known = {*(each.name for each in every), *(each.group for each in every)}
        wrong = next((name for name in only if name not in known), None)
        if wrong is not None:
            raise UsageError(
                f"the suite has no scenario or group '{wrong}'",
                where="--only",
                hint="'avsreplay benchmark --list' prints them",
            )
        return tuple(each for each in every if not only or {each.name, each.group} & set(only))

    def data_of(self, scenario: SuiteScenario) -> SuiteData:
        """Return the data of a real scenario."""
        return next(each for each in self.params.data if each.name == scenario.data)

    def scenario_text(self, scenario: SuiteScenario, seed: int, repeat: int) -> str:
        """Return the scenario file of a simulated scenario.

        Args:
            scenario: the scenario.
            seed: that of the suite, or a fresh one.
            repeat: number of the motion, from 0.
        """
        key = (zlib.crc32(scenario.name.encode()), repeat)
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
        target = {"model": f"{scenario.body}.obj"} if scenario.body else {}
        own = {
            "name": scenario.name,
            "seed": int(rng.integers(2**62)),
            "target": target or {"shape": scenario.shape.value},
            "motion": drawn_motion(scenario.distance_m, scenario.speed_radps, rng),
            "run": self.params.run,
        }
        return tomli_w.dumps(merged(merged(self.params.simulate, own), scenario.simulate))


def drawn_motion(
    distance_m: float, speed_radps: float, rng: np.random.Generator
) -> dict[str, list[float]]:
    """Return the table [motion] of a target that can be captured.

    Args:
        distance_m: of its mass centre.
        speed_radps: its angular rate.
        rng: generator of the draws.
    """
    roll, towards = rng.uniform(0.0, 2.0 * math.pi, 2)
    tilt = rng.uniform(0.0, 1.0)
    tilted = math.radians(TILT_DEG) * tilt * np.array([0.0, math.cos(towards), math.sin(towards)])
    q = geometry.multiply(np.array(FACING), geometry.exp(tilted))
    q = geometry.multiply(q, geometry.exp(np.array([roll, 0.0, 0.0])))
    cone, about = math.radians(rng.uniform(*CONE_DEG)), rng.uniform(0.0, 2.0 * math.pi)
    side = float(rng.choice([-1.0, 1.0]))
    axis = [
        side * math.cos(cone),
        math.sin(cone) * math.cos(about),
        math.sin(cone) * math.sin(about),
    ]
    centre = np.array([0.0, 0.0, distance_m]) + OFF_CENTRE * distance_m * rng.standard_normal(3)
    velocity = CREEP * distance_m * rng.standard_normal(3)
    return {
        "attitude_xyzw": _rounded(q),
        "rate_radps": _rounded(speed_radps * np.array(axis)),
        "position_m": _rounded(centre),
        "velocity_mps": _rounded(velocity),
    }


def _rounded(values: Any) -> list[float]:
    return [round(float(x), DIGITS) + 0.0 for x in values]


def merged(base: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of both; values and lists of the second take precedence.

    Args:
        base: tables.
        other: further tables.
    """
    out = dict(base)
    for key, value in other.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = merged(out[key], value) if both else value
    return out


def suites() -> tuple[str, ...]:
    """Return the names of the suites of this version."""
    files = resources.files("avsreplay.benchmark").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


def load_suite(name: str = CAPTURE_1) -> Suite:
    """Return a suite of this version.

    Args:
        name: its name.

    Raises:
        UsageError: there is no suite of this name.
    """
    if name not in suites():
        raise UsageError(
            f"no suite is called '{name}'", where="--suite", hint=f"one of: {', '.join(suites())}"
        )
    home = resources.files("avsreplay.benchmark")
    text = home.joinpath(f"{name}.toml").read_text(encoding="utf-8")
    bodies = home.joinpath("bodies")
    meshes = {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in bodies.iterdir()}
    digest = hashlib.sha256(json.dumps([text, sorted(meshes.items())]).encode()).hexdigest()
    params = toml_document.build(SuiteParams, toml_document.parse(text, f"suite {name}"))
    return Suite(params, digest, bodies)
