"""A scenario: one TOML file with one table for each part of the simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from avsreplay import geometry, toml_document
from avsreplay.errors import UsageError, value_class
from avsreplay.geometry import Array
from avsreplay.records import Belief, State
from avsreplay.settings import Settings, setting
from avsreplay.simulate.faults import MAX_WINDOW_S, InjectedFault
from avsreplay.simulate.motion import MotionParams
from avsreplay.simulate.optics import Material
from avsreplay.simulate.rays import Preset, ScannerParams
from avsreplay.simulate.scene import Appendage, CameraParams, Limb, Plume, SceneObject
from avsreplay.simulate.target import TargetParams

MAX_SCANS = 10_000_000
DRAWN = "drawn from its 1 sigma"
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class StartParams(Settings):
    """The table [start]: the initial belief, as a standard deviation per axis and, if wanted, the
    exact errors.

    An offset (mean minus truth) that is not given is drawn from its standard deviation with the
    scenario's seed.
    """

    rate_std_radps: float = setting(
        0.005, "1 sigma of the angular rate in {B}.", unit="rad/s", above=0.0
    )
    rate_offset_radps: Triple | None = setting(
        None, "Error of the angular rate.", unit="rad/s", unset=DRAWN
    )
    sigma_std: float = setting(0.05, "1 sigma of sigma_1 and sigma_2.", above=0.0, high=1.0)
    sigma_offset: tuple[float, float] | None = setting(
        None,
        "Error of sigma_1 and sigma_2; the initial estimate of both must be between -1 and 1.",
        unset=DRAWN,
    )
    varrho_std_m: float = setting(
        0.05, "1 sigma of the fixture's position in {B}.", unit="m", above=0.0
    )
    varrho_offset_m: Triple | None = setting(
        None, "Error of the fixture's position.", unit="m", unset=DRAWN
    )
    mu_std_deg: float = setting(
        1.0, "1 sigma of mu, as a rotation about the axes of {B}.", unit="deg", above=0.0
    )
    mu_offset_deg: Triple | None = setting(None, "Error of mu.", unit="deg", unset=DRAWN)
    position_std_m: float = setting(0.03, "1 sigma of the mass centre in {A}.", unit="m", above=0.0)
    position_offset_m: Triple | None = setting(
        None, "Error of the mass centre.", unit="m", unset=DRAWN
    )
    velocity_std_mps: float = setting(
        0.003, "1 sigma of the velocity of the mass centre in {A}.", unit="m/s", above=0.0
    )
    velocity_offset_mps: Triple | None = setting(
        None, "Error of that velocity.", unit="m/s", unset=DRAWN
    )
    attitude_std_deg: float = setting(
        1.0, "1 sigma of the attitude of {B}, as a rotation about its axes.", unit="deg", above=0.0
    )
    attitude_offset_deg: Triple | None = setting(
        None, "Error of the attitude.", unit="deg", unset=DRAWN
    )


@dataclass(frozen=True, slots=True)
class ScenarioParams(Settings):
    """The content of a scenario file."""

    name: str = setting("scenario", "Name of the scenario.")
    seed: int = setting(0, "Seed of every random draw.", low=0, below=2**63)
    duration_s: float = setting(120.0, "Length of the log.", unit="s", above=0.0, high=MAX_WINDOW_S)
    rate_hz: float = setting(5.0, "Scan rate.", unit="Hz", above=0.0)
    target: TargetParams = setting(TargetParams, "The target.")
    motion: MotionParams = setting(MotionParams, "The target's motion.")
    scanner: ScannerParams = setting(ScannerParams, "The scanner.")
    material: tuple[Material, ...] = setting(
        (), "Optical properties of parts of the target, one table each."
    )
    appendage: tuple[Appendage, ...] = setting((), "Flexible parts of the target, one table each.")
    camera: CameraParams | None = setting(
        None,
        "Motion of the camera, whose pose the log then holds.",
        unset="at rest at the origin of {A}",
    )
    object: tuple[SceneObject, ...] = setting((), "Objects beside the target, one table each.")
    plume: tuple[Plume, ...] = setting((), "Particles from thrusters, one table each.")
    limb: tuple[Limb, ...] = setting((), "The sunlit Earth behind the target, one table each.")
    fault: tuple[InjectedFault, ...] = setting((), "The injected faults, one table [[fault]] each.")
    start: StartParams | None = setting(
        None, "The initial belief.", unset="the log has none, and the estimator starts cold"
    )
    run: Any = setting(dict, "Settings of the replay for this log (docs/settings.md).")

    def check(self) -> None:
        """Raise ValueError where there is no scan, too many, or a scan is longer than the time
        between scans.
        """
        if not 1.0 <= self.duration_s * self.rate_hz <= MAX_SCANS:
            raise ValueError(
                f"{self.duration_s} s at {self.rate_hz} Hz is not between 1 and {MAX_SCANS} scans"
            )
        if self.scanner.scan_s * self.rate_hz > 1.0 + 1e-9:
            raise ValueError(
                f"scanner.scan_s = {self.scanner.scan_s} is longer than the time between scans"
            )


@value_class(eq=True)
class Scenario:
    """A scenario as it was read.

    Attributes:
        params: its parameters, with the seed that is used.
        text: its TOML text, which is stored in the log.
        folder: folder to which its file names are relative.
    """

    params: ScenarioParams
    text: str
    folder: Path | None = None

    @property
    def model(self) -> Path | None:
        """The model file, None for a built-in shape."""
        if not self.params.target.model:
            return None
        return (self.folder or Path()) / self.params.target.model

    @property
    def meshes(self) -> dict[str, Path]:
        """The mesh files of its objects, by the names that it gives them."""
        return {
            each.model: (self.folder or Path()) / each.model
            for each in self.params.object
            if each.model
        }


def load_scenario(
    path: Path | None = None, seed: int | None = None, duration_s: float | None = None
) -> Scenario:
    """Load a scenario.

    Args:
        path: Its file; None for the built-in scenario.
        seed: Replaces its own seed.
        duration_s: Replaces its own duration [s].

    Raises:
        UnreadableInput: The file cannot be read.
        UsageError: A key or value is wrong; the message names file and line.
    """
    if path is None:
        text = (
            resources.files("avsreplay.simulate")
            .joinpath("builtin.toml")
            .read_text(encoding="utf-8")
        )
        document, folder = toml_document.parse(text, "built-in scenario"), None
    else:
        document, folder = toml_document.load(path), Path(path).parent
    if duration_s is None:
        return scenario_of(document, seed, folder)
    changed = replace(document, table={**document.table, "duration_s": duration_s})
    return replace(scenario_of(changed, seed, folder), text=tomli_w.dumps(changed.table))


def scenario_of(
    document: toml_document.Document, seed: int | None = None, folder: Path | None = None
) -> Scenario:
    """Return the scenario of a parsed document.

    Args:
        document: The parsed TOML text.
        seed: Replaces the seed of the document.
        folder: Folder to which its file names are relative; the working directory where None.

    Raises:
        UsageError: A key or value is wrong; the message names file and line.
    """
    params = toml_document.build(ScenarioParams, _with_preset(document))
    if not isinstance(params.run, dict):
        raise UsageError(
            "'run' must be a table", where=document.where(("run",)), hint="write it as [run]"
        )
    if seed is not None:
        params = replace(params, seed=seed)
    return Scenario(params, document.text, folder)


def _with_preset(document: toml_document.Document) -> toml_document.Document:
    """The document with the figures of the scanner's preset where it does not give them itself."""
    scanner = document.table.get("scanner", {})
    name = scanner.get("preset", "none") if isinstance(scanner, dict) else "none"
    if name not in [preset.value for preset in Preset if preset is not Preset.NONE]:
        return document  # none, or an error that ``build`` reports
    text = (
        resources.files("avsreplay.simulate").joinpath("presets.toml").read_text(encoding="utf-8")
    )
    figures = toml_document.parse(text, "presets.toml").table[name]
    return replace(document, table={**document.table, "scanner": {**figures, **scanner}})


def belief(start: StartParams, truth: State, t_ns: int, rng: np.random.Generator) -> Belief:
    """The initial belief: the true state plus offsets, given or drawn, and the covariance of the 20
    error states.

    Args:
        start: the offsets and the 1 sigma.
        truth: the true state at the instant.
        t_ns: the instant [ns].
        rng: generator of the random numbers.

    Raises:
        UsageError: the given offset leads to inertia ratios that no body has.
    """
    rate = _offset(start.rate_offset_radps, start.rate_std_radps, 3, rng)
    sigma = _offset(start.sigma_offset, start.sigma_std, 2, rng)
    if start.sigma_offset is not None and np.abs(truth.sigma + sigma).max() >= 1.0:
        what = (
            "with it the estimated inertia ratios are"
            f" {[round(float(s), 4) for s in truth.sigma + sigma]}"
        )
        raise UsageError(
            what,
            where="start.sigma_offset",
            hint="they must be between -1 and 1, as those of any body",
        )
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


def _offset(
    given: tuple[float, ...] | None, std: float, size: int, rng: np.random.Generator
) -> Array:
    drawn = std * rng.standard_normal(size)
    return drawn if given is None else np.array(given, dtype=np.float64)
