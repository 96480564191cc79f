"""Changes of the package in memory: ``install`` makes the interpreter import modules with a mutant,
or with probes that record which statements run. No file is changed.

Interpreters that a test starts import the same, because they inherit two environment variables:
``MUTANT`` (path:number) and ``PROBES`` (a folder with ``hits``, one byte per statement, mapped into
all processes of a run).
"""

from __future__ import annotations

import ast
import hashlib
import marshal
import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path

MUTANT, PROBES = "AVS_CAMPAIGN_MUTANT", "AVS_CAMPAIGN_PROBES"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
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
    """One change of a module.

    Attributes:
        path: module, relative to the folder that holds the package.
        number: of the change among those of the module.
        line: number of the line.
        what: what is changed.
        statement: number of the statement, or lambda, that runs it.
        deferred: whether that is inside a function; otherwise it runs with the import.
        names: what a statement outside of functions defines, then the classes that it is in.
    """

    path: str
    number: int
    line: int
    what: str
    statement: int
    deferred: bool
    names: tuple[str, ...]


class _Walk(ast.NodeTransformer):
    """Numbers the changes and statements of a module; makes change ``wanted`` or adds probes."""

    def __init__(self, path: str = "", wanted: int = -1, first_probe: int | None = None) -> None:
        self.path, self.wanted, self.first = path, wanted, first_probe
        self.found, self.statements = list[Mutant](), 0
        self.named: dict[int, set[str]] = {}
        self._inside, self._functions, self._defined = [0], 0, [()]

    def _numbered(self, node: ast.stmt | ast.Lambda) -> int:
        self.statements += 1
        number = self.statements - 1
        self.named[number] = _names(node)
        return number

    def visit(self, node: ast.AST) -> ast.AST:
        if not isinstance(node, (ast.stmt, ast.Lambda)):
            return super().visit(node)
        self._inside.append(self._numbered(node))
        at_top = not self._functions and not isinstance(node, ast.Lambda)
        outer = self._defined[-1]
        self._defined.append((*_defined(node), *outer) if at_top else outer)
        changed = super().visit(node)
        self._defined.pop()
        number = self._inside.pop()
        if self.first is None or isinstance(node, ast.Lambda):
            return changed
        return [_probe(self.first + number, node), changed]  # type: ignore[return-value]

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.AST:
        node.decorator_list = [self.visit(each) for each in node.decorator_list]
        node.args = self.visit(node.args)
        self._functions += 1
        body = _body(node)
        node.body[len(node.body) - len(body) :] = self._block(body)
        self._functions -= 1
        return node

    visit_FunctionDef = visit_AsyncFunctionDef = _function

    def visit_Lambda(self, node: ast.Lambda) -> ast.AST:
        node.args = self.visit(node.args)
        self._functions += 1
        node.body = self.visit(node.body)
        self._functions -= 1
        if self.first is not None:
            hit = _probe(self.first + self._inside[-1], node.body).value
            node.body = ast.copy_location(ast.BoolOp(ast.Or(), [hit, node.body]), node.body)
            ast.fix_missing_locations(node.body)
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.decorator_list = [self.visit(each) for each in node.decorator_list]
        body = _body(node)
        node.body[len(node.body) - len(body) :] = self._block(body)
        return node

    def visit_Module(self, node: ast.Module) -> ast.AST:
        at = 1 + max(
            [-1, *(i for i, each in enumerate(node.body) if _is_first(each, i))]
        )  # docstring and imports from the future stay first
        node.body[at:] = self._block(node.body[at:])
        return node

    def _block(self, body: list[ast.stmt]) -> list[ast.stmt]:
        out: list[ast.stmt] = []
        for each in body:
            made = self.visit(each)
            out.extend(made if isinstance(made, list) else [made])
        return out

    def _is_wanted(self, node: ast.AST, what: str) -> bool:
        line, number = getattr(node, "lineno", 0), len(self.found)
        inside, deferred = self._inside[-1], bool(self._functions)
        self.found.append(
            Mutant(self.path, number, line, what, inside, deferred, self._defined[-1])
        )
        return number == self.wanted

    def _operator(self, node: ast.BinOp | ast.BoolOp | ast.UnaryOp) -> ast.AST:
        other = SWAPPED.get(type(node.op))
        if other and self._is_wanted(node, f"{type(node.op).__name__} to {other.__name__}"):
            node.op = other()  # type: ignore[assignment]
        return self.generic_visit(node)

    visit_BinOp = visit_BoolOp = visit_UnaryOp = _operator

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

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return node  # no changes of annotations


