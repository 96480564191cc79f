"""The docs hold: marked blocks run, every command line parses, every link leads somewhere, the site builds."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest

from avsreplay.cli import SUMMARIES, group

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"(?:<!-- (?P<mark>(?:run|file)[^>]*?) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```$", re.M | re.S)


def _blocks(page):
    return [m.groupdict() for m in FENCE.finditer(page.read_text(encoding="utf-8"))]


MARKED = [page for page in PAGES if any(block["mark"] for block in _blocks(page))]


def _name(page):
    return str(page.relative_to(ROOT))


@pytest.fixture
def folder(tmp_path):
    """An empty folder with the short recording of the fixtures in it."""
    shutil.copy(ROOT / "fixtures" / "tumble.mcap", tmp_path / "tumble.mcap")
    return tmp_path


def _environment():
    return {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
    }


def _run(block, folder):
    program = ["bash", "-euo", "pipefail", "-c"] if block["language"] == "sh" else [sys.executable, "-c"]
    done = subprocess.run(
        [*program, block["text"]],
        cwd=folder,
        env=_environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    expected = int(block["mark"].partition("exit")[2] or 0)
    assert done.returncode == expected, f"{block['text']}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


@pytest.mark.parametrize("page", MARKED, ids=_name)
def test_marked_blocks_run_in_order(page, folder):
    for block in _blocks(page):
        kind, _, rest = (block["mark"] or "").partition(":")
        if kind == "file":
            (folder / rest.strip()).write_text(block["text"], encoding="utf-8")
        elif kind == "run":
            _run(block, folder)


def test_something_is_marked():
    assert {"docs/index.md", "docs/ci.md"} <= {_name(page) for page in MARKED}


def _command_lines(page):
    for block in _blocks(page):
        if block["language"] in ("sh", "bash", "console"):
            for line in block["text"].replace("\\\n", " ").splitlines():
                for part in re.split(r"&&|\|\||;|\|", re.sub(r"\d?>\s*\S+", "", line.removeprefix("$ "))):
                    words = shlex.split(part, comments=True)
                    if words[:1] == ["avsreplay"]:
                        yield words[1:]


LINES = [(page, words) for page in PAGES for words in _command_lines(page)]


@pytest.mark.parametrize(("page", "words"), LINES, ids=lambda v: _name(v) if isinstance(v, Path) else " ".join(v))
def test_every_command_line_parses(page, words):
    if words[:1] and words[0] in SUMMARIES:
        command = group.get_command(click.Context(group), words[0])
        try:
            command.make_context(words[0], list(words[1:]))
        except click.exceptions.Exit:
            return
    else:
        assert words[0] in ("--help", "-h", "--version", "COMMAND")


def _links(page):
    text = re.sub(r"```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    return [target for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target]


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page):
    for target in _links(page):
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), f"{_name(page)} links to {target}"
        if anchor and found.suffix == ".md":
            assert anchor in _anchors(found), f"{_name(page)} links to {target}"


def _anchors(page):
    heads = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def test_the_notebook_runs_from_top_to_bottom(folder):
    notebook = json.loads((ROOT / "docs" / "first-steps.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    code = "\n".join("".join(cell["source"]) for cell in cells)
    _run({"language": "python", "text": code, "mark": "run"}, folder)
    assert (folder / "notebook.html").exists()


def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("material", reason="mkdocs-material is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        env={**_environment(), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "site" / "ci" / "index.html").exists()
