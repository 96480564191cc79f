"""Checks of form, outside of the tests: ``python tests/lint.py [CHECK ...]``; all checks without a
name. Prints what each finds; exit code 1 if any finds something.

``ruff`` lint, ``format`` layout, ``types`` mypy, ``imports`` the contracts in pyproject.toml,
``prose`` sentences and terms of the documentation and of docstrings.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
MOST_WORDS = 45  # of a sentence
HISTORY = re.compile(
    r"\b(previously|formerly|no longer|before the change|earlier version|used to be|since"
    r" then|until now)\b"
    r"|(?:^|[.;:(|] ?)(?:Before|Now|Formerly),",
    re.IGNORECASE | re.MULTILINE,
)
# Verbs of people in place of what a computation does.
PERSON = re.compile(
    r"\b(?:speaks|believe[sd]?|trust(?:s|ed)|knows|hopeless|remembers?|forgets?|wants|ask(?:s|ed)"
    r"|refuse[sd]?)\b(?!\s*:|``)"
)
IMPORTS = "from importlinter.cli import lint_imports_command as check; check()"


def main(names: list[str]) -> int:
    """Run the named checks, or all."""
    unknown = sorted(set(names) - set(CHECKS))
    if unknown:
        print(f"no check {', '.join(unknown)}; there are {', '.join(CHECKS)}", file=sys.stderr)
        return 2
    failed = []
    for name in names or CHECKS:
        found = CHECKS[name]()
        print(f"{name}: {'as required' if not found else 'not as required'}")
        if found:
            print(found)
            failed.append(name)
    return 1 if failed else 0


def _tool(*words: str) -> Callable[[], str]:
    """A check by a Python module or program, whose output counts if it fails."""

    def check() -> str:
        done = subprocess.run(
            [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr if done.returncode else ""

    return check


def prose() -> str:
    """Long sentences and words of history on the pages; verbs of people in docstrings."""
    return "\n".join([*_pages(), *_docstrings()])


def _pages() -> Iterator[str]:
    for page in PAGES:
        name = page.relative_to(ROOT)
        text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for words in _sentences(text):
            if len(words) > MOST_WORDS:
                yield f"{name}: a sentence of {len(words)} words: {' '.join(words)}"
        for found in HISTORY.finditer(text):
            yield f"{name}: states history: {found[0]}"


def _sentences(text: str) -> Iterator[list[str]]:
    """Sentences outside of code, as words; a heading, an entry of a list and a cell of a
    table are sentences.
    """
    for part in re.split(r"\n\s*\n|\||\n(?=\s*(?:[-*#]|\d+\. ))|^#+ [^\n]*\n", text, flags=re.M):
        joined = " ".join(re.sub(r"`[^`]*`", "code", part).split())
        for sentence in re.split(r"(?<=[.!?:;])(?:\*\*)? +(?=[A-Zc*\[({])", joined):
            yield sentence.split()


def _docstrings() -> Iterator[str]:
    for path in sorted(ROOT.glob("avsreplay/**/*.py")):
        text = path.read_text(encoding="utf-8")
        for part in re.findall(r'""".*?"""|# [^\n]*', text, flags=re.S):
            if found := PERSON.search(part):
                yield f"{path.relative_to(ROOT)}: {found[0]}: {' '.join(part.split())[:80]}"


CHECKS: dict[str, Callable[[], str]] = {
    "ruff": _tool("-m", "ruff", "check", "."),
    "format": _tool("-m", "ruff", "format", "--check", "."),
    "imports": _tool("-c", IMPORTS),
    "prose": prose,
    "types": _tool("-m", "mypy"),
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
