"""Whether quick tests fail where the code is wrong: ``python tests/benchmarks/mutants.py FOLDER
--count 300``.

Each mutant changes one operator, comparison, sign, number or condition of one module, chosen by the
seed among all that the syntax trees of the package contain. The first call copies the checkout to
FOLDER and runs the quick tests once, with probes that record which statements each test runs. A
mutant is then tested, in a fork of a process that has imported the libraries, by the tests that run
its statement, the shortest first, until one fails; a change of a constant, which runs with the
import, by those that run a statement with its name. Where a test runs a statement that a cache
or fixture of its file keeps for others, the other tests of the file follow.

A survivor may be equivalent to the code. FOLDER has one line of JSON for each verdict, and a
campaign that was ended continues; ``--again`` tests the survivors anew. Test files that were
changed since are recorded again, the package stays as it was copied.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from importlib import import_module, metadata
from pathlib import Path

import mutation
import numpy as np
import pytest
from mutation import Module, Mutant

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("-q", "-p", "no:cacheprovider", "-m", "not slow", "--hypothesis-seed=0", "-n0")
SLACK, START_S = 5.0, 40.0  # processor time of a mutant's tests: times what was recorded, and more
IDLE_S = 30.0  # tests whose processes use less than LEAST_TICKS for so long do not end [s]
LEAST_TICKS = 50  # processor time [0.01 s]
SITE = """import sys
sys.meta_path[:] = [e for e in sys.meta_path if not type(e).__module__.startswith("_editable")]
import mutation
mutation.install()
"""


class Folder:
    """A campaign on disk: ``site`` has the package, ``checkout`` the tests, ``map.npz`` which
    statements each test runs, ``verdicts.jsonl`` the results.
    """

    def __init__(self, root: Path) -> None:
        self.site, self.checkout = root / "site", root / "checkout"
        self.map, self.verdicts = root / "map.npz", root / "verdicts.jsonl"
        self.probes = root / "probes"

    def prepare(self, renew: bool) -> None:
        """Copy the package and the tests once; the tests as they are now, too, if ``renew``."""
        left_out = shutil.ignore_patterns(".git", "build", ".mypy_cache", "__pycache__", "shared")
        if not self.site.is_dir():
            shutil.copytree(ROOT / "avsreplay", self.site / "avsreplay", ignore=left_out)
            for each in metadata.files("avsreplay") or ():
                if each.suffix == ".so":
                    shutil.copy(str(each.locate()), self.site / each)
            shutil.copytree(ROOT, self.checkout, ignore=left_out)
        (self.site / "sitecustomize.py").write_text(SITE, encoding="utf-8")
        shutil.copy(mutation.__file__, self.site)
        for path in (ROOT / "tests").rglob("*") if renew else ():
            other = self.checkout / path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in path.parts:
                other.parent.mkdir(exist_ok=True, parents=True)
                if not other.exists() or other.read_bytes() != path.read_bytes():
                    shutil.copy(path, other)

    def enter(self) -> None:
        """Make this process, and those it starts, import the package of the folder."""
        os.environ["PYTHONPATH"] = os.pathsep.join(map(str, (self.site,)))
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        sys.path.insert(0, str(self.site))
        editable = [e for e in sys.meta_path if type(e).__module__.startswith("_editable")]
        for each in editable:
            sys.meta_path.remove(each)
        os.chdir(self.checkout)
        os.environ["OMP_NUM_THREADS"] = "1"

    def files(self) -> dict[str, str]:
        """Name and digest of the test files."""
        return {
            path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted((self.checkout / "tests").glob("test_*.py"))
        }


class Recorder:
    """A pytest plugin: the statements that run in each test, with those of its fixtures."""

    def __init__(self, hits: np.ndarray) -> None:  # type: ignore[type-arg]
        self.hits = hits
        self.tests: dict[str, tuple[float, np.ndarray]] = {}  # type: ignore[type-arg]
        self.fixtures: dict[object, np.ndarray] = {}  # type: ignore[type-arg]
        self.collected: dict[str, np.ndarray] = {}  # type: ignore[type-arg]
        self.passed: Counter[str] = Counter()
        self._outer: list[np.ndarray] = []  # type: ignore[type-arg]

    def _begin(self) -> None:
        self._outer.append(self.hits.copy())
        self.hits[:] = 0

    def _end(self) -> np.ndarray:  # type: ignore[type-arg]
        own, outer = np.packbits(self.hits), self._outer.pop()
        np.maximum(self.hits, outer, out=self.hits)
        return own

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(self, collector):
        self._begin()
        report = yield
        own, name = self._end(), getattr(collector.path, "name", "")
        self.collected[name] = self.collected.get(name, 0 * own) | own
        return report

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        self._begin()
        value = yield
        self.fixtures[fixturedef] = self._end()
        return value

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        before = _processor_s()
        self.hits[:] = 0
        done = yield
        own = np.packbits(self.hits)
        for definitions in item._fixtureinfo.name2fixturedefs.values():
            for each in definitions:
                own |= self.fixtures.get(each, 0 * own)
        self.tests[item.nodeid] = _processor_s() - before, own
        return done

    def pytest_runtest_logreport(self, report):
        self.passed[report.nodeid] += report.passed


class Map:
    """Which statements each test runs.

    Attributes:
        names: of the tests.
        spent_s: processor time of each.
        ran: (tests, statements / 8) bits.
        files: digest of each test file when it was recorded.
    """

    def __init__(self, names: list[str], spent_s: list[float], ran, files: dict[str, str]) -> None:
        self.names, self.spent_s, self.ran, self.files = names, np.array(spent_s), ran, files
        self.file_of = np.array([_file(name) for name in names])

    @classmethod
    def read(cls, path: Path) -> Map:
        with np.load(path) as kept:
            names, files = json.loads(str(kept["names"])), json.loads(str(kept["files"]))
            return cls(names, kept["spent_s"].tolist(), kept["ran"], files)

    def write(self, path: Path) -> None:
        texts = {"names": json.dumps(self.names), "files": json.dumps(self.files)}
        np.savez_compressed(path, spent_s=self.spent_s, ran=self.ran, **texts)

    def without(self, files: set[str]) -> Map:
        """Without the tests of some files."""
        kept = [i for i, file in enumerate(self.file_of) if file not in files]
        left = {name: digest for name, digest in self.files.items() if name not in files}
        names = [self.names[i] for i in kept]
        return Map(names, self.spent_s[kept].tolist(), self.ran[kept], left)

    def runs(self, statements: list[int]) -> np.ndarray:  # type: ignore[type-arg]
        """Whether each test runs one of the statements."""
        out = np.zeros(len(self.names), dtype=bool)
        for each in statements:
            out |= (self.ran[:, each // 8] >> (7 - each % 8) & 1).astype(bool)
        return out


def _processor_s() -> float:
    """Of this process, its children and the server of commands."""
    import conftest  # the tests' own, which pytest has imported

    return sum(os.times()[:4]) + conftest.SERVER.spent_s


def _file(name: str) -> str:
    return Path(name.split("::")[0]).name


def record(folder: Folder, files: list[str], count: int) -> Map:
    """Run the quick tests of some files with probes. Called in a process of its own."""
    folder.probes.mkdir(exist_ok=True)
    os.environ[mutation.PROBES] = str(folder.probes)
    mutation_of_site = import_module("mutation")
    mutation_of_site.__file__ = str(folder.site / "mutation.py")
    mutation_of_site.install()
    hits = np.memmap(folder.probes / "hits", dtype=np.uint8, mode="r+", shape=(count,))
    plugin = Recorder(hits)
    pytest.main([*QUICK, *(f"tests/{name}" for name in files)], plugins=[plugin])
    names = [name for name in plugin.tests if plugin.passed[name] == 3]
    ran = [plugin.tests[name][1] | plugin.collected.get(_file(name), 0) for name in names]
    spent = [plugin.tests[name][0] for name in names]
    digests = {name: digest for name, digest in folder.files().items() if name in files}
    width = (count + 7) // 8
    return Map(names, spent, np.array(ran, dtype=np.uint8).reshape(-1, width), digests)


class Package:
    """The statements and mutants of the package.

    Attributes:
        modules: by path.
        first: number of the first statement of each module.
        count: number of statements.
    """

    def __init__(self, folder: Folder) -> None:
        self.modules: dict[str, Module] = {m.path: m for m in mutation.modules(folder.site)}
        self.first, self.count = dict[str, int](), 0
        self.mentions: dict[str, list[int]] = {}
        for path, module in self.modules.items():
            self.first[path] = self.count
            for number, names in module.named.items():
                for name in names:
                    self.mentions.setdefault(name, []).append(self.count + number)
            self.count += module.statements
        self.site = folder.site

    def statements_of(self, mutant: Mutant) -> list[int]:
        """The statements whose tests can see a mutant."""
        first = self.first[mutant.path]
        if mutant.deferred:
            return [first + mutant.statement]
        own = first + mutant.statement
        found = [s for name in mutant.names for s in self.mentions.get(name, ()) if s != own]
        return found or list(range(first, first + self.modules[mutant.path].statements))

    def name_of(self, mutant: Mutant) -> str:
        """Path, code of its line, number of the change in the module, and what is changed."""
        text = (self.site / mutant.path).read_text(encoding="utf-8").splitlines()
        return f"{mutant.path} [{text[mutant.line - 1].strip()}] {mutant.number} {mutant.what}"


def order(found: Map, package: Package, mutant: Mutant, most_s: float) -> tuple[list[str], float]:
    """The tests of a mutant and their processor time, which is bounded by ``most_s``.

    First those that run its statement, in order of their time with the files of its area first;
    then the other tests of their files.
    """
    direct = found.runs(package.statements_of(mutant))
    area = "_".join(Path(mutant.path).with_suffix("").parts[1:])
    near = np.array([name.startswith(f"test_{area}") for name in found.file_of], dtype=bool)
    other = np.isin(found.file_of, np.unique(found.file_of[direct])) & ~direct
    ranks = np.select([direct & near, direct, other & near, other], [0, 1, 2, 3], 4)
    chosen = np.lexsort((found.spent_s, ranks))
    chosen = chosen[ranks[chosen] < 4]
    spent = np.cumsum(found.spent_s[chosen])
    count = max(int(np.searchsorted(spent, most_s)), min(1, len(chosen)))
    return [found.names[i] for i in chosen[:count]], float(spent[count - 1]) if count else 0.0


def fails(folder: Folder, mutant: Mutant | None, tests: list[str], spent_s: float) -> str:
    """The first test that fails with a mutant, "end" if they do not end, or an empty text."""
    there, here = os.pipe()
    limit = SLACK * spent_s + START_S
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(there)
        with Path(os.devnull).open("r+b") as nothing:
            for number in (0, 1, 2):
                os.dup2(nothing.fileno(), number)
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit), int(limit) + 1))
        os.write(here, _tested(folder, mutant, tests).encode()[:4000])
        os._exit(0)
    os.close(here)
    with os.fdopen(there, "rb") as stream:
        ended, spent, idle_since = 0, -LEAST_TICKS, time.monotonic()
        while not ended and time.monotonic() - idle_since < IDLE_S:
            for _ in range(50):
                ended, _ = (ended, 0) if ended else os.waitpid(child, os.WNOHANG)
                time.sleep(0.0 if ended else 0.02)
            now = sum(_group(child).values())
            if now >= spent + LEAST_TICKS:
                spent, idle_since = now, time.monotonic()
        for each in _group(child):
            os.kill(each, signal.SIGKILL)
        if not ended:
            os.waitpid(child, 0)
        text = stream.read().decode(errors="replace")
    return "" if text == "passed" else text or "end"


def _group(leader: int) -> dict[int, int]:
    """Processor time [ticks] of the processes that a child has started and left, and its own."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader:
            found[int(path.parent.name)] = int(fields[11]) + int(fields[12])
    return found


