"""One simulated recording: scans and their truth, one after the other. The same seed gives the same
bits.

Every scan has its own random streams, one per purpose, so that a fault added to a scenario does not
change other scans.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from itertools import repeat
from typing import TypeVar

import numpy as np

from avsreplay.errors import value_class
from avsreplay.geometry import Pose
from avsreplay.records import NS_PER_S, LogHeader, Scan, ScanStatus, State, Surface, Truth
from avsreplay.simulate import faults
from avsreplay.simulate.faults import Circumstances, InjectedFault, Shot, Stage
from avsreplay.simulate.motion import Motion
from avsreplay.simulate.rays import Engine, Pattern
from avsreplay.simulate.recorded_faults import disturbed
from avsreplay.simulate.scanner import Scanner
from avsreplay.simulate.scenario import Scenario, belief, load_scenario, scenario_of
from avsreplay.simulate.scene import MovingCamera, SceneBody, scene_bodies
from avsreplay.simulate.target import Shape, body, builtin_surface

__all__ = [
    "SIMULATED_EPOCH_NS",
    "Engine",
    "InjectedFault",
    "Scenario",
    "Shape",
    "Simulation",
    "builtin_surface",
    "disturbed",
    "load_scenario",
    "scenario_of",
    "simulate",
]


# time of the first scan of every simulated log, fixed so that logs are reproducible
SIMULATED_EPOCH_NS = 1_700_000_000_000_000_000
T = TypeVar("T")
_GENERATOR_NAMES = (
    "motion",
    "start",
    "noise",
    "fault",
    "plate",
    "camera",
    "camera_pose",
    "plume",
    "limb",
)
_STREAMS = {name: k for k, name in enumerate(_GENERATOR_NAMES)}


@value_class
class Simulation:
    """A simulated log.

    Attributes:
        header: Header of the log.
        count: Number of scans, dropped ones included.
    """

    header: LogHeader
    count: int
    _scenario: Scenario = field(repr=False)
    _motion: Motion = field(repr=False)
    _scanner: Scanner = field(repr=False)
    _bodies: Sequence[SceneBody] = field(repr=False, default=())
    _camera: MovingCamera | None = field(repr=False, default=None)

    @property
    def engine(self) -> Engine:
        """The engine that casts the rays."""
        return self._scanner.engine

    def truth(self, log_ns: int) -> State:
        """Return the true state.

        Args:
            log_ns: Instant on the clock of the log [ns].
        """
        return self._motion.state((log_ns - SIMULATED_EPOCH_NS) / NS_PER_S)

    def truth_of(self, scan: Scan) -> Truth:
        """Return the ground truth at one of this simulation's scans: pose, full state and injected
        fault.

        Args:
            scan: A scan of ``scans``.
        """
        state = self.truth(scan.log_ns)
        kinds = [each.kind for _, each in self._faults(scan.log_ns)]
        t_s, params = (scan.log_ns - SIMULATED_EPOCH_NS) / NS_PER_S, self._scenario.params
        others = [
            each for each in (*params.object, *params.plume, *params.limb) if each.present(t_s)
        ]
        kinds += [each.name for each in others if each.duration_s is not None]
        return Truth(state.T_ac, state, next(iter(kinds), None))

    def camera_poses(self, scan: Scan) -> list[tuple[int, Pose]]:
        """Return the poses of a moving camera in the fixed frame as its topic reports them; none
        for one at rest.

        Args:
            scan: A scan of ``scans``.

        Returns:
            Each pose with its time after the stamp [ns]: one at the stamp, and eight more during a
            scan that lasts.
        """
        if self._camera is None:
            return []
        rng, scanner = self._rng("camera_pose", scan.seq), self._scenario.params.scanner
        last = 0.0 if scanner.pattern is Pattern.FLASH else scanner.scan_s
        after = sorted({round(part * last * NS_PER_S / 8) for part in range(9)})
        return [
            (ns, self._camera.reported((scan.log_ns + ns - SIMULATED_EPOCH_NS) / NS_PER_S, rng))
            for ns in after
        ]

    def _faults(self, log_ns: int) -> faults.Active:
        every = self._scenario.params.fault
        return faults.first_of_each_kind(faults.active(every, SIMULATED_EPOCH_NS, log_ns))

    def scans(self) -> Iterator[Scan]:
        """The scans in the order of recording; a dropped one leaves a gap in ``seq``."""
        last: Scan | None = None
        places: dict[int, int] = {}  # scans so far in the window of each fault
        for k in range(self.count):
            log_ns = SIMULATED_EPOCH_NS + round(k * NS_PER_S / self._scenario.params.rate_hz)
            now = self._faults(log_ns)
            shot = self._shot(k, log_ns, now, places)
            places.update({number: places.get(number, 0) + 1 for number, _ in now})
            if not shot.written:
                continue
            scan = self._scan(k, log_ns, shot)
            if not shot.repeated:
                last = scan
            elif last is not None:
                scan = replace(
                    scan,
                    points=last.points,
                    times_s=last.times_s,
                    intensities=last.intensities,
                    status=last.status,
                )
            yield scan

    def _scan(self, k: int, log_ns: int, shot: Shot) -> Scan:
        returns, scanner = shot.returns, self._scenario.params.scanner
        timed = scanner.pattern is not Pattern.FLASH
        return Scan(
            seq=k,
            t_ns=log_ns + shot.stamp_ns,
            log_ns=log_ns,
            points=returns.points,
            times_s=returns.times_s.astype(np.float32) if timed else None,
            status=ScanStatus.OK if len(returns.ranges) else ScanStatus.EMPTY,
            intensities=returns.intensities.astype(np.float32) if scanner.intensity else None,
        )

    def _shot(self, k: int, log_ns: int, now: faults.Active, places: Mapping[int, int]) -> Shot:
        """Ray casting, noise and faults, in the order in which they act on the light."""
        noise, t_s, params = (
            self._rng("noise", k),
            (log_ns - SIMULATED_EPOCH_NS) / NS_PER_S,
            self._scenario.params,
        )
        bodies = [body for body in self._bodies if body.params.present(t_s)]
        plumes = [each for each in params.plume if each.present(t_s)]
        limbs = [each for each in params.limb if each.present(t_s)]
        lights = self._with_rng("plume", k, plumes), self._with_rng("limb", k, limbs)
        acting = faults.in_order_of_action(now)
        # not used without a fault; to create it takes 25 us
        wrong = self._rng("fault", k) if now else noise
        at = {n: self._circumstances(t_s, log_ns, n, places.get(n, 0)) for n, _ in acting}
        shot = Shot(self._scanner.cast(t_s, bodies, *lights))
        for number, fault in acting:
            if fault.stage <= Stage.NOISE:
                shot = fault.apply(shot, at[number], wrong)
        factor = shot.noise * self._scanner.glare(t_s, limbs)
        shot = replace(shot, returns=self._scanner.disturb(shot.returns, noise, factor))
        for number, fault in acting:
            if fault.stage > Stage.NOISE:
                shot = fault.apply(shot, at[number], wrong)
        return replace(shot, returns=shot.returns.in_order())

    def _circumstances(self, t_s: float, log_ns: int, number: int, place: int) -> Circumstances:
        """What a fault with this number in the scenario needs to know."""
        centre = self.truth(log_ns).T_ac.apply(self._scanner.centre_c)
        if self._camera is not None:
            centre = self._camera.pose(t_s).inverse().apply(centre)
        return Circumstances(
            t_s=t_s,
            place=place,
            window=lambda: self._rng("plate", number),
            centre_a=centre,
            radius_m=self._scanner.radius_m,
        )

    def _with_rng(
        self, stream: str, k: int, present: list[T]
    ) -> list[tuple[T, np.random.Generator]]:
        """Each of what is present with the generator of their stream, which is created if there is
        any.
        """
        return list(zip(present, repeat(self._rng(stream, k)), strict=False)) if present else []

    def _rng(self, stream: str, k: int) -> np.random.Generator:
        return _generator(self._scenario.params.seed, stream, k)


def simulate(
    scenario: Scenario, surface: Surface, meshes: Mapping[str, Surface] | None = None
) -> Simulation:
    """The simulation of a scenario.

    Args:
        scenario: The scenario.
        surface: The model in {C}.
        meshes: Surface of every mesh that an object of the scenario names.

    Raises:
        UsageError: The model has no mass properties.
        MissingBackend: The ray engine is not installed.
    """
    params = scenario.params
    span_s = params.duration_s + params.scanner.scan_s
    motion = Motion(
        body(params.target, surface), params.motion, span_s, _generator(params.seed, "motion", 0)
    )
    phases = _generator(params.seed, "camera", 0).uniform(0.0, 2.0 * math.pi, 6)
    camera = None if params.camera is None else MovingCamera(params.camera, phases)
    scanner = Scanner(params.scanner, surface, motion, params.material, params.appendage, camera)
    first = motion.state(0.0)
    start = None
    if params.start is not None:
        start = belief(params.start, first, SIMULATED_EPOCH_NS, _generator(params.seed, "start", 0))
    others = [
        each.label(SIMULATED_EPOCH_NS) for each in (*params.object, *params.plume, *params.limb)
    ]
    header = LogHeader(
        surface=surface,
        scenario=scenario.text,
        seed=params.seed,
        labels=(
            *(each.label(SIMULATED_EPOCH_NS) for each in params.fault),
            *(label for label in others if label),
        ),
        start=start,
        truth=first,
        notes={"source": "simulated", "name": params.name, "ray_engine": scanner.engine.value},
    )
    count = int(params.duration_s * params.rate_hz + 1e-9)
    bodies = scene_bodies(params.object, dict(meshes or {}), params.scanner.engine)
    return Simulation(header, count, scenario, motion, scanner, bodies, camera)


def _generator(seed: int, stream: str, k: int) -> np.random.Generator:
    return np.random.Generator(
        np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(_STREAMS[stream], k)))
    )
