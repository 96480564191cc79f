"""Measure the structure of the source code: size, share of imports, path of one scan, duplicate
names, documentation.

    python tests/benchmarks/structure.py                  # this checkout
    python tests/benchmarks/structure.py --json           # the same for machines
    python tests/benchmarks/structure.py --root CHECKOUT  # another checkout
    python tests/benchmarks/structure.py --list           # what lacks a docstring section

Tokens are those of Python without comments, docstrings and line ends. A constant is a name in
capitals that a module assigns a number; names that are equal but for the underscore at the begin
are one, and several values of a name are several numbers. Private members are names that begin
with one underscore, taken from another module. A compiled module (one with a ``.pyi``) begins with
an underscore too; it is the boundary to C++ that all modules of its package share and that the
oracle tests of docs/developer/kernels.md call, so it counts only where another package imports it;
the test files that import one are counted apart. A long line has over 100 characters. Complexity is
radon's.

Definitions: a module is a Python file of the package. Code lines are lines without blanks, comments
and docstrings. The import share counts the lines of import statements and of ``__all__`` over all
lines. The path of one scan is what runs in the package between two rows of a replay of
``fixtures/tumble.mcap`` (reading, step, score and row; without threads of their own), as seen by
``sys.setprofile``; the figures are the median and the largest value over the scans. A duplicate is
a public class or module-level function name that two modules define. Docstring coverage counts
public functions, methods and classes with arguments beyond ``self`` that have an ``Args`` or
``Attributes`` section.
"""

from __future__ import annotations

import argparse
import ast
import collections
import io
import json
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout to measure")
    parser.add_argument("--json", action="store_true", help="one JSON document")
    parser.add_argument(
        "--list", action="store_true", help="what lacks a docstring section, and modules to merge"
    )
    parser.add_argument("--scan-path", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.scan_path:
        print(json.dumps(scan_path(options.root)))
        return
    if options.list:
        print(*lacking(options.root), *mergeable(options.root), sep="\n")
        return
    found = (
        sizes(options.root)
        | names(options.root)
        | docstrings(options.root)
        | settings(options.root)
    )
    found |= concepts(options.root) | form(options.root) | complexity(options.root)
    found |= traced(options.root)
    if options.json:
        print(json.dumps(found, indent=1))
        return
    for key, value in found.items():
        print(f"{key:<44} {value}")


def modules(root: Path) -> list[Path]:
    """The package's Python files in order."""
    return sorted((root / "avsreplay").rglob("*.py"))


def sizes(root: Path) -> dict:
    """Modules, lines, code lines and the share of imports, in all and by package."""
    total = code = imports = 0
    longest = ("", 0)
    packages: dict[str, list[int]] = collections.defaultdict(lambda: [0, 0])
    importers: dict[str, set[str]] = collections.defaultdict(set)
    known = {module_name(root, path): path for path in modules(root)}
    for path in modules(root):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        lines = text.count("\n")
        total, code, imports = (
            total + lines,
            code + code_lines(text, tree),
            imports + import_lines(tree),
        )
        longest = max(longest, (str(path.relative_to(root)), lines), key=lambda pair: pair[1])
        parts = path.relative_to(root / "avsreplay").parts
        package = packages[parts[0] if len(parts) > 1 else "root"]
        package[0], package[1] = package[0] + 1, package[1] + lines
        for name in imported(tree):
            target = name if name in known else name.rpartition(".")[0]
            if target in known:
                importers[target].add(module_name(root, path))
    single = sum(1 for name in known if len(importers[name]) == 1)
    short = sum(1 for path in modules(root) if path.read_text(encoding="utf-8").count("\n") < 100)
    return {
        "modules": len(known),
        "lines": total,
        "code lines": code,
        "lines of imports and __all__ [%]": round(100.0 * imports / total, 1),
        "modules under 100 lines": short,
        "modules with one importer": single,
        "longest module": f"{longest[0]} ({longest[1]} lines)",
        **{f"  {name} (modules, lines)": f"{n}, {k}" for name, (n, k) in sorted(packages.items())},
    }


def concepts(root: Path) -> dict:
    """Code tokens, numeric constants, parameters and private members, in all and by package."""
    tokens: collections.Counter[str] = collections.Counter()
    constants: collections.Counter[str] = collections.Counter()
    values: dict[str, set[str]] = collections.defaultdict(set)
    wide = 0
    kernels = {p.stem: p.parent for p in (root / "avsreplay").rglob("*.pyi")}
    tests = sorted((root / "tests").glob("test_*.py"))
    for path in modules(root):
        text = path.read_text(encoding="utf-8")
        parts = path.relative_to(root / "avsreplay").parts
        package = parts[0] if len(parts) > 1 else "root"
        tokens[package] += code_tokens(text)
        tree = ast.parse(text)
        for node in tree.body:
            for name, value in numbers_assigned(node):
                constants[package] += 1
                values[name].add(value)
        functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
        wide += sum(parameters(node) >= MANY_PARAMETERS for node in functions)
    return {
        "code tokens": tokens.total(),
        **{f"  {name} (code tokens)": n for name, n in sorted(tokens.items())},
        "numeric constants": constants.total(),
        **{f"  {name} (numeric constants)": n for name, n in sorted(constants.items())},
        "numeric constant names with several values": sum(len(v) > 1 for v in values.values()),
        f"functions with {MANY_PARAMETERS} or more parameters": wide,
        "private members used by other modules": sum(
            private_uses(path, kernels) for path in modules(root)
        ),
        "private members used by tests": sum(private_uses(path, kernels) for path in tests),
        "test files that import a compiled module": sum(
            imports_a_kernel(p, kernels) for p in tests
        ),
    }


MANY_PARAMETERS = 8
NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def code_tokens(text: str) -> int:
    """Tokens without comments, line ends and strings that are statements."""
    found, begins = 0, True
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in NOT_CODE:
            begins = begins or token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
            continue
        found += not (begins and token.type == tokenize.STRING)
        begins = False
    return found


def numbers_assigned(node: ast.stmt):
    """Names in capitals and the text of their values, of an assignment with a number in it."""
    targets = node.targets if isinstance(node, ast.Assign) else []
    targets = [node.target] if isinstance(node, ast.AnnAssign) and node.value else targets
    for target in targets:
        each = zip(target.elts, node.value.elts, strict=False) if _is_tuple(target, node) else ()
        for name, value in each or ((target, node.value),):
            is_number = isinstance(value, (ast.Constant, ast.UnaryOp, ast.BinOp)) and any(
                isinstance(n, ast.Constant) and type(n.value) in (int, float)
                for n in ast.walk(value)
            )
            if isinstance(name, ast.Name) and name.id.lstrip("_").isupper() and is_number:
                yield name.id.lstrip("_"), ast.unparse(value)


def _is_tuple(target: ast.expr, node: ast.stmt) -> bool:
    return isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)


