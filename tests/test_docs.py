"""Documentation: marked blocks run, command lines parse, links lead somewhere, the site
builds.
"""

from __future__ import annotations

import importlib.util
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

from avsreplay.cli.main import SUMMARIES, group

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(
    r"(?:<!-- (?P<mark>(?:run|file)[^>]*?) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.M | re.S,
)


def _blocks(page):
    return [m.groupdict() for m in FENCE.finditer(page.read_text(encoding="utf-8"))]


MARKED = [page for page in PAGES if any(block["mark"] for block in _blocks(page))]
QUICK = {"docs/index.md"}
SHORT = {
    "AVSREPLAY_RECORD_DURATION_S": "8",  # ends before the approach: no flights are simulated
    "AVSREPLAY_SWEEP_LIMIT": "2",
}  # of what a page simulates itself
ELSEWHERE = {  # command of a block that needs more than a folder: the test that runs such a command
    "avsreplay run long.mcap": (
        "test_checkpoint.py::test_a_continued_run_has_the_bytes_of_a_run_without_interruption"
    ),
    "avsreplay run tumble.mcap --rerun": "test_run.py::test_a_run_is_written_for_rerun",
    "avsreplay sweep docs/campaigns/blackouts.toml -o": (
        "test_sweep_run.py::test_a_worker_killed_in_the_middle"
    ),
    "avsreplay sweep docs/campaigns/blackouts.toml --run": (
        "test_sweep_run.py::test_the_worst_run_is_made_again"
    ),
    "avsreplay run $D/stanford-dragon": "test_real.py::test_the_folder_itself_runs",
    "avsreplay run $D/primesense-bunny": "test_real.py::test_the_depth_views_of_a_figure",
    "avsreplay run toss.csv": "test_real.py::test_gravity_is_found",
    "avsreplay run $D/stanford-bunny": "test_real.py::test_every_bunny_scan",
    "avsreplay model $D/stanford-bunny": "test_reconstruct.py::test_scans_of_the_bunny_that",
    "avsreplay run milk": "test_real.py::test_a_carton_in_a_depth_scene",
    "avsreplay run $D/ros1-bags": "test_real.py::test_raw_packets_are_named",
    "avsreplay benchmark --quick -o quick/": (
        "test_benchmark_run.py::test_one_table_shows_each_entry_and_the_scenario_without_data"
    ),
    "pip install docs/examples/own_entry": (
        "test_docs.py::test_the_entry_of_the_tutorial_has_60_lines_and_gets_rows_in_the_table"
    ),
    "pip install docs/examples/own_backend": (
        "test_docs.py::test_the_back_end_of_the_tutorial_keeps_the_contract"
    ),
    "pip install docs/examples/own_estimator": (
        "test_docs.py::test_the_estimator_of_the_tutorial_keeps_the_contract"
    ),
    "python3 -m venv .venv": ".ci/run",
    'pip install -q "$(ls dist/*.whl)[test]"': ".ci/run",
}


def _name(page):
    return str(page.relative_to(ROOT))


def _parameter(page):
    return pytest.param(
        page, id=_name(page), marks=() if _name(page) in QUICK else pytest.mark.slow
    )


@pytest.mark.slow
def test_the_table_of_blackouts_is_that_of_its_command():
    sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
    import plan_blackout

    assert plan_blackout.STARTS_S[-1] == 14.0
    (line,) = plan_blackout.table(plan_blackout.STARTS_S[-1:])
    page = plan_blackout.PAGE.read_text(encoding="utf-8")
    assert line in page.splitlines()
    lines = page.split(plan_blackout.HEAD + "\n")[1].split("\n\n")[0].splitlines()
    assert plan_blackout.written(lines, page) == page
    assert plan_blackout.written(["| other |"], page) != page


def _own_bag(folder):
    subprocess.run([sys.executable, ROOT / "docs" / "examples" / "own_bag.py", folder], check=True)


