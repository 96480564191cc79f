"""Makes all pictures of the documentation from the tool's own output: ``python docs/pictures.py
[--only NAME]``.

Needs Chromium with its driver, Pillow and selenium (``apt-get install chromium chromium-driver``,
``pip install '.[test]'``). The runs are those of the pages that show them: the built-in scenario
(first result, results, report, planning, faults), the bag of the tutorial (your own log), and two
runs of the fixture (continuous integration).
"""

from __future__ import annotations

import argparse
import io
import json
import os
import pty
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
MOST_BYTES = 2_000_000  # of all pictures
COLOURS = 128  # of the palette of a picture
LINES = 24  # of the first screen
DEMO_WIDTH = 760  # pixels of the animation
DEMO_STEPS = 24  # scans of the flight that it shows
COMMAND = "avsreplay run tumble.mcap -o results/ --report"
OWN = (
    "own.bag --model target.stl --model-unit mm --crop-range 1.45,7.44 --fixed-frame map"
    " --truth-topic /mocap/pose"
)


def terminal(columns: int, command: str, cwd: Path) -> Text:
    """What a command prints on standard output of a terminal of this width, with its colours."""
    reader, writer = pty.openpty()
    env = {
        **os.environ,
        "COLUMNS": str(columns),
        "LINES": "60",
        "TERM": "xterm-256color",
        "COLORTERM": "truecolor",
    }
    process = subprocess.Popen(
        [sys.executable, "-m", *command.split()],
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


class Browser:
    """A headless Chromium, and pictures of what it shows."""

    def __init__(self, driver: Any, folder: Path) -> None:
        self.driver, self.folder = driver, folder

    def open(self, page: Path, width: int, height: int) -> None:
        """Show a page in a window of this size [CSS pixels]."""
        size = {
            "width": width,
            "height": height,
            "deviceScaleFactor": 1,
            "mobile": width < 500,
        }
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.driver.get(page.resolve().as_uri())

    def shot(self) -> Image.Image:
        """What the window shows."""
        return Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")

    def part(self, selector: str) -> Image.Image:
        """The first element that a selector finds."""
        found = self.driver.find_elements("css selector", selector)
        if not found:
            sys.exit(f"the page has no {selector}")
        return Image.open(io.BytesIO(found[0].screenshot_as_png)).convert("RGB")

    def choose(self, row: int) -> None:
        """Move the page of a run to a scan."""
        self.driver.execute_script("location.hash = 'row=' + arguments[0]", row)
        self.driver.execute_async_script(
            "const done = arguments[0];"
            " requestAnimationFrame(() => requestAnimationFrame(() => done()))"
        )

    def screen(self, columns: int, typed: str, printed: Text | None = None) -> Image.Image:
        """The first lines of a terminal: the typed command, then what it prints."""
        console = Console(record=True, width=columns, file=io.StringIO(), force_terminal=True)
        console.print(Text(f"$ {typed}", style="bold"))
        for line in printed.split("\n")[:LINES] if printed else ():
            console.print(line, no_wrap=True, crop=True)
        style = (
            "<style>body{background:#14181d!important;color:#e6e6e6!important;margin:14px}"
            "pre{font-size:14px}</style></head>"
        )
        page = self.folder / "terminal.html"
        text = console.export_html(inline_styles=True).replace("</head>", style)
        page.write_text(text, encoding="utf-8")
        self.open(page, round(8.45 * columns) + 30, round(16.05 * (LINES + 1)) + 30)
        return self.shot()


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """Start and end the browser."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--hide-scrollbars",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ):
        options.add_argument(flag)
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    driver = webdriver.Chrome(options=options, service=service)
    driver.set_script_timeout(300)
    try:
        yield Browser(driver, folder)
    finally:
        driver.quit()


def save(image: Image.Image, name: str) -> None:
    """Write a picture with a small palette."""
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(IMAGES / name, optimize=True)


def demo(show: Browser, printed: Text, page: Path, scans: int) -> None:
    """The animation: a command as it is typed, its first screen, then the flight on the page."""
    lengths = [*range(0, len(COMMAND), 4), len(COMMAND)]
    frames = [(show.screen(80, COMMAND[:length] + "▏"), 90) for length in lengths]
    frames += [(show.screen(80, COMMAND), 700), (show.screen(80, COMMAND, printed), 4500)]
    show.open(page, 1000, 700)
    for k in range(DEMO_STEPS):
        show.choose(1 + round((scans - 2) * k / (DEMO_STEPS - 1)))
        show.driver.execute_script("document.querySelector('#controls').scrollIntoView()")
        frames.append((show.shot(), 180))
    frames[-1] = (frames[-1][0], 2500)
    height = max(round(i.height * DEMO_WIDTH / i.width) for i, _ in frames)
    drawn = []
    for image, _ in frames:
        size = (DEMO_WIDTH, round(image.height * DEMO_WIDTH / image.width))
        canvas = Image.new("RGB", (DEMO_WIDTH, height), (20, 24, 29))
        canvas.paste(image.resize(size, Image.Resampling.LANCZOS), (0, 0))
        drawn.append(canvas.quantize(COLOURS, dither=Image.Dither.NONE))
    drawn[0].save(
        IMAGES / "demo.gif",
        save_all=True,
        append_images=drawn[1:],
        duration=[time for _, time in frames],
        loop=0,
        optimize=True,
    )


def built_in(show: Browser, folder: Path) -> None:
    """Pictures of the built-in scenario."""
    terminal(80, "avsreplay record -o tumble.mcap", folder)
    printed = terminal(80, COMMAND, folder)
    page = folder / "results" / "report.html"
    rows = (folder / "results" / "rows.jsonl").read_text(encoding="utf-8").splitlines()
    closed = [k for k, row in enumerate(rows) if json.loads(row)["capture_miss_m"] is not None]
    scans = closed[0] + 5 if closed else len(rows)
    save(show.screen(80, COMMAND, printed), "verdict-80.png")
    show.open(page, 390, 1500)
    save(show.shot(), "page-390.png")
    show.open(page, 1400, 1200)
    show.choose(scans - 40)
    save(show.shot(), "page.png")
    save(show.part(".approach"), "approach.png")
    show.open(page, 900, 840)
    show.driver.execute_script(
        "document.querySelectorAll('header, #lead, #controls, #scene, .tables, footer')"
        ".forEach((each) => each.remove()); scrollTo(0, 0)"
    )
    save(show.shot(), "results.png")
    demo(show, printed, page, scans)


def own_log(show: Browser, folder: Path) -> None:
    """The page of the run of the tutorial."""
    bag = [sys.executable, str(ROOT / "docs" / "examples" / "own_bag.py"), str(folder)]
    subprocess.run(bag, check=True)
    terminal(80, f"avsreplay run {OWN} -o own --report", folder)
    show.open(folder / "own" / "report.html", 1400, 1000)
    save(show.shot(), "own-log.png")


def comparison(show: Browser, folder: Path) -> None:
    """The page of a comparison."""
    log = str(ROOT / "fixtures" / "tumble.mcap")
    terminal(80, f"avsreplay run {log} -o baseline", folder)
    terminal(80, f"avsreplay run {log} -o candidate --set estimator.adapt=off", folder)
    terminal(80, "avsreplay compare baseline candidate -o compare.html", folder)
    show.open(folder / "compare.html", 1400, 1000)
    save(show.shot(), "comparison.png")


PARTS = {"built-in": built_in, "own-log": own_log, "comparison": comparison}


def main() -> None:
    """Make the pictures, or those of one part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=PARTS, help="the pictures of one run")
    only = parser.parse_args().only
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name, browser(Path(name)) as show:
        for part in [only] if only else PARTS:
            PARTS[part](show, Path(name))
    total = sum(path.stat().st_size for path in IMAGES.iterdir())
    print(f"{IMAGES}: {total / 1e6:.2f} MB")
    if total > MOST_BYTES:
        sys.exit(f"the pictures are larger than {MOST_BYTES / 1e6} MB")


if __name__ == "__main__":
    main()