def parameters(node: ast.FunctionDef) -> int:
    """Parameters of a function without self and cls."""
    every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return sum(a.arg not in ("self", "cls") for a in every)


def private_uses(path: Path, kernels: dict[str, Path]) -> int:
    """Imports of private names of the package, and private attributes of what is not self.

    Args:
        path: a module, or a file of tests.
        kernels: the folder of each compiled module, by its name.
    """
    found, is_test = 0, path.name.startswith("test_")
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("avsreplay"):
            for alias in node.names:
                shared = alias.name in kernels and (is_test or kernels[alias.name] in path.parents)
                found += _is_private(alias.name) and not shared
        elif isinstance(node, ast.Attribute) and _is_private(node.attr):
            base = node.value.id if isinstance(node.value, ast.Name) else ""
            found += is_test and base not in ("self", "cls", "other", "os", "sys")
    return found


def imports_a_kernel(path: Path, kernels: dict[str, Path]) -> bool:
    """Return whether a file imports a compiled module."""
    return any(
        isinstance(node, ast.ImportFrom) and any(alias.name in kernels for alias in node.names)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    )


def _is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def form(root: Path) -> dict:
    """Share of long lines, and words of the documentation."""
    lines = [
        line for path in modules(root) for line in path.read_text(encoding="utf-8").splitlines()
    ]
    pages = [root / "README.md", root / "CONTRIBUTING.md", *(root / "docs").rglob("*.md")]
    return {
        "lines over 100 characters [%]": round(
            100.0 * sum(len(line) > 100 for line in lines) / len(lines), 2
        ),
        "words of documentation": sum(len(p.read_text(encoding="utf-8").split()) for p in pages),
    }