def _own_backend(folder):
    _installed(ROOT / "docs" / "examples" / "own_backend", folder / "site")


def _own_estimator(folder):
    _installed(ROOT / "docs" / "examples" / "own_estimator", folder / "site")


def _poses(folder):
    """Poses of the recording as TUM and CSV files."""
    from avsreplay.log import open_source

    with open_source(folder / "tumble.mcap") as source:
        poses = source.truth_poses()
    lines = [(t, *pose.t, *pose.q) for t, pose in poses]
    (folder / "flight.tum").write_text(
        "".join(f"{t * 1e-9:.9f} {x} {y} {z} {a} {b} {c} {d}\n" for t, x, y, z, a, b, c, d in lines)
    )
    rows = (f"{t},{x},{y},{z},{a},{b},{c},{d}\n" for t, x, y, z, a, b, c, d in lines)
    (folder / "flight.csv").write_text("t_ns,x,y,z,qx,qy,qz,qw\n" + "".join(rows))


def _scenarios(folder):
    """A scenario with a moving camera, its recording, and a log to inject faults into."""
    text = (
        "duration_s = 6.0\nrate_hz = 3.0\n[motion]\nrate_radps = [0.06, 0.064,"
        " -0.048]\n[scanner]\nrays = [40, 40]\n"
    )
    (folder / "scenario.toml").write_text(text)
    (folder / "moving.toml").write_text(text + "[camera]\nvelocity_mps = [0.02, 0.0, 0.0]\n")
    subprocess.run(
        [sys.executable, "-m", "avsreplay", "record", "moving.toml", "-o", "x.mcap"],
        cwd=folder,
        check=True,
    )
    for name in ("y.mcap", "growing.mcap"):
        shutil.copy(folder / "tumble.mcap", folder / name)


def _campaigns(folder):
    shutil.copytree(ROOT / "docs" / "campaigns", folder / "docs" / "campaigns")


def _without_log(folder):
    (folder / "tumble.mcap").unlink()


def _clone(folder):
    (folder / "docs" / "examples").mkdir(parents=True)
    shutil.copy(ROOT / "docs" / "examples" / "own_bag.py", folder / "docs" / "examples")


NEEDS = {
    "README.md": (_own_bag, _without_log),
    "docs/index.md": (_without_log,),
    "docs/your-own-log.md": (_clone,),
    "docs/your-own-backend.md": (_own_backend, _without_log),
    "docs/your-own-estimator.md": (_own_estimator, _without_log),
    "docs/poses.md": (_poses, _own_bag),
    "docs/report.md": (_scenarios,),
    "docs/scenario.md": (_scenarios,),
    "docs/results.md": (_without_log,),
    "docs/sweep.md": (_campaigns,),
}


@pytest.fixture
def folder(tmp_path, request):
    """A folder with the short recording of the fixtures, and the files that a page assumes."""
    shutil.copy(ROOT / "fixtures" / "tumble.mcap", tmp_path / "tumble.mcap")
    page = getattr(getattr(request.node, "callspec", None), "params", {}).get("page")
    for prepare in NEEDS.get(_name(page), ()) if page is not None else ():
        prepare(tmp_path)
    return tmp_path


def _environment(folder=None):
    path = [str(folder / "site"), os.environ.get("PYTHONPATH", "")] if folder else []
    return {
        **os.environ,
        **({"PYTHONPATH": os.pathsep.join(filter(None, path))} if path else {}),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
    }


