"""The docs hold: marked blocks run, every command line parses, every link leads somewhere, the site builds."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
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
def folder(tmp_path, request):
    """An empty folder with the short recording of the fixtures, for the tutorial of an own log with its bag."""
    shutil.copy(ROOT / "fixtures" / "tumble.mcap", tmp_path / "tumble.mcap")
    page = getattr(getattr(request.node, "callspec", None), "params", {}).get("page")
    if page is not None and page.name == "your-own-log.md":
        subprocess.run([sys.executable, ROOT / "docs" / "examples" / "own_bag.py", tmp_path], check=True)
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


def test_the_tutorial_of_an_own_log_gives_the_options_that_it_uses(tmp_path, cli):
    subprocess.run([sys.executable, ROOT / "docs" / "examples" / "own_bag.py", tmp_path], check=True)
    said = cli("info", "own.bag", "--model", "target.stl", "--json", cwd=tmp_path)
    options = " ".join(check["option"] for check in json.loads(said.out)["checks"] if check["option"])
    text = (ROOT / "docs" / "your-own-log.md").read_text(encoding="utf-8")
    assert f"run own.bag --model target.stl {options} -o results/ --report" in text
    done = cli("run", "own.bag", "--model", "target.stl", *options.split(), "--json", cwd=tmp_path)
    rows = json.loads(done.out)["rows"]
    assert sum(row["gamma"] for row in rows) >= 0.9 * len(rows) == 0.9 * 42
    assert max(row["pos_err_m"] for row in rows) < 0.01
    assert max(row["rot_err_deg"] for row in rows) < 0.5


def _installed(package, site):
    """Put a package of one module where an installer puts it, with its entry points."""
    project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))
    (module,) = project["tool"]["setuptools"]["py-modules"]
    info = site / f"{module}-{project['project']['version']}.dist-info"
    info.mkdir(parents=True)
    shutil.copy(package / f"{module}.py", site)
    head = f"Metadata-Version: 2.1\nName: {project['project']['name']}\nVersion: {project['project']['version']}\n"
    (info / "METADATA").write_text(head, encoding="utf-8")
    groups = project["project"]["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups]
    (info / "entry_points.txt").write_text("".join(lines), encoding="utf-8")


def test_the_back_end_of_the_tutorial_keeps_the_contract(tmp_path):
    _installed(ROOT / "docs" / "examples" / "own_backend", tmp_path / "site")
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", "backends", "--check", "own"],
        env={**_environment(), "PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


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
