import numpy as np
from numpy.typing import NDArray

from avsreplay.geometry import Array

def follow(
    q: Array,
    w: Array,
    sigma: tuple[float, float, float],
    push: tuple[float, float, float],
    times: NDArray[np.float64],
    drive: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Array, Array, Array, Array]: ...
def correct(
    x: Array,
    P: Array,
    H: Array,
    alpha: Array,
    S: Array,
    R: Array,
    colour: tuple[float, float],
) -> tuple[Array, Array]: ...
def innovation(P: Array, H: Array, alpha: Array, R: Array) -> tuple[Array, bool, float]: ...
def pose_jacobian(x: Array) -> Array: ...
def pose_covariance(P: Array, H: Array) -> Array: ...
def definite(A: Array) -> bool: ...
def trace_of_ratio(part: Array, total: Array) -> float: ...
def squared_traces(part: Array, total: Array) -> float: ...
def block_squares(R: Array, e: Array, C: Array) -> list[list[float]]: ...
def shifted_mean(x: Array, to: Array) -> Array: ...
def shifted(x: Array, P: Array, to: Array) -> tuple[Array, Array]: ...
def used(
    Phi: Array,
    P: Array,
    H: Array,
    alpha: Array,
    S: Array,
    R: Array,
    colour: tuple[float, float],
) -> Array: ...
def change(
    scans: Array,
    one_sigma: tuple[float, float],
    sizes: list[float],
    scale: float,
    share: float,
) -> tuple[float, Array]: ...
def forecast(
    x: Array,
    P: Array,
    torque: tuple[float, float, float],
    force: float,
    times: Array,
) -> Array: ...
def mixture_forecast(
    charts: Array,
    references: Array,
    P: Array,
    weights: Array,
    torque: Array,
    published: Array,
    force: float,
    times: Array,
    origin_c: tuple[float, float, float],
) -> Array: ...
def chart(x: Array) -> Array: ...
def least_gap(chart: Array) -> float: ...
def moved(chart: Array, y: Array) -> Array: ...
def spread(
    x: Array,
    errors: Array,
    most: float,
    chart: Array,
) -> Array: ...
def after_changes(
    late: Array, which: NDArray[np.int64], impulses: Array, instants: Array
) -> Array: ...
def evidence(M: Array, white: Array, size: Array) -> tuple[Array, Array, Array]: ...
def log_ratio(A: Array, b: Array) -> Array: ...
def mixed(
    M: Array, white: Array, size: Array, factors: Array, kinds: list[tuple[int, int]]
) -> Array: ...
def impulse_odds(A: Array, b: Array, variances: Array) -> tuple[Array, Array]: ...
def lower_inverse(L: Array) -> Array: ...
def minus(chart: Array, other: Array) -> Array: ...
def state(chart: Array) -> Array: ...
def errors(chart: Array) -> Array: ...
def body(chart: Array, P: Array, largest: float) -> Array: ...
def transition(chart: Array, h: float, path: Array) -> tuple[Array, Array]: ...
def chains(
    charts: Array, steps: Array, counts: NDArray[np.int64], paths: Array
) -> tuple[Array, Array]: ...
def passes(
    F: Array,
    b: Array,
    Q: Array,
    z: Array,
    H: Array,
    R: Array,
    used: NDArray[np.bool_],
    m0: Array,
    P0: Array,
) -> tuple[float, Array, Array, Array, Array, Array, Array]: ...
def carry(
    charts: Array,
    references: Array,
    P: Array,
    h: float,
    path: Array,
    torque: float,
    force: float,
    q: Array,
    t: Array,
    root: Array,
    factors: tuple[float, float],
    weight: float,
) -> tuple[Array, Array, Array, Array]: ...
def without_drift(
    chart: Array,
    u: Array,
    onset: float,
    times: Array,
    centre: Array,
    q: Array,
    t: Array,
    back: bool,
) -> tuple[Array, Array]: ...
def corrected_poses(
    x: Array, attitude: Array, centre: Array, error: Array, moved: Array
) -> tuple[Array, Array]: ...
def roots(C: Array) -> tuple[Array, Array]: ...
def above(P: Array, least: float) -> bool: ...
def impulses(
    q: Array,
    w: Array,
    sigma: tuple[float, float, float],
    times: NDArray[np.float64],
    drive: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Array: ...
def by_drive(
    q: Array,
    w: Array,
    sigma: tuple[float, float, float],
    times: Array,
    drive: tuple[float, float, float],
) -> Array: ...
def join(charts: Array, P: Array, weights: Array, quadrature: Array) -> tuple[Array, Array]: ...
def propagate(
    x: Array,
    P: Array,
    h: float,
    path: Array,
    torque: tuple[float, float, float],
    force: float,
) -> tuple[Array, Array, Array]: ...
def nees(
    x: Array,
    truth: Array,
    P: Array,
    R_nb: Array,
    q_bn: Array,
) -> tuple[int, float, float, list[float]]: ...

class Problem:
    def __init__(
        self,
        times: Array,
        q: Array,
        t: Array,
        root: Array,
        info: Array,
        mean: Array,
        prior_info: Array,
    ) -> None: ...
    def paths(self, paths: Array) -> None: ...
    def pin(self, centre: Array, row: Array, target: float, one_sigma: float) -> None: ...
    def unpin(self) -> None: ...
    def noise(self, factors: tuple[float, float], redescend: bool, gate: float) -> None: ...
    def linearise(self, chart: Array) -> None: ...
    def residuals(self, chart: Array) -> tuple[float, float, Array]: ...
    def descend(self, most: int, gain_tol: float) -> tuple[int, bool]: ...
    def normal(self) -> tuple[Array, Array]: ...
    def rows(self) -> tuple[Array, Array]: ...
    def absorbed(self, P: Array) -> tuple[float, float]: ...
    def smooth(
        self,
        y: Array,
        P: Array,
        into: Array,
        torque: tuple[float, float, float],
        force: float,
        since: float = 0.0,
    ) -> tuple[Array, Array]: ...
    @property
    def chart(self) -> Array: ...
    @property
    def cost(self) -> float: ...
    @property
    def d(self) -> Array: ...
    @property
    def weights(self) -> Array: ...

class Driven(Problem):
    def __init__(
        self,
        times: Array,
        q: Array,
        t: Array,
        root: Array,
        info: Array,
        mean: Array,
        prior_info: Array,
        onset: float,
        widths: Array,
    ) -> None: ...
    def measure(self, row: Array, target: float) -> None: ...
    def linearise(self, chart: Array, u: Array) -> None: ...  # type: ignore[override]
    def step(self, damping: float) -> float: ...
    @property
    def u(self) -> Array: ...
    @property
    def left(self) -> float: ...

class Path:
    def __init__(
        self,
        q: Array,
        w: Array,
        sigma: tuple[float, float, float],
        drive: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None: ...
    def at(self, times: NDArray[np.float64]) -> tuple[Array, Array]: ...
    def point(self, times: NDArray[np.float64], c: Array) -> tuple[Array, Array]: ...