def _is_first(node: ast.stmt, at: int) -> bool:
    docstring = at == 0 and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return docstring or (isinstance(node, ast.ImportFrom) and node.module == "__future__")


def _body(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> list[ast.stmt]:
    """Its statements after the docstring."""
    return node.body[1:] if _is_first(node.body[0], 0) else node.body


def _probe(number: int, node: ast.AST) -> ast.Expr:
    """``_avs_hit(number)``, which returns None."""
    call = ast.Call(ast.Name("_avs_hit", ast.Load()), [ast.Constant(number)], [])
    made = ast.copy_location(ast.Expr(call), node)
    for each in ast.walk(made):
        ast.copy_location(each, node)
    return made


def _names(node: ast.AST) -> set[str]:
    """The identifiers that a node mentions, without those of statements inside it."""
    kinds = {ast.Name: "id", ast.Attribute: "attr", ast.keyword: "arg"}
    own = getattr(node, kinds.get(type(node), ""), None)
    inside = (each for each in ast.iter_child_nodes(node) if not isinstance(each, ast.stmt))
    return set().union({own} - {None}, *map(_names, inside))


def _defined(node: ast.stmt) -> list[str]:
    """What a statement outside of functions defines."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return [node.name]
    if isinstance(node, (ast.Assign, ast.AnnAssign)):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return [each.id for t in targets for each in ast.walk(t) if isinstance(each, ast.Name)]
    return []


@dataclass(frozen=True)
class Module:
    """What can be changed in a module, and its statements.

    Attributes:
        path: relative to the folder that holds the package.
        mutants: every change.
        statements: their number.
        named: identifiers that each statement mentions (those with a body: none).
    """

    path: str
    mutants: tuple[Mutant, ...]
    statements: int
    named: dict[int, set[str]]


def modules(folder: Path) -> Iterator[Module]:
    """The modules of the package in a folder, sorted by path."""
    for path in sorted(folder.glob("avsreplay/**/*.py")):
        walk = _Walk(str(path.relative_to(folder)))
        walk.visit(ast.parse(path.read_text(encoding="utf-8")))
        yield Module(walk.path, tuple(walk.found), walk.statements, walk.named)


def changed(text: str, number: int) -> ast.AST:
    """The tree of a module with a change."""
    return ast.fix_missing_locations(_Walk(wanted=number).visit(ast.parse(text)))


def probed(text: str, first: int) -> ast.AST:
    """The tree of a module with a probe before every statement, numbered from ``first`` on."""
    return ast.fix_missing_locations(_Walk(first_probe=first).visit(ast.parse(text)))


def install() -> None:
    """Import the package with the mutant or the probes that the environment names."""
    package = Path(__file__).parent / "avsreplay"
    mutant, probes = os.environ.get(MUTANT), os.environ.get(PROBES)
    if not mutant and not probes:
        return
    ordinary = SourceFileLoader.get_code
    wanted, _, number = (mutant or ":").rpartition(":")
    firsts = dict[str, int]()
    if probes:
        import builtins

        with (Path(probes) / "hits").open("r+b") as file:
            hits = mmap.mmap(file.fileno(), 0)
        set_byte = hits.__setitem__
        builtins._avs_hit = lambda at: set_byte(at, 1)  # type: ignore[attr-defined]
        for line in (Path(probes) / "firsts").read_text().splitlines():
            first, path = line.split(" ", 1)
            firsts[path] = int(first)

    def get_code(self: SourceFileLoader, name: str) -> object:
        path = Path(self.path)
        if package not in path.parents:
            return ordinary(self, name)
        relative = str(path.relative_to(package.parent))
        if relative == wanted:
            text = path.read_text(encoding="utf-8")
            return compile(changed(text, int(number)), self.path, "exec", dont_inherit=True)
        if relative in firsts:
            return _kept(Path(probes or ""), path, firsts[relative])
        return ordinary(self, name)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign, assignment]


def _kept(folder: Path, path: Path, first: int) -> object:
    """The code of a module with probes, which is compiled once for all processes."""
    text = path.read_text(encoding="utf-8")
    name = hashlib.sha256(f"{path}\0{first}\0{text}".encode()).hexdigest()[:24]
    place = folder / f"{name}-{int(not __debug__)}"
    if place.exists():
        return marshal.loads(place.read_bytes())
    code = compile(probed(text, first), str(path), "exec", dont_inherit=True)
    made = place.with_suffix(f".{os.getpid()}")
    made.write_bytes(marshal.dumps(code))
    made.replace(place)
    return code
