"""Makes the pictures of the documentation from the tool's own output: ``python docs/pictures.py
[LOG [FULL]]``.

Needs Chromium (``apt-get install chromium``) and Pillow. Without LOG it uses the short recording of
the fixtures; with FULL, a recording of the built-in scenario, it also makes the plots of the
results page. The pictures are terminal screens at 80 and 160 columns, the page at 1400 and 390
pixels, a comparison, and an animation.
"""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
MOST_BYTES = 1_500_000
COLOURS = 128
FLAGS = (
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-gl=swiftshader",
        "--enable-unsafe-swiftshader",
    ),
    *("--hide-scrollbars", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--virtual-time-budget=8000"),
)


def terminal(columns: int, *words: str, cwd: Path) -> Text:
    """What a command prints on a terminal of this width, with its colours."""
    reader, writer = pty.openpty()
    os.set_blocking(reader, True)
    env = {
        **os.environ,
        "COLUMNS": str(columns),
        "LINES": "60",
        "TERM": "xterm-256color",
        "COLORTERM": "truecolor",
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "avsreplay", *words],
        cwd=cwd,
        env=env,
        stdout=writer,
        stderr=subprocess.DEVNULL,
        close_fds=True,
    )
    os.close(writer)
    parts = []
    try:
        while part := os.read(reader, 65536):
            parts.append(part)
    except OSError:  # the terminal was closed
        pass
    process.wait()
    return Text.from_ansi(b"".join(parts).decode("utf-8", "replace").replace("\r\n", "\n"))


def screen(text: Text, columns: int, lines: int, to: Path, folder: Path, command: str) -> None:
    """A picture of the first lines of a terminal."""
    console = Console(
        record=True, width=columns, file=(folder / "unused").open("w"), force_terminal=True
    )
    console.print(Text(f"$ {command}", style="bold"))
    for line in text.split("\n")[:lines]:
        console.print(line, no_wrap=True, crop=True)
    page = folder / "terminal.html"
    style = (
        "<style>body{background:#14181d!important;color:#e6e6e6!important;margin:14px}"
        "pre{font-size:14px}</style>"
    )
    page.write_text(
        console.export_html(inline_styles=True).replace("</head>", style + "</head>"),
        encoding="utf-8",
    )
    shot(page, to, round(8.45 * columns) + 30, round(16.05 * (lines + 1)) + 30)


def shot(page: Path, to: Path, width: int, height: int) -> None:
    """A screenshot of a page."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or "chromium"
    with tempfile.TemporaryDirectory() as profile:
        size = (f"--window-size={max(width, 500)},{height}", f"--user-data-dir={profile}")
        command = [chromium, *FLAGS, *size, f"--screenshot={to}", page.resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=180)
    image = Image.open(to).convert("RGB").crop((0, 0, width, height))
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(to, optimize=True)


def phone(page: Path, to: Path, folder: Path) -> None:
    """A screenshot at 390 pixels: Chromium's window is at least 500 wide, so the page is
    shown in a frame.
    """
    frame = folder / "phone.html"
    inner = (
        f'<iframe src="{page.resolve().as_uri()}"'
        ' style="width:390px;height:1500px;border:0"></iframe>'
    )
    frame.write_text(f'<body style="margin:0">{inner}</body>', encoding="utf-8")
    shot(frame, to, 390, 1500)


def plots(page: Path, to: Path, folder: Path) -> None:
    """The first charts of a page, without anything else."""
    hidden = "header, #lead, #controls, #scene, .tables, footer { display: none !important }"
    style = f"<style>{hidden} main {{ display: block !important }}</style></head>"
    bare = folder / "plots.html"
    bare.write_text(page.read_text(encoding="utf-8").replace("</head>", style, 1), encoding="utf-8")
    shot(bare, to, 900, 1170)


def animation(frames: list[Path], to: Path) -> None:
    """The pictures one after another at one size."""
    images = []
    for path in frames:
        image = Image.open(path).convert("RGB")
        image = image.resize(
            (720, round(image.height * 720 / image.width)), Image.Resampling.LANCZOS
        )
        canvas = Image.new("RGB", (720, 540), (20, 24, 29))
        canvas.paste(image.crop((0, 0, 720, 540)), (0, 0))
        images.append(canvas.quantize(COLOURS, dither=Image.Dither.NONE))
    images[0].save(
        to,
        save_all=True,
        append_images=images[1:],
        duration=[1800, 3500, 4500],
        loop=0,
        optimize=True,
    )


def main(log: Path, full: Path | None = None) -> None:
    """Make all pictures; ``full`` is the recording of the built-in scenario, for the page of
    results.
    """
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(log, folder / "tumble.mcap")
        command = "avsreplay run tumble.mcap -o results/ --report"
        narrow = terminal(80, "run", "tumble.mcap", "-o", "results", "--report", cwd=folder)
        wide = terminal(160, "run", "tumble.mcap", cwd=folder)
        screen(narrow, 80, 34, IMAGES / "verdict-80.png", folder, command)
        screen(wide, 160, 34, IMAGES / "verdict-160.png", folder, "avsreplay run tumble.mcap")
        screen(Text(""), 80, 34, folder / "typed.png", folder, command)
        page = folder / "results" / "report.html"
        shot(page, IMAGES / "page.png", 1400, 1300)
        phone(page, IMAGES / "page-390.png", folder)
        if full is not None:
            shutil.copy(full, folder / "full.mcap")
            terminal(80, "run", "full.mcap", "-o", "full", "--report", cwd=folder)
            plots(folder / "full" / "report.html", IMAGES / "results.png", folder)
        terminal(
            80, "run", "tumble.mcap", "-o", "other", "--set", "estimator.adapt=off", cwd=folder
        )
        terminal(80, "compare", "results", "other", "-o", "compare.html", cwd=folder)
        shot(folder / "compare.html", IMAGES / "comparison.png", 1400, 1000)
        animation(
            [folder / "typed.png", IMAGES / "verdict-80.png", IMAGES / "page.png"],
            IMAGES / "demo.gif",
        )
    total = sum(path.stat().st_size for path in IMAGES.iterdir())
    print(f"{IMAGES}: {total / 1e6:.2f} MB")
    if total > MOST_BYTES:
        sys.exit(f"the pictures are larger than {MOST_BYTES / 1e6} MB")


if __name__ == "__main__":
    given = [Path(word) for word in sys.argv[1:3]]
    main(*(given or [ROOT / "fixtures" / "tumble.mcap"]))
