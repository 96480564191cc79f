"""A scenario: one TOML file, strict. Each table's parameters stand beside what they set."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from avsreplay import geometry, settings
from avsreplay.errors import UsageError
from avsreplay.geometry import Array
from avsreplay.records import Belief, State
from avsreplay.simulate.faults import FaultParams
from avsreplay.simulate.motion import MotionParams
from avsreplay.simulate.scanner import ScannerParams
from avsreplay.simulate.target import TargetParams

__all__ = ["Scenario", "ScenarioParams", "StartParams", "belief", "load_scenario", "scenario_of"]

MAX_SCANS = 10_000_000
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StartParams:
    """The table [start]: the first belief, as standard deviations each axis and, where wished, the very offsets.

    An offset left out is drawn from its standard deviation with the scenario's seed.
    """

    # 1 sigma of the angular rate, and mean minus truth, in {B}
    rate_std_radps: float = 0.005
    rate_offset_radps: Triple | None = None
    # of sigma_1 and sigma_2
    sigma_std: float = 0.05
    sigma_offset: tuple[float, float] | None = None
    # of the fixture's place in {B}
    varrho_std_m: float = 0.05
    varrho_offset_m: Triple | None = None
    # of mu, as a turn (full angle) about {B}'s axes
    mu_std_deg: float = 1.0
    mu_offset_deg: Triple | None = None
    # of the mass centre in {A}
    position_std_m: float = 0.03
    position_offset_m: Triple | None = None
    # of its velocity in {A}
    velocity_std_mps: float = 0.003
    velocity_offset_mps: Triple | None = None
    # of the attitude of {B}, as a turn (full angle) about its axes
    attitude_std_deg: float = 1.0
    attitude_offset_deg: Triple | None = None

    def __post_init__(self) -> None:
        for name in ("rate_std_radps", "sigma_std", "varrho_std_m", "mu_std_deg", "position_std_m", "velocity_std_mps"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be positive")
        if not 0.0 < self.attitude_std_deg < math.inf:
            raise ValueError(f"attitude_std_deg = {self.attitude_std_deg} must be positive")


@dataclass(frozen=True, slots=True)
class ScenarioParams:
    """The whole file."""

    # what to call it
    name: str = "scenario"
    # of every random draw
    seed: int = 0
    # length of the log
    duration_s: float = 120.0
    # scans a second
    rate_hz: float = 5.0
    target: TargetParams = field(default_factory=TargetParams)
    motion: MotionParams = field(default_factory=MotionParams)
    scanner: ScannerParams = field(default_factory=ScannerParams)
    fault: tuple[FaultParams, ...] = ()
    # the first belief; without the table the log starts cold
    start: StartParams | None = None
    # settings of the replay for this log, handed through untouched
    run: Any = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"seed = {self.seed} must lie between 0 and 2^63")
        for name in ("duration_s", "rate_hz"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be positive")
        if not 1.0 <= self.duration_s * self.rate_hz <= MAX_SCANS:
            raise ValueError(f"{self.duration_s} s at {self.rate_hz} Hz is not between 1 and {MAX_SCANS} scans")
        if self.scanner.scan_s * self.rate_hz > 1.0 + 1e-9:
            raise ValueError(f"scan_s = {self.scanner.scan_s} is longer than the time between scans")


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario as read.

    Attributes:
        params: what it says, the seed in force included.  text: its TOML text, for the log.
        folder: where its relative file names start.
    """

    params: ScenarioParams
    text: str
    folder: Path | None = None

    @property
    def model(self) -> Path | None:
        """The model it names, None for a built-in shape."""
        if not self.params.target.model:
            return None
        return (self.folder or Path()) / self.params.target.model


def load_scenario(path: Path | None = None, seed: int | None = None) -> Scenario:
    """The scenario in ``path``, or the built-in one; ``seed`` overrides its own.

    Raises UnreadableInput or UsageError with file and line.
    """
    if path is None:
        text = resources.files("avsreplay.simulate").joinpath("builtin.toml").read_text(encoding="utf-8")
        return scenario_of(settings.parse(text, "built-in scenario"), seed)
    return scenario_of(settings.load(path), seed, Path(path).parent)


def scenario_of(document: settings.Document, seed: int | None = None, folder: Path | None = None) -> Scenario:
    """The scenario of a parsed document."""
    params = settings.build(ScenarioParams, document)
    if not isinstance(params.run, dict):
        raise UsageError("'run' must be a table", where=document.where(("run",)), hint="write it as [run]")
    if seed is not None:
        params = replace(params, seed=seed)
    return Scenario(params, document.text, folder)


def belief(start: StartParams, truth: State, t_ns: int, rng: np.random.Generator) -> Belief:
    """The first belief about ``truth``: offsets given or drawn, and the covariance of the 20 error states."""
    rate = _offset(start.rate_offset_radps, start.rate_std_radps, 3, rng)
    sigma = _offset(start.sigma_offset, start.sigma_std, 2, rng)
    varrho = _offset(start.varrho_offset_m, start.varrho_std_m, 3, rng)
    mu = np.radians(_offset(start.mu_offset_deg, start.mu_std_deg, 3, rng))
    position = _offset(start.position_offset_m, start.position_std_m, 3, rng)
    velocity = _offset(start.velocity_offset_mps, start.velocity_std_mps, 3, rng)
    attitude = np.radians(_offset(start.attitude_offset_deg, start.attitude_std_deg, 3, rng))
    mean = State(
        q_ab=geometry.normalise(geometry.multiply(truth.q_ab, geometry.exp(attitude))),
        w_b=truth.w_b + rate,
        r_a=truth.r_a + position,
        v_a=truth.v_a + velocity,
        sigma=np.clip(truth.sigma + sigma, -0.99, 0.99),
        c_b=truth.c_b + varrho,
        q_bc=geometry.normalise(geometry.multiply(geometry.exp(mu), truth.q_bc)),
    )
    return Belief(t_ns, mean, np.diag(np.square(_deviations(start))))


def _deviations(start: StartParams) -> Array:
    """(20,) standard deviations in the order of the error states; attitudes as half angles."""
    half = 0.5 * math.radians(1.0)
    blocks = (
        (start.attitude_std_deg * half, 3),
        (start.rate_std_radps, 3),
        (start.position_std_m, 3),
        (start.velocity_std_mps, 3),
        (start.sigma_std, 2),
        (start.varrho_std_m, 3),
        (start.mu_std_deg * half, 3),
    )
    return np.concatenate([np.full(size, value) for value, size in blocks])


def _offset(given: tuple[float, ...] | None, std: float, size: int, rng: np.random.Generator) -> Array:
    drawn = std * rng.standard_normal(size)
    return drawn if given is None else np.array(given, dtype=np.float64)
