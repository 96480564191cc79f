"""What an import loads, the diagrams of the code, and the names that the documentation has."""

import ast
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def run(*command):
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_importing_the_package_does_nothing():
    code = (
        "import sys; before = set(sys.modules); import avsreplay; print(sorted(set(sys.modules) -"
        " before))"
    )
    loaded = set(ast.literal_eval(run(sys.executable, "-c", code).stdout))
    assert "avsreplay" in loaded
    assert {name for name in loaded if name.split(".")[0] not in sys.stdlib_module_names} == {
        "avsreplay"
    }


def test_tests_and_their_processes_import_the_package_that_is_installed():
    import avsreplay
    import avsreplay.register._kernel as kernel

    code = (
        "import avsreplay, avsreplay.register._kernel as k; print(avsreplay.__file__, k.__file__)"
    )
    done = run(sys.executable, "-c", code)
    assert done.stdout.split() == [avsreplay.__file__, kernel.__file__], done.stderr
    assert str(ROOT) not in sys.path


def test_help_loads_no_heavy_library():
    code = (
        "import sys\nfrom avsreplay.cli.main import group\n"
        "group.main(['--help'], standalone_mode=False)\n"
        "heavy = {'numpy', 'scipy', 'mcap', 'rosbags', 'trimesh', 'kiss_icp', 'rich', 'plotly'}\n"
        "print('HEAVY', sorted(heavy & set(sys.modules)))"
    )
    done = run(sys.executable, "-c", code)
    assert "HEAVY []" in done.stdout, done.stdout + done.stderr


def test_a_run_loads_no_scipy():
    code = (
        "import sys\nfrom avsreplay.cli.main import group\ngroup.main(['run',"
        f" {str(ROOT / 'fixtures' / 'tumble.mcap')!r}, '--n-scans', '3'],"
        " standalone_mode=False)\nprint('SCIPY', 'scipy' in sys.modules)"
    )
    done = run(sys.executable, "-c", code)
    assert "SCIPY False" in done.stdout, done.stdout + done.stderr


def test_the_diagrams_of_the_architecture_page_are_current():
    done = run(sys.executable, str(ROOT / "docs" / "architecture_diagrams.py"), "--check")
    assert done.returncode == 0, done.stderr


def test_the_package_states_that_it_is_typed():
    assert (ROOT / "avsreplay" / "py.typed").is_file()


def test_the_tests_and_modules_that_the_documentation_names_exist():
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    code = "".join(
        path.read_text(encoding="utf-8") for path in sorted((ROOT / "tests").glob("test_*.py"))
    )
    named = set(re.findall(r"`(test_\w+)`", pages))
    assert named
    assert {name for name in named if f"def {name}(" not in code} == set()
    files = set(re.findall(r"`(?:tests/)?(test_\w+\.py|benchmarks/\w+\.py)\b", pages))
    assert {name for name in files if not (ROOT / "tests" / name).exists()} == set()
    packages = "benchmark|cli|estimate|log|monitor|plan|reconstruct|register|report|simulate|sweep"
    modules = set(re.findall(rf"`(?:avsreplay/)?((?:{packages})/[\w/]+\.\w+)`", pages))
    assert {name for name in modules if not (ROOT / "avsreplay" / name).exists()} == set()