def _run(block, folder):
    program = (
        ["bash", "-euo", "pipefail", "-c"] if block["language"] == "sh" else [sys.executable, "-c"]
    )
    done = subprocess.run(
        [*program, block["text"]],
        cwd=folder,
        env={**_environment(folder), **SHORT},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    expected = int(block["mark"].partition("exit")[2] or 0)
    assert done.returncode == expected, (
        f"{block['text']}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    )


@pytest.mark.parametrize("page", [_parameter(page) for page in MARKED])
def test_marked_blocks_run_in_order(page, folder):
    for block in _blocks(page):
        kind, _, rest = (block["mark"] or "").partition(":")
        if kind == "file":
            (folder / rest.strip()).write_text(block["text"], encoding="utf-8")
        elif kind == "run" and not _tool(block):
            _run(block, folder)


def _tool(block):
    """The program or module of others that a block needs, "" for none: ``run: needs NAME``."""
    return (block["mark"] or "").partition("needs ")[2]


RECIPES = ROOT / "docs" / "recipes.md"


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", [b for b in _blocks(RECIPES) if _tool(b)], ids=lambda block: _tool(block)
)
def test_a_recipe_runs_with_its_tool(block, folder):
    tool = _tool(block)
    if not shutil.which(tool) and importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed")
    _run(_blocks(RECIPES)[0], folder)
    _run(block, folder)


def _commands(block):
    lines = [line.strip() for line in block["text"].replace("\\\n", " ").splitlines()]
    return [line for line in lines if re.match(r"(avsreplay|pip|python3? -m venv)\b", line)]


def test_every_block_with_a_command_is_run_by_a_test():
    """Marked blocks are run here; the others name the test that runs such a command."""
    blocks = [
        (page, block) for page in PAGES if page.name != "CONTRIBUTING.md" for block in _blocks(page)
    ]
    shown = [
        (page, block)
        for page, block in blocks
        if block["language"] in ("", "sh", "bash", "console")
    ]
    found = set()
    for page, block in shown:
        if block["mark"] or not _commands(block):
            continue
        known = [
            start for start in ELSEWHERE if any(line.startswith(start) for line in _commands(block))
        ]
        assert known, f"{_name(page)} shows a command that no test runs: {block['text']}"
        found.update(known)
    assert found == set(ELSEWHERE)
    for place in ELSEWHERE.values():
        name, _, test = place.partition("::")
        file = ROOT / name if name.startswith(".") else ROOT / "tests" / name
        assert f"def {test}" in file.read_text(encoding="utf-8") if test else file.exists()


def test_the_tutorial_of_an_own_log_gives_the_options_that_it_uses(tmp_path, cli):
    subprocess.run(
        [sys.executable, ROOT / "docs" / "examples" / "own_bag.py", tmp_path], check=True
    )
    said = cli("info", "own.bag", "--model", "target.stl", "--json", cwd=tmp_path)
    options = " ".join(
        check["option"] for check in json.loads(said.out)["checks"] if check["option"]
    )
    text = (ROOT / "docs" / "your-own-log.md").read_text(encoding="utf-8")
    assert f"run own.bag --model target.stl {options} -o results/ --report" in text
    done = cli("run", "own.bag", "--model", "target.stl", *options.split(), "--json", cwd=tmp_path)
    rows = json.loads(done.out)["rows"]
    verdict = json.loads(done.out)["verdict"]
    assert f"{verdict['grade']}: " in text
    reasons = [reason["text"] for reason in verdict["reasons"]]
    assert all(
        reason in text for reason in reasons if not any(sign.isdigit() for sign in reason)
    ), reasons
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
    head = (
        f"Metadata-Version: 2.1\nName: {project['project']['name']}\nVersion:"
        f" {project['project']['version']}\n"
    )
    (info / "METADATA").write_text(head, encoding="utf-8")
    groups = project["project"]["entry-points"].items()
    lines = [
        f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items())
        for group, points in groups
    ]
    (info / "entry_points.txt").write_text("".join(lines), encoding="utf-8")


def test_the_back_end_of_the_tutorial_keeps_the_contract(tmp_path):
    _checks(tmp_path, "own_backend", "backends", "own")


def test_the_estimator_of_the_tutorial_keeps_the_contract(tmp_path):
    _checks(tmp_path, "own_estimator", "estimators", "twist")


