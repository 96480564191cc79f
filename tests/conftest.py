"""Shared fixtures: the command line, built-in cases, real data if it is available,
constructed rows.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
# Tests and the processes that they start import the package that is installed, in place or from a
# wheel: the clone, which "python -m" puts on the path, has no compiled extensions.
sys.path[:] = [entry for entry in sys.path if Path(entry or os.curdir).resolve() != ROOT]
os.environ["PYTHONSAFEPATH"] = "1"
# A shell ignores Ctrl-C in its background jobs, which the processes of the tests would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

from command_server import CommandServer  # noqa: E402

from avsreplay.records import Surface  # noqa: E402
from avsreplay.register.contract import boxes, example_pose, view  # noqa: E402
from avsreplay.rows import Row  # noqa: E402

hypothesis.settings.register_profile("without deadline", deadline=None)  # no test asserts a time
hypothesis.settings.load_profile("without deadline")

SERVER = CommandServer()
DATA = ROOT.parent / "shared" / "data"


@dataclass(frozen=True)
class Done:
    """A finished command."""

    code: int
    out: str
    err: str


def avsreplay(*args, cwd=None, env=None, timeout=300):
    """Run the command line as a user does: in a fork of a process that has imported it, or in
    one of its own.
    """
    words, environment = [*map(str, args)], {**os.environ, **(env or {})}
    done = SERVER.run(words, cwd, environment, timeout)
    if done is None:
        command = [sys.executable, "-m", "avsreplay", *words]
        ended = subprocess.run(
            command,
            cwd=cwd,
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        done = ended.returncode, ended.stdout, ended.stderr
    return Done(*done)


@pytest.fixture(scope="session")
def surface() -> Surface:
    """The closed mesh without symmetry of the contract tests."""
    return boxes()


@pytest.fixture(scope="session")
def scan(surface: Surface) -> np.ndarray:
    """Its points (n, 3) in {A} that the camera sees at ``example_pose``."""
    T_ac = example_pose()
    return T_ac.apply(view(surface, 6000, T_ac.inverse().t))


@pytest.fixture(scope="session")
def cli():
    avsreplay(
        "run", ROOT / "fixtures" / "tumble.mcap", "--n-scans", "1", "--json"
    )  # the server keeps the imports
    yield avsreplay
    SERVER.close()


@pytest.fixture(scope="session")
def fixtures_folder():
    return ROOT / "fixtures"


@pytest.fixture(scope="session")
def shared_data():
    if not DATA.is_dir():
        pytest.skip("../shared/data is not here")
    return DATA


SLOW = ROOT / "tests" / "slow.txt"
MOST_S, MOST_FIXTURE_S = (
    0.2,
    1.0,
)  # processor time of a quick test, and of a fixture of a module with quick tests
SPENT: dict[object, float] = {}  # largest processor time of each test and fixture


def pytest_addoption(parser):
    parser.addoption(
        "--write-slow", action="store_true", help="write the tests that are slow to tests/slow.txt"
    )


def pytest_collection_modifyitems(items):
    """Give the tests that slow.txt lists the marker ``slow``."""
    listed = listed_as_slow()
    for item in items:
        if named(item) in listed:
            item.add_marker("slow")


def listed_as_slow():
    """Name and processor time of the tests in slow.txt."""
    lines = SLOW.read_text(encoding="utf-8").splitlines()
    return {name: float(spent) for spent, name in (line.split() for line in lines)}


def named(item):
    """The name of a test without its parameters."""
    return f"{item.path.name}::{getattr(item, 'originalname', item.name)}"


@contextmanager
def measured(key):
    before = sum(os.times()[:4]) + SERVER.spent_s
    try:
        yield
    finally:
        SPENT[key] = max(SPENT.get(key, 0.0), sum(os.times()[:4]) + SERVER.spent_s - before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    with measured(named(item)):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef):
    with measured(fixturedef):
        return (yield)


def pytest_sessionfinish(session):
    """Write slow.txt; what it says of tests that were not run stays."""
    if not session.config.getoption("--write-slow"):
        return
    table = {name: spent for name, spent in listed_as_slow().items() if name not in SPENT}
    for item in session.items:
        definitions = [
            d for found in item._fixtureinfo.name2fixturedefs.values() for d in found[-1:]
        ]
        fixture = max((SPENT.get(d, 0.0) for d in definitions if d.scope == "module"), default=0.0)
        spent = max(SPENT.get(named(item), 0.0), fixture if fixture > MOST_FIXTURE_S else 0.0)
        if named(item) in SPENT and spent > MOST_S:
            table[named(item)] = spent
    lines = [f"{spent:6.1f} {name}" for name, spent in sorted(table.items())]
    SLOW.write_text("\n".join(lines) + "\n", encoding="utf-8")


STEP_NS = 200_000_000
START_NS = 1_700_000_000_123_456_789


@pytest.fixture(scope="session")
def make_rows() -> Callable[..., list[Row]]:
    """``make_rows(n, seed=0, blackout=range(...), **columns)``: a seeded run whose blackout
    has no scan to use.
    """

    def build(
        n: int = 40, seed: int = 0, blackout: range = range(20, 26), **changes: object
    ) -> list[Row]:
        rng = np.random.Generator(np.random.PCG64(seed))
        return [_row(k, rng, k in blackout, changes) for k in range(n)]

    return build


def _row(k: int, rng: np.random.Generator, blind: bool, changes: dict[str, object]) -> Row:
    position = [1.0 + 0.01 * k, 0.2, 5.0]
    half = 0.01 * k
    attitude = {"qx": 0.0, "qy": 0.0, "qz": math.sin(half), "qw": math.cos(half)}
    noise = rng.uniform(size=4)
    values: dict[str, object] = {
        "seq": k,
        "t_ns": START_NS + k * STEP_NS,
        "t_s": k * STEP_NS * 1e-9,
        "status": "empty" if blind else "aligned",
        "gamma": 0 if blind else 1,
        "reason": "no_scan" if blind else "ok",
        "guess": "predicted",
        "fault": "full_occlusion" if blind else None,
        "points": 0 if blind else 4000,
        "estimator": "filter",
        "motion": "free",
        "converged": k >= 10,
        "action": "approach",
        "supervisor_rule": "track",
        **dict(zip(("x_m", "y_m", "z_m"), position, strict=True)),
        **attitude,
        "pos_err_m": 0.002 + 0.001 * float(noise[0]),
        "rot_err_deg": 0.1 + 0.05 * float(noise[1]),
        "nees": float(rng.chisquare(20)),
        "sigma1": 0.3 + 0.001 * float(noise[2]),
        "sigma2": -0.4,
        "sigma1_1s": 0.01,
        "sigma2_1s": 0.01,
        "cx_m": 0.5,
        "cy_m": 0.6,
        "cz_m": -0.7,
        "c_1s_m": 0.01,
        "mux": 0.0,
        "muy": 0.0,
        "muz": math.sin(0.1),
        "muw": math.cos(0.1),
        "mu_1s_deg": 0.2,
        "sigma_hits": 2,
        "r_floors": 0,
        "reinitialised": 0,
        "manoeuvres": 0,
        "violations": 0,
        "ogm_rank": min(k, 20),
        "ogm_log10_cond": None if k < 20 else 9.0,
        "ogm_log10_cond_scaled": None if k < 20 else 4.0,
        "plan_status": "optimal" if k >= 10 else None,
        "capture_time_s": 30.0 + 0.1 * (k // 10) if k >= 10 else None,
    }
    if not blind:
        values |= {
            "iterations": 6,
            "inliers": 3900,
            "inlier_ratio": 0.975,
            "rms_m": 0.008 + 0.001 * float(noise[3]),
            "nis": float(rng.chisquare(6)),
            "innov_m": 0.002,
            "innov_deg": 0.1,
            "reg_pos_err_m": 0.003,
            "reg_rot_err_deg": 0.15,
            **{f"reg_{n}": v for n, v in zip(("x_m", "y_m", "z_m"), position, strict=True)},
            **{f"reg_{n}": v for n, v in attitude.items()},
        }
    return Row(**(values | changes))  # type: ignore[arg-type]
