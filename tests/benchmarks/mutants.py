"""Whether tests fail where the code is wrong: ``python tests/benchmarks/mutants.py --seed 1 --count
60``.

Each mutant changes one operator, comparison, sign, number or condition of one module, chosen by the
seed among all that the syntax trees of the package contain. The test files of its area run in a
copy of the checkout: those whose name begins with the package or the package and the module. Prints
one line per mutant, then the share that was killed; survivors may be equivalent to the code.

With ``--record FILE`` each verdict is a line of JSON in the file, and a campaign that was ended
continues after the mutants that are in it: those whose line of code is the same.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 600  # of the tests of a mutant; one that does not end is killed
SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.USub: ast.UAdd,
}


@dataclass(frozen=True)
class Mutant:
    """One change: the module, the number of its node in the tree, line, and text of the line."""

    path: Path
    number: int
    line: int
    what: str


class _Change(ast.NodeTransformer):
    """Counts what can be changed; changes number ``wanted``."""

    def __init__(self, wanted: int = -1) -> None:
        self.wanted, self.found = wanted, list[tuple[int, str]]()

    def _is_wanted(self, node: ast.AST, what: str) -> bool:
        self.found.append((getattr(node, "lineno", 0), what))
        return len(self.found) - 1 == self.wanted

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        return self._operator(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        return self._operator(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        return self._operator(node)

    def _operator(self, node: ast.BinOp | ast.BoolOp | ast.UnaryOp) -> ast.AST:
        other = SWAPPED.get(type(node.op))
        if other and self._is_wanted(node, f"{type(node.op).__name__} to {other.__name__}"):
            node.op = other()  # type: ignore[assignment]
        return self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        other = SWAPPED.get(type(node.ops[0]))
        if other and self._is_wanted(node, f"{type(node.ops[0]).__name__} to {other.__name__}"):
            node.ops[0] = other()  # type: ignore[call-overload]
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if type(node.value) in (int, float) and self._is_wanted(node, f"{node.value} plus one"):
            return ast.copy_location(ast.Constant(node.value + 1), node)
        if type(node.value) is bool and self._is_wanted(node, f"not {node.value}"):
            return ast.copy_location(ast.Constant(not node.value), node)
        return node

    def visit_If(self, node: ast.If) -> ast.AST:
        if self._is_wanted(node, "condition negated"):
            node.test = ast.copy_location(ast.UnaryOp(ast.Not(), node.test), node.test)
        return self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is not None:
            node.value = self.visit(node.value)
        return node


def mutants(path: Path) -> Iterator[Mutant]:
    """Every change of a module."""
    change = _Change()
    change.visit(ast.parse(path.read_text(encoding="utf-8")))
    for number, (line, what) in enumerate(change.found):
        yield Mutant(path.relative_to(ROOT), number, line, what)


def tests_of(path: Path, folder: Path) -> list[str]:
    """The test files of the area of a module: its own ones, else those of its package."""
    package = path.parent.name if path.parent.name != "avsreplay" else ""
    own = "_".join(filter(None, (package, path.stem)))
    for name in (own, package):
        found = sorted((folder / "tests").glob(f"test_{name}*.py")) if name else []
        if found and name == own and package:
            return [str(f) for f in found] + ["tests/test_golden.py"]
        if found:
            return [*map(str, found)]
    return ["tests/test_golden.py", "tests/test_run.py", "tests/test_cli_results.py"]


def passes(tests: list[str], folder: Path, slow: bool) -> bool:
    """Whether tests pass with the copy of the package; tests that do not end fail."""
    chosen = () if slow else ("-m", "not slow")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *chosen]
    try:
        done = subprocess.run(
            [*command, *tests],
            cwd=folder,
            env=_environment(folder),
            capture_output=True,
            timeout=LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def killed(mutant: Mutant, tests: list[str], folder: Path, slow: bool) -> bool:
    """Whether a test fails with the mutant."""
    place = site_of(folder) / mutant.path
    text = place.read_text(encoding="utf-8")
    tree = _Change(mutant.number).visit(ast.parse(text))
    place.write_text(ast.unparse(ast.fix_missing_locations(tree)) + "\n", encoding="utf-8")
    try:
        return not passes(tests, folder, slow)
    finally:
        place.write_text(text, encoding="utf-8")


def verdicts(record: Path | None) -> dict[str, bool]:
    """The verdicts of an earlier campaign, by the name of the mutant."""
    if record is None or not record.is_file():
        return {}
    lines = map(json.loads, record.read_text(encoding="utf-8").splitlines())
    return {line["mutant"]: line["killed"] for line in lines}


def named(mutant: Mutant) -> str:
    """Path, code of its line, number of the change in the module, and what is changed."""
    text = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()[mutant.line - 1]
    return f"{mutant.path} [{text.strip()}] {mutant.number} {mutant.what}"


def site_of(folder: Path) -> Path:
    """The folder beside a copy of the checkout from which its tests import the package: they do not
    import that of the checkout.
    """
    return folder.parent / "site"


def _copied(folder: Path) -> None:
    """Copy the checkout, and the package with the compiled modules of the installed one. An
    editable install would import the original; every interpreter that is started removes what does
    this.
    """
    left_out = shutil.ignore_patterns(".git", "build", ".mypy_cache", "__pycache__")
    shutil.copytree(ROOT, folder, ignore=left_out)
    shutil.copytree(ROOT / "avsreplay", site_of(folder) / "avsreplay", ignore=left_out)
    for each in metadata.files("avsreplay") or ():
        if each.suffix == ".so":
            shutil.copy(str(each.locate()), site_of(folder) / each)
    (site_of(folder) / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [each for each in sys.meta_path"
        " if not type(each).__module__.startswith('_editable')]\n",
        encoding="utf-8",
    )


def _environment(folder: Path) -> dict[str, str]:
    path = str(site_of(folder))
    return {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}


def _is_imported(folder: Path) -> bool:
    """Whether the tests import the copy of the package; an editable install has another place."""
    test = folder / "tests" / "test_of_the_copy.py"
    place = str(site_of(folder))
    text = f"import avsreplay\ndef test_place(): assert avsreplay.__file__.startswith({place!r})\n"
    test.write_text(text, encoding="utf-8")
    try:
        return passes([str(test)], folder, slow=True)
    finally:
        test.unlink()


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--only", default="", help="modules whose path contains this")
    parser.add_argument("--slow", action="store_true", help="run the slow tests of the area too")
    parser.add_argument("--record", type=Path, help="file of verdicts, which is continued")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    options = parser.parse_args()
    paths = sorted(p for p in ROOT.glob("avsreplay/**/*.py") if options.only in str(p))
    everything = [mutant for path in paths for mutant in mutants(path)]
    sample = random.Random(options.seed).sample(everything, min(options.count, len(everything)))
    print(f"{len(sample)} of {len(everything)} mutants of {len(paths)} modules", flush=True)
    before, ended = verdicts(options.record), list[bool]()
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "avsreplay"
        _copied(folder)
        if not options.list and not _is_imported(folder):
            print("the copy of the checkout is not what Python imports", file=sys.stderr)
            return 2
        sound: dict[tuple[str, ...], bool] = {}  # tests of an area pass without a mutant
        for mutant in sample:
            where = f"{mutant.path}:{mutant.line} {mutant.what}"
            if options.list:
                print(where)
                continue
            name = named(mutant)
            if name in before:
                ended.append(before[name])
                continue
            tests = tests_of(mutant.path, folder)
            if tuple(tests) not in sound:
                sound[tuple(tests)] = passes(tests, folder, options.slow)
            if not sound[tuple(tests)]:
                print(f"no verdict, as its tests fail without it: {where}", flush=True)
                continue
            ended.append(killed(mutant, tests, folder, options.slow))
            print(f"{'killed  ' if ended[-1] else 'survived'} {where}", flush=True)
            if options.record:
                verdict = {"mutant": name, "line": mutant.line, "killed": ended[-1]}
                with options.record.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(verdict) + "\n")
    if ended:
        print(f"killed {sum(ended)} of {len(ended)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