def _checks(tmp_path, example, command, name):
    _installed(ROOT / "docs" / "examples" / example, tmp_path / "site")
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", command, "--check", name],
        env={**_environment(), "PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_entry_of_the_tutorial_has_60_lines_and_gets_rows_in_the_table(tmp_path):
    package = ROOT / "docs" / "examples" / "own_entry"
    texts = [path.read_text(encoding="utf-8") for path in sorted(package.iterdir())]
    assert sum(bool(line.strip()) for text in texts for line in text.splitlines()) <= 60
    _checks(tmp_path, "own_entry", "backends", "mine")
    words = "benchmark --quick -o out --backend mine,horn --estimator smooth,own --workers 0"
    done = subprocess.run(
        [sys.executable, "-m", "avsreplay", *words.split(), "--only=clean-fast", "--n-scans=12"],
        env={**_environment(), "PYTHONPATH": str(tmp_path / "site")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "out" / "benchmark.json").read_text(encoding="utf-8"))
    used = {run["entry"]: run["used"] for run in found["runs"]}
    assert set(used) == {"mine+smooth", "mine+own", "horn+smooth", "horn+own"}
    assert min(used.values()) > 6


def _command_lines(page):
    for block in _blocks(page):
        if block["language"] in ("sh", "bash", "console", "yaml"):
            for line in block["text"].replace("\\\n", " ").splitlines():
                command = line.strip().removeprefix("- run: ").removeprefix("$ ")
                for part in re.split(r"&&|\|\||;|\|", re.sub(r"\d?>+\s*\S+", "", command)):
                    if part.split()[:1] == ["avsreplay"]:
                        yield shlex.split(part, comments=True)[1:]


LINES = [(page, words) for page in PAGES for words in _command_lines(page)]


@pytest.mark.parametrize(
    ("page", "words"), LINES, ids=lambda v: _name(v) if isinstance(v, Path) else " ".join(v)
)
def test_every_command_line_parses(page, words):
    if words[:1] and words[0] in SUMMARIES:
        command = group.get_command(click.Context(group), words[0])
        try:
            command.make_context(words[0], list(words[1:]))
        except click.exceptions.Exit:
            return
    else:
        assert words[0] in ("--help", "-h", "--version", "COMMAND")


def _mentioned(page):
    """Commands in a sentence, as words; arguments may be missing or stand for others."""
    text = re.sub(r"```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    found = re.findall(r"`((?:avsreplay|python (?:tests|docs|fixtures)/)[^`\n]+)`", text)
    return [line.partition("|")[0].split() for line in found]


MENTIONED = sorted({tuple(words) for page in PAGES for words in _mentioned(page)})


@pytest.mark.parametrize("words", MENTIONED, ids=" ".join)
def test_every_option_of_a_command_in_a_sentence_exists(words):
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    if words[0] == "python" and not words[1].endswith("/NAME.py"):
        source = (ROOT / words[1]).read_text(encoding="utf-8")
        assert not [option for option in options if f'"{option}"' not in source]
    elif words[1:] and words[1] in SUMMARIES:
        command = group.get_command(click.Context(group), words[1])
        assert options <= {option for param in command.params for option in (*param.opts, "--help")}


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


def test_the_glossary_explains_terms_that_occur_and_names_sections_that_exist():
    glossary = ROOT / "docs" / "glossary.md"
    symbols, _, terms = glossary.read_text(encoding="utf-8").partition("## Terms")
    files = [
        *(page for page in PAGES if page != glossary),
        *(ROOT / "avsreplay" / "register").glob("*.py"),
    ]
    text = " ".join(" ".join(file.read_text(encoding="utf-8").lower().split()) for file in files)
    named = [
        term
        for cell in re.findall(r"^\| ([^|]+) \| .*[.?] \|$", terms, flags=re.M)
        for term in cell.split(", ")
    ]
    assert len(named) > 20
    assert [term for term in named if term.lower() not in text] == []
    equations = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
    sections = set(re.findall(r"\| (\d) \|$", symbols, flags=re.M))
    assert sections == set(re.findall(r"^## (\d)\. ", equations, flags=re.M))


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
