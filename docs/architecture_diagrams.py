"""Draws the diagrams in developer/architecture.md from the source code:
``python docs/architecture_diagrams.py [--check]``.

The package diagram shows every import between the layers of the import contract in pyproject.toml,
without the edges that follow from others. The second diagram lists the calls to the stages in
``pipeline.step`` in their order.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "developer" / "architecture.md"


def layers() -> list[list[str]]:
    """The modules of each layer, top layer first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]
    found = next(c["layers"] for c in contracts["contracts"] if c["type"] == "layers")
    return [[name.strip().removeprefix("avsreplay.") for name in line.split("|")] for line in found]


def imports(module: str) -> set[str]:
    """The root modules and packages that a root module or package imports, type checking
    included.
    """
    path = ROOT / "avsreplay" / module
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    found: set[str] = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.ImportFrom)
                and node.module
                and node.module.startswith("avsreplay.")
            ):
                found.add(node.module.split(".")[1])
            elif isinstance(node, ast.ImportFrom) and node.module == "avsreplay":
                found.update(alias.name for alias in node.names)
    return found - {module}


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """The edges without those that a longer way implies."""

    def reach(start: str) -> set[str]:
        return set().union(*({n} | reach(n) for n in edges[start])) if edges[start] else set()

    return {
        a: {b for b in found if not any(b in reach(c) for c in found - {b})}
        for a, found in edges.items()
    }


def package_diagram() -> str:
    """A Mermaid flow chart: one box a layer, an arrow for an import."""
    names = [name for layer in layers() for name in layer]
    edges = reduced({name: imports(name) & set(names) for name in names})
    lines = ["```mermaid", "flowchart TD"]
    for k, layer in enumerate(layers()):
        if len(layer) > 1:
            lines += [
                f"  subgraph layer{k}[ ]",
                "    direction LR",
                *(f"    {name}" for name in layer),
                "  end",
            ]
        else:
            lines.append(f"  {layer[0]}")
    lines += [f"  {a} --> {b}" for a in names for b in names if b in edges[a]]
    return "\n".join([*lines, "```"])


def scan_diagram() -> str:
    """A Mermaid sequence diagram: the calls from ``step`` to the stages, in the order of the
    source.
    """
    tree = ast.parse((ROOT / "avsreplay" / "pipeline.py").read_text(encoding="utf-8"))
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    stages = next(
        node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Stages"
    )
    kinds = {
        n.target.id: ast.unparse(n.annotation) for n in stages.body if isinstance(n, ast.AnnAssign)
    }
    calls = list(stage_calls(functions["step"], functions, kinds))
    used = list(dict.fromkeys(stage for stage, _ in calls))
    lines = ["```mermaid", "sequenceDiagram", "  participant step as pipeline.step"]
    lines += [f"  participant {stage} as {kinds[stage]}" for stage in used]
    lines += [f"  step->>{stage}: {method}()" for stage, method in calls]
    return "\n".join([*lines, "```"])


def stage_calls(function, functions, kinds):
    """(stage, method) of every call to a stage, helper functions of the module included."""
    calls = [node for node in ast.walk(function) if isinstance(node, ast.Call)]
    for call in sorted(calls, key=lambda node: (node.end_lineno, node.end_col_offset)):
        text = ast.unparse(call.func).replace(
            "SensorFrame(stages.registrar, scan.sensor)", "stages.registrar"
        )
        words = text.split(".")
        if len(words) == 1 and words[0] in functions and words[0] != "fold":
            yield from stage_calls(functions[words[0]], functions, kinds)
        elif len(words) == 3 and words[0] == "stages" and words[1] in kinds:
            yield words[1], words[2]


def page() -> str:
    """The page with its diagrams drawn again."""
    text = PAGE.read_text(encoding="utf-8")
    for name, diagram in (("packages", package_diagram()), ("scan", scan_diagram())):
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        before, rest = text.split(begin)
        text = f"{before}{begin}\n{diagram}\n{end}{rest.split(end)[1]}"
    return text


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(
            0
            if page() == PAGE.read_text(encoding="utf-8")
            else "docs/developer/architecture.md is not current"
        )
    PAGE.write_text(page(), encoding="utf-8")