def complexity(root: Path) -> dict:
    """Functions above a cyclomatic complexity of 10 and of 20, in all and by package."""
    try:
        from radon.complexity import cc_visit
    except ImportError:
        return {"functions above complexity 10, 20": "radon is not installed"}
    found: dict[str, list[int]] = collections.defaultdict(list)
    for path in modules(root):
        parts = path.relative_to(root / "avsreplay").parts
        blocks = cc_visit(path.read_text(encoding="utf-8"))
        found[parts[0] if len(parts) > 1 else "root"] += [
            block.complexity for block in blocks if block.letter != "C"
        ]
    count = {
        name: [sum(c > most for c in all_) for most in (10, 20)] for name, all_ in found.items()
    }
    every = [sum(each[k] for each in count.values()) for k in (0, 1)]
    return {
        "functions above complexity 10, 20": f"{every[0]}, {every[1]}",
        **{
            f"  {name} (above complexity 10, 20)": f"{a}, {b}"
            for name, (a, b) in sorted(count.items())
        },
    }


def module_name(root: Path, path: Path) -> str:
    """The dotted name of a file."""
    parts = list(path.relative_to(root).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.Module):
    """Names of the package's modules and members that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("avsreplay"):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("avsreplay"))


def code_lines(text: str, tree: ast.Module) -> int:
    """Lines with a token that is neither comment nor part of a docstring."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                skipped.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    layout = (
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    )
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in layout:
            used.update(range(token.start[0], token.end[0] + 1))
    return len(used - skipped)


def import_lines(tree: ast.Module) -> int:
    """Lines of import statements and of ``__all__``."""
    count = 0
    for node in ast.walk(tree):
        exported = isinstance(node, ast.Assign) and any(
            isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets
        )
        if exported or isinstance(node, (ast.Import, ast.ImportFrom)):
            count += (node.end_lineno or node.lineno) - node.lineno + 1
    return count


def names(root: Path) -> dict:
    """Public class and function names that two modules define."""
    defined: dict[str, dict[str, set[str]]] = {"class": {}, "function": {}}
    for path in modules(root):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            kind = (
                "class"
                if isinstance(node, ast.ClassDef)
                else "function"
                if isinstance(node, ast.FunctionDef)
                else ""
            )
            if kind and not node.name.startswith("_"):
                defined[kind].setdefault(node.name, set()).add(module_name(root, path))
    found = {}
    for kind, table in defined.items():
        twice = sorted(name for name, places in table.items() if len(places) > 1)
        found[f"duplicate {kind} names"] = f"{len(twice)} {', '.join(twice)}".strip()
    return found


def docstrings(root: Path) -> dict:
    """Docstrings of public functions and methods: present, with Args, with Raises where they
    raise.
    """
    rows = list(documentation(root))
    takes, exported = (
        [r for r in rows if r["takes"]],
        [r for r in rows if r["takes"] and r["exported"]],
    )
    raising = [r for r in rows if r["raises"]]
    return {
        "public functions and methods": len(rows),
        "  with a docstring": sum(bool(r["text"]) for r in rows),
        "  with arguments": len(takes),
        "  with arguments and an Args section": sum("Args:" in r["text"] for r in takes),
        "exported functions with arguments": len(exported),
        "  with an Args section": sum("Args:" in r["text"] for r in exported),
        "functions that raise": len(raising),
        "  whose docstring says so": sum("Raise" in r["text"] for r in raising),
    }


def documentation(root: Path):
    """What the docstring of each public function or method should say, and its text."""
    api = exports(root)
    for path in modules(root):
        module = module_name(root, path)
        for name, node in public_functions(ast.parse(path.read_text(encoding="utf-8"))):
            yield {
                "where": f"{path.relative_to(root)}:{node.lineno} {node.name}",
                "text": ast.get_docstring(node) or "",
                "takes": any(
                    a.arg not in ("self", "cls") for a in (*node.args.args, *node.args.kwonlyargs)
                ),
                "exported": name in api or module == "avsreplay",
                "raises": any(isinstance(n, ast.Raise) for n in ast.walk(node)),
            }


def lacking(root: Path):
    """Exported functions without an Args section, and functions that raise without saying so."""
    for row in documentation(root):
        if row["takes"] and row["exported"] and "Args:" not in row["text"]:
            yield f"{row['where']}: no Args"
        if row["raises"] and "Raise" not in row["text"]:
            yield f"{row['where']}: no Raises"