class _First:
    failed = ""

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.failed:
            self.failed = report.nodeid

    def pytest_collectreport(self, report):
        if report.failed and not self.failed:
            self.failed = report.nodeid


def _tested(folder: Folder, mutant: Mutant | None, tests: list[str]) -> str:
    """In the fork: the first failed test or "passed"."""
    if mutant is not None:
        os.environ[mutation.MUTANT] = f"{mutant.path}:{mutant.number}"
        mutation.__file__ = str(folder.site / "mutation.py")
        mutation.install()
    first = _First()
    code = pytest.main([*QUICK, "-x", *tests], plugins=[first])
    return "passed" if code == 0 else first.failed or f"pytest ended with {code}"


def warm(folder: Folder) -> None:
    """Import what the package and its tests import, but not them."""
    program = (
        "import sys, runpy, pytest; sys.path.insert(0, 'tests'); import conftest;"
        "import avsreplay.cli.run, avsreplay.run, avsreplay.cli.main, avsreplay.sweep;"
        "print(' '.join(sorted(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    for name in done.stdout.splitlines()[-1].split():
        if name.partition(".")[0] in ("numpy", "scipy", "hypothesis", "trimesh", "rich", "click"):
            import_module(name)


def campaign(folder: Folder, options: argparse.Namespace) -> int:
    """Test the mutants that have no verdict."""
    package, found = Package(folder), Map.read(folder.map)
    everything = [
        m for module in package.modules.values() for m in module.mutants if options.only in m.path
    ]
    sample = random.Random(options.seed).sample(everything, min(options.count, len(everything)))
    print(f"{len(sample)} of {len(everything)} mutants of {len(package.modules)} modules")
    lines = folder.verdicts.read_text().splitlines() if folder.verdicts.exists() else []
    before = {line["mutant"]: line for line in map(json.loads, lines)}
    warm(folder)
    if "avsreplay" in sys.modules:
        raise SystemExit("the package is imported before it is changed")
    for mutant in sample:
        name = package.name_of(mutant)
        if name in before and (before[name]["by"] or not options.again):
            continue
        tests, spent = order(found, package, mutant, options.seconds)
        began = time.monotonic()
        by = fails(folder, mutant, tests, spent) if tests else ""
        if by and options.check and fails(folder, None, [by], 5.0):
            by = ""  # it fails without the mutant
        before[name] = {
            "mutant": name,
            "line": mutant.line,
            "by": by,
            "tests": len(tests),
            "tests_s": round(spent, 1),
        }
        with folder.verdicts.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(before[name]) + "\n")
        word = "killed  " if by else "survived"
        took = time.monotonic() - began
        print(f"{word} {mutant.path}:{mutant.line} {mutant.what} {by} {took:.1f} s", flush=True)
    ended = [before[name]["by"] for name in map(package.name_of, sample) if name in before]
    print(f"killed {sum(map(bool, ended))} of {len(ended)}")
    return 0


def recorded(folder: Folder) -> None:
    """Bring the map up to date: each test file that is new or changed is run with probes."""
    digests = folder.files()
    known = Map.read(folder.map) if folder.map.exists() else None
    files = [n for n, digest in digests.items() if known is None or known.files.get(n) != digest]
    if not files:
        return
    package = Package(folder)
    folder.probes.mkdir(exist_ok=True)
    (folder.probes / "firsts").write_text(
        "".join(f"{first} {path}\n" for path, first in package.first.items())
    )
    (folder.probes / "hits").write_bytes(bytes(package.count))
    child = os.fork()  # the package with probes is imported there
    if child == 0:
        made = record(folder, files, package.count)
        if known is not None:
            rest = known.without(set(files))
            names, spent = rest.names + made.names, [*rest.spent_s, *made.spent_s]
            made = Map(names, spent, np.vstack([rest.ran, made.ran]), rest.files | made.files)
        made.write(folder.map)
        sys.stdout.flush()
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        raise SystemExit("the tests could not be recorded")


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the campaign is kept")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--only", default="", help="modules whose path contains this")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="most processor time of a mutant's tests [s]"
    )
    parser.add_argument("--again", action="store_true", help="test the survivors anew")
    parser.add_argument(
        "--check", action="store_true", help="run each test that fails without the mutant too"
    )
    options = parser.parse_args()
    folder = Folder(options.folder.resolve())
    folder.prepare(options.again)
    folder.enter()
    recorded(folder)
    return campaign(folder, options)


if __name__ == "__main__":
    sys.exit(main())