def mergeable(root: Path):
    """Modules under 150 lines with one importer, into which they would fit."""
    known = {module_name(root, path): path for path in modules(root)}
    importers: dict[str, set[str]] = collections.defaultdict(set)
    for path in modules(root):
        for name in imported(ast.parse(path.read_text(encoding="utf-8"))):
            target = name if name in known else name.rpartition(".")[0]
            importers[target].add(module_name(root, path))
    lines = {name: path.read_text(encoding="utf-8").count("\n") for name, path in known.items()}
    for name, count in sorted(lines.items()):
        (only,) = importers[name] if len(importers[name]) == 1 else ("",)
        if only and only != name.rpartition(".")[0] and count < 150 and count + lines[only] <= 370:
            yield f"{name} ({count} lines) is imported by {only} only ({lines[only]} lines)"


def exports(root: Path) -> set[str]:
    """Names in the ``__all__`` of the package and of its subpackages."""
    found: set[str] = set()
    for path in (root / "avsreplay").rglob("__init__.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and any(
                isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets
            ):
                found.update(c.value for c in ast.walk(node.value) if isinstance(c, ast.Constant))
    return found


def public_functions(tree: ast.Module):
    """Public module-level functions and methods of public classes: (exported name, node)."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and (
                    method.name == "__init__" or not method.name.startswith("_")
                ):
                    yield node.name, method


def settings(root: Path) -> dict:
    """Settings of a run, and those without a sentence of meaning."""
    code = (
        "import dataclasses, json\nfrom avsreplay.config import RunConfig\nfrom typing import"
        " get_type_hints\ndef walk(cls, prefix=''):\n    hints = get_type_hints(cls)\n    for f in"
        " dataclasses.fields(cls):\n        inner = hints[f.name]\n        if"
        " dataclasses.is_dataclass(inner): yield from walk(inner, prefix + f.name + '.')\n       "
        " else: yield prefix + f.name, bool('setting' in f.metadata and"
        " f.metadata['setting'].doc)\nprint(json.dumps(list(walk(RunConfig))))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False
    )
    if done.returncode:
        return {"settings": "cannot be read: " + done.stderr.strip().splitlines()[-1]}
    table = json.loads(done.stdout)
    return {
        "settings of a run": len(table),
        "  without a declared meaning": sum(1 for _, said in table if not said),
    }


def traced(root: Path) -> dict:
    """The path of one scan, measured in a process of its own so that the right checkout is
    imported.
    """
    command = [
        sys.executable,
        str(Path(__file__).resolve()),
        "--root",
        str(root.resolve()),
        "--scan-path",
    ]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False, env=None)
    if done.returncode:
        return {"path of one scan": "cannot be traced: " + done.stderr.strip().splitlines()[-1]}
    found: dict = json.loads(done.stdout)
    return found


def scan_path(root: Path) -> dict:
    """Files, functions and calls of the package between two rows."""
    sys.path.insert(0, str(root))
    try:
        from avsreplay.run import Job, Run
    except ImportError:  # the name in earlier versions
        from avsreplay.job import Job, Run

    package = str(root / "avsreplay")
    rows = Run(Job(source=root / "fixtures" / "tumble.mcap", prefetch=0)).rows()
    next(rows)
    counts = []
    while (count := calls_of_next(rows, package)) is not None:
        counts.append(count)
    median = [sorted(column)[len(counts) // 2] for column in zip(*counts, strict=True)]
    most = [max(column) for column in zip(*counts, strict=True)]
    labels = ("files", "functions", "calls", "depth")
    return {
        f"one scan: {label} (median, most)": f"{a}, {b}"
        for label, a, b in zip(labels, median, most, strict=True)
    }


def calls_of_next(rows, package: str):
    """Files, functions, calls and depth of the package while the next row is made; None at
    the end.
    """
    files: set[str] = set()
    functions: set[tuple[str, int]] = set()
    calls = depth = deepest = 0

    def watch(frame, event, _arg):
        nonlocal calls, depth, deepest
        code = frame.f_code
        if not code.co_filename.startswith(package):
            return
        if event == "call":
            calls, depth = calls + 1, depth + 1
            deepest = max(deepest, depth)
            files.add(code.co_filename)
            functions.add((code.co_filename, code.co_firstlineno))
        elif event == "return":
            depth -= 1

    sys.setprofile(watch)
    try:
        row = next(rows, None)
    finally:
        sys.setprofile(None)
    return None if row is None else (len(files), len(functions), calls, deepest)


if __name__ == "__main__":
    main()
