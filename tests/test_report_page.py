"""The HTML page: self-contained, safe, small, and interactive in a real browser."""

from __future__ import annotations

import base64
import dataclasses
import html.parser
import itertools
import json
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from avsreplay.cli.record import report_command
from avsreplay.errors import AvsError, UnreadableInput
from avsreplay.geometry import Pose, exp
from avsreplay.records import Label, State, Surface
from avsreplay.report.charts import PLACE_STYLES, charts, derived, embed, most_telling, spans
from avsreplay.report.jsonl import write_rows
from avsreplay.report.page import Flight, build_flight_page, build_page, render
from avsreplay.report.result import load_result
from avsreplay.report.summary import Summary
from avsreplay.report.view import PathView, View, cone_lines, scene, thin_cloud

ROOT = Path(__file__).resolve().parents[1]
TRUTH = State(
    [0, 0, 0, 1], [0.1, 0, 0], [0, 0, 5], [0, 0, 0], [0.3, -0.4], [0.5, 0.6, -0.4], exp([0, 0, 0.1])
)
BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 2)], dtype=np.float32)
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]],
    np.int32,
)


def _view(rows):
    rng = np.random.Generator(np.random.PCG64(1))
    clouds = [
        thin_cloud(r.seq, rng.normal([1, 0, 5], 1.0, (400, 3)), np.abs(rng.normal(size=400)) * 0.01)
        for r in rows
        if r.gamma
    ]
    path = PathView(
        rows[min(12, len(rows) - 1)].t_ns,
        np.linspace([0, 0, 0], [1, 0, 5], 20).astype(np.float32),
        0.02,
    )
    return View(BOX, FACES, tuple(clouds), (path,))


def _labels(rows):
    return [
        Label(
            "full_occlusion", rows[min(20, len(rows) - 1)].t_ns, rows[min(25, len(rows) - 1)].t_ns
        )
    ]


def _page(rows, **more):
    poses = [(r.t_ns, Pose(exp([0, 0, 0.02 * r.seq]), [1.0, 0.2, 5.0])) for r in rows]
    summary = Summary.fold(rows, labels=_labels(rows), truth=TRUTH)
    given = {"truth": TRUTH, "poses": poses, "view": _view(rows), "title": "tumble"} | more
    return build_page(rows, summary, {"config": {"backend": "horn"}}, **given)


def _data(page):
    return json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)[1]
    )


def _floats(packed, kind):
    return np.frombuffer(base64.b64decode(packed["data"]), kind)


def test_the_page_makes_no_network_request(make_rows):
    page = _page(make_rows(30))
    assert "default-src 'none'" in page
    outside = re.findall(
        r"""(?:src|href)\s*=\s*["']([^"'#]+)["']|url\(|@import|fetch\(|XMLHttpRequest|WebSocket""",
        page,
    )
    assert set(outside) <= {"data:,"}


def test_every_element_is_closed(make_rows):
    class Checker(html.parser.HTMLParser):
        void = frozenset({"meta", "link", "input", "br"})

        def __init__(self):
            super().__init__()
            self.open = []

        def handle_starttag(self, tag, attrs):
            if tag not in self.void:
                self.open.append(tag)

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    checker = Checker()
    checker.feed(_page(make_rows(30)))
    assert checker.open == []


EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)>&\u2028\"'"


def test_words_from_files_cannot_become_markup(make_rows):
    rows = make_rows(30, fault=EVIL, reason=EVIL, gamma=0)
    summary = Summary.fold(rows, counts={EVIL: 1})
    page = build_page(rows, summary, {EVIL: EVIL}, title=EVIL)
    assert "<img" not in page
    assert "alert(1)</script>" not in page
    assert _data(page)["states"][0] == [0, EVIL, EVIL]


def test_embedded_json_has_no_markup_and_no_nan():
    assert json.loads(embed({"a": EVIL})) == {"a": EVIL}
    assert not set("<>&\u2028") & set(embed({"a": EVIL}))
    with pytest.raises(ValueError):
        embed({"a": float("nan")})


def test_the_same_run_gives_the_same_page(make_rows):
    assert _page(make_rows(30)) == _page(make_rows(30))


def test_columns_are_packed_as_they_are(make_rows):
    rows = make_rows(40)
    run = _data(_page(rows))["runs"][0]
    np.testing.assert_array_equal(_floats(run["t"], "<f8"), [r.t_s for r in rows])
    nis = _floats(run["columns"]["nis"], "<f4")
    np.testing.assert_array_equal(
        nis, np.array([np.nan if r.nis is None else r.nis for r in rows], np.float32)
    )


def test_points_survive_packing_to_half_a_step(make_rows):
    rows = make_rows(30)
    view = _view(rows)
    packed = scene(rows, {}, view)["clouds"]
    step, centre = _floats(packed["step"], "<f4"), _floats(packed["centre"], "<f4").reshape(-1, 3)
    sizes = _floats(packed["size"], "<i4")
    points = _floats(packed["points"], "<i2").reshape(-1, 3)
    back = points * np.repeat(step, sizes)[:, None] + np.repeat(centre, sizes, axis=0)
    np.testing.assert_allclose(back, np.concatenate([c.points for c in view.clouds]), atol=2e-4)
    assert step.max() < 1.5e-4


def test_a_scan_far_away_or_of_one_point_can_be_packed(make_rows):
    rows = make_rows(3)
    view = View(BOX, FACES, (thin_cloud(0, [[1e6, 0, 0]]), thin_cloud(9, [[0, 0, 0]])))
    packed = scene(rows, {}, view)["clouds"]
    assert _floats(packed["scan"], "<i4").tolist() == [0]
    assert packed["cap_m"] is None


def test_intensities_are_levels_up_to_the_brightest_points(make_rows):
    """A level for each point in the order of the points; grey (255) where the sensor gives no
    value.
    """
    rows, points = make_rows(2), np.zeros((4, 3)) + np.arange(4.0)[:, None]
    clouds = (
        thin_cloud(0, points, np.zeros(4), [0.0, 50.0, 100.0, np.nan]),
        thin_cloud(1, points, np.zeros(4)),
    )
    packed = scene(rows, {}, View(BOX, FACES, clouds))["clouds"]
    assert packed["brightest"] == pytest.approx(np.quantile([0.0, 50.0, 100.0], 0.99))
    assert _floats(packed["intensity"], "u1").tolist() == [0, 128, 254, 255, 255, 255, 255, 255]
    without = scene(rows, {}, View(BOX, FACES, clouds[1:]))["clouds"]
    assert (without["intensity"], without["brightest"]) == (None, None)


def test_spans_are_intervals_of_equal_values(make_rows):
    found = [(s["lane"], s["word"], s["first"], s["last"]) for s in spans(make_rows(40))]
    expected = [
        ("flagged", "no_scan", 20, 25),
        ("injected", "full_occlusion", 20, 25),
        ("action", "approach", 0, 39),
    ]
    assert found == expected


def test_a_label_without_scans_is_drawn(make_rows):
    rows = [r for r in make_rows(40) if r.seq != 12]
    dropped = Label("dropped", rows[11].t_ns + 1, rows[12].t_ns - 1)
    found = spans(rows, Summary.fold(rows, labels=[*_labels(rows), dropped]).faults.episodes)
    assert [(s["word"], s["first"]) for s in found if s["lane"] == "injected"] == [
        ("full_occlusion", 19),
        ("dropped", 11),
    ]


def test_charts_with_nothing_to_show_are_left_out(make_rows):
    rows = make_rows(10, pos_err_m=None, reg_pos_err_m=None, capture_time_s=None, rms_m=None)
    keys = [c["key"] for c in charts(derived(rows))]
    assert not {"position", "capture", "fit", "miss"} & set(keys)
    assert {"attitude", "sigma", "nees"} <= set(keys)


def test_without_truth_the_charts_of_errors_are_charts_of_the_uncertainty(make_rows):
    known = {
        **dict.fromkeys(("pos_err_m", "rot_err_deg", "reg_pos_err_m", "reg_rot_err_deg")),
        "pos_1s_m": 0.01,
        "rot_1s_deg": 0.1,
    }
    titles = [
        [c["title"] for c in charts(derived(rows))[:2]]
        for rows in (make_rows(10), make_rows(10, **known))
    ]
    assert titles == [
        ["Position error", "Attitude error"],
        ["Position uncertainty", "Attitude uncertainty"],
    ]


def test_bands_are_the_value_and_its_sigma(make_rows):
    columns = derived(make_rows(10))
    np.testing.assert_allclose(columns["sigma1_hi"] - columns["sigma1_lo"], 0.02)
    assert columns["mu_z_deg"] == pytest.approx(np.degrees(0.2))


def test_the_spread_of_the_capture_is_over_recent_plans(make_rows):
    columns = derived(make_rows(40))
    assert columns["capture_time_s_lo"][-1] == 30.1
    assert columns["capture_time_s_hi"][-1] == 30.3
    assert np.isnan(columns["capture_time_s_lo"][5])


def test_the_size_stays_small(make_rows):
    assert len(_page(make_rows(600, blackout=range(300, 360)))) < 5e6


def test_a_long_run_is_thinned_in_clouds_not_in_columns(make_rows):
    rows = make_rows(6000)
    page = _page(rows)
    assert len(page) < 10e6
    assert len(_floats(_data(page)["runs"][0]["t"], "<f8")) == 6000


def test_the_command_writes_a_page_and_keeps_what_is_there(tmp_path, make_rows):
    rows = make_rows(30)
    write_rows(tmp_path / "rows.jsonl", rows)
    done = CliRunner().invoke(report_command, [str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "<title>" in (tmp_path / "report.html").read_text(encoding="utf-8")
    again = CliRunner().invoke(report_command, [str(tmp_path)])
    assert isinstance(again.exception, AvsError)
    assert "already exists" in str(again.exception)
    assert (
        CliRunner().invoke(report_command, [str(tmp_path), "--overwrite", "--title", "x"]).exit_code
        == 0
    )
    (tmp_path / "none.jsonl").write_text("")
    empty = CliRunner().invoke(
        report_command, [str(tmp_path / "none.jsonl"), "-o", str(tmp_path / "x.html")]
    )
    assert isinstance(empty.exception, UnreadableInput)
    missing = CliRunner().invoke(
        report_command, [str(tmp_path / "no"), "-o", str(tmp_path / "x.html")]
    )
    assert isinstance(missing.exception, AvsError)
    assert not (tmp_path / "x.html").exists()


def test_a_long_run_is_thinned_to_its_informative_scans(make_rows):
    rows = [dataclasses.replace(r, pos_err_m=0.9) if r.seq == 1234 else r for r in make_rows(3000)]
    kept = most_telling(rows, 500, always=(77,))
    assert len(kept) <= 500
    assert {0, 77, 1234, 2999, 20, 26} <= set(kept)  # 20 and 26: gamma changes
    assert most_telling(rows, 3000) == list(range(3000))


@pytest.mark.slow
def test_60000_scans_make_a_page_below_10_mb_that_says_what_it_shows(make_rows):
    rows = make_rows(60_000)
    page = _page(rows)
    assert len(page) < 10e6
    assert re.search(r"The charts show \d+ of 60000 scans", page)
    assert "60000 scans" in page.split("<main>")[0] or "of 60000 scans used" in page


def test_no_two_known_kinds_look_the_same(make_rows):
    """A reason, an injected fault and an action differ in colour or in pattern."""
    columns = {"flagged": "reason", "injected": "fault", "action": "action"}
    styles = [
        (span["colour"], span["pattern"])
        for lane, words in PLACE_STYLES.items()
        for word in words
        for span in spans(make_rows(1, gamma=0, **{columns[lane]: word}))
        if (span["lane"], span["word"]) == (lane, word)
    ]
    assert len(styles) == sum(map(len, PLACE_STYLES.values()))
    assert len(set(styles)) == len(styles)
    assert {k for style in styles for k in style} <= set(range(6))


def test_values_are_in_millimetres_where_the_tables_say_so(make_rows):
    found = {c["key"]: c for c in charts(derived(make_rows(40)), None, {"rms_max_m": 0.05})}
    assert (found["fit"]["unit"], found["fit"]["factor"]) == ("mm", 1000.0)
    assert found["fit"]["levels"] == [{"y": 50.0, "label": "limit", "colour": 3}]
    far = {c["key"]: c for c in charts(derived(make_rows(40, pos_err_m=3.0)))}
    assert far["position"]["unit"] == "m"


def test_one_large_value_does_not_hide_the_others(make_rows):
    """It decides neither the unit nor, on a linear axis, the height of all others."""
    rows = [
        dataclasses.replace(r, rms_m=4.0, reg_pos_err_m=9.0) if r.seq == 30 else r
        for r in make_rows(40)
    ]
    found = {c["key"]: c for c in charts(derived(rows))}
    assert (found["fit"]["unit"], found["fit"]["log"]) == ("mm", True)
    assert found["position"]["unit"] == "mm"
    assert not {c["key"]: c for c in charts(derived(make_rows(40)))}["fit"]["log"]


def test_rejected_values_do_not_decide_the_axis_of_a_measurement(make_rows):
    rows = [dataclasses.replace(r, rms_m=4.0, gamma=0) if r.seq == 30 else r for r in make_rows(40)]
    used = np.array([row.gamma == 1 for row in rows])
    found = {c["key"]: c for c in charts(derived(rows), used=used)}
    assert not found["fit"]["log"]
    assert found["fit"]["series"][0]["measured"]
    np.testing.assert_array_equal(_floats(_data(_page(rows))["runs"][0]["used"], "u1"), used)


def test_equal_lines_are_drawn_once_and_say_so(make_rows):
    rows = make_rows(40)
    columns = derived(rows)
    columns["earliest_capture_s"] = columns["capture_time_s"] + 1e-9
    (line,) = {c["key"]: c for c in charts(columns)}["capture"]["series"]
    assert line["label"] == "planned = certified lower bound"
    columns["earliest_capture_s"] = columns["capture_time_s"] - 1.0
    assert len({c["key"]: c for c in charts(columns)}["capture"]["series"]) == 2


def test_the_answer_stands_before_everything_that_is_folded(make_rows):
    page = _page(make_rows(40))
    first = [c["key"] for c in _data(page)["charts"] if c["first"]]
    assert first == ["position", "nis", "capture"]  # beside the states
    order = ['id="verdict"', 'id="scene"', 'id="charts"', 'id="more"', "Faults and manoeuvres"]
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert page.index("<details") > page.index('id="charts"')


def test_a_kind_has_the_same_colour_and_pattern_on_every_page(make_rows):
    def styles(rows):
        return {(s["lane"], s["word"]): (s["colour"], s["pattern"]) for s in spans(rows)}

    one = styles(make_rows(40))
    two = styles(
        [
            dataclasses.replace(r, gamma=0, reason="fit_error", fault=None) if r.seq < 5 else r
            for r in make_rows(40)
        ]
    )
    shared = one.keys() & two.keys()
    assert ("injected", "full_occlusion") in shared
    assert all(one[kind] == two[kind] for kind in shared)
    words = [
        "not_aligned",
        "fit_error",
        "no_scan",
        "pose_jump",
        "few_inliers",
        "not_converged",
        "doubtful",
        "clock",
    ]
    rows = [
        dataclasses.replace(r, gamma=0, reason=word)
        for r, word in zip(make_rows(8), words, strict=True)
    ]
    flagged = [style for (lane, _), style in styles(rows).items() if lane == "flagged"]
    assert len(set(flagged)) == len(words)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"pos_err_m": None, "rot_err_deg": None}, "no truth to compare with"),
        ({"gamma": 0, "reason": "not_aligned", "converged": False}, "rms in coasting scans"),
        (
            {"gamma": 0, "reason": "not_aligned", "converged": False},
            "none of the 40 scans was used",
        ),
    ],
)
def test_statements_are_right_in_every_state(make_rows, changes, says):
    assert says in _page(make_rows(40, **changes))


# Machado, Oliveira, Fernandes 2009, severity 1: what linear RGB becomes to an eye that lacks one
# kind of cone.
EYES = {
    "all cones": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.119192, 0.9503041],
    ]
)


def _linear(text):
    channels = np.array([int(text[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)


def _lab(linear):
    ratio = TO_XYZ @ np.clip(linear, 0, 1) / [0.95047, 1.0, 1.08883]
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("eye", EYES)
def test_line_colours_differ_to_every_eye(eye):
    """Five times a just noticeable difference of about 2 in CIELAB, in both themes, and where a
    page has no script.
    """
    style = render("page.css")
    themes = [
        re.findall(r"--c\d: (#\w{6})", block)
        for block in re.findall(r":root[^{]*\{(.*?)\}", style, re.S)
    ]
    assert [len(theme) for theme in themes] == [6, 6, 6]
    for theme in themes:
        seen = [_lab(np.array(EYES[eye]) @ _linear(colour)) for colour in theme]
        assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 10


# ---- in a browser


@pytest.fixture(scope="module")
def browser():
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    program = next(
        (p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None
    )
    driver = shutil.which("chromedriver")
    if not program or not driver:
        pytest.skip("no Chromium with its driver here")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    flags = (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--window-size=1280,900",
    )
    for flag in (*flags, "--enable-unsafe-swiftshader"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    chrome.set_script_timeout(300)  # the default of 30 s is too short on a busy machine
    yield chrome
    chrome.quit()


@pytest.fixture
def opened(browser, tmp_path, make_rows):
    def go(width=1280, height=900, dark=False, rows=None, **more):
        path = tmp_path / "page.html"
        path.write_text(_page(make_rows(60) if rows is None else rows, **more), encoding="utf-8")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
        browser.get(path.as_uri())
        browser.execute_script("for (const d of document.querySelectorAll('details')) d.open = 1")
        _settled(browser)
        return browser

    return go


def _text(browser, selector):
    return browser.execute_script(
        "return document.querySelector(arguments[0]).textContent", selector
    )


def _settled(browser):
    browser.execute_async_script(
        "const d = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => d()))"
    )


def _slide(browser, k):
    script = (
        "const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new"
        " Event('input'))"
    )
    browser.execute_script(script, k)
    _settled(browser)


def _pin(browser, chart="position"):
    """Place of the marker of the chosen scan in the plot of a chart [px]."""
    script = """const pin = document.querySelector(arguments[0]);
    return pin.getBoundingClientRect().left - pin.parentElement.getBoundingClientRect().left"""
    return browser.execute_script(script, f"#chart-{chart} .pin")


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_it_loads_without_a_console_message(opened, width, dark):
    browser = opened(width=width, dark=dark)
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.documentElement.dataset.theme") == (
        "dark" if dark else "light"
    )
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert len(browser.find_elements("css selector", ".chart canvas")) >= 12


def test_the_page_of_a_flight_has_its_path_from_the_instant_of_planning():
    t = np.linspace(0.0, 20.0, 5)
    y = np.outer(1.0 - t / 20.0, [3.0, 1.0, 0.5])
    flight = Flight(t, y, {"distance_m": np.linalg.norm(y, axis=1)}, np.array([1.0, 0.0, 0.0]))
    data = _data(build_flight_page("flight", ["found"], flight, [("status", "found")]))
    (path,) = data["scene"]["paths"]
    assert path["t_s"] == 0.0
    assert _numbers(path["points"]) == pytest.approx(y.ravel(), abs=1e-6)
    assert _numbers(data["runs"][0]["t"]) == pytest.approx(t)


def _numbers(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), f"<{packed['type']}")


@pytest.mark.slow
def test_the_page_of_a_flight_moves_the_gripper_with_the_slider(browser, tmp_path):
    t = np.linspace(0.0, 20.0, 41)
    y = np.outer(1.0 - t / 20.0, [3.0, 1.0, 0.5])
    corners, faces = (
        np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    surface = Surface(corners, faces, "m", "")
    figures = {"distance_m": np.linalg.norm(y, axis=1), "margin_cone_m": y[:, 0]}
    axis = np.array([1.0, 0.0, 0.0])
    flight = Flight(t, y, figures, axis, [(30.0, 2.0), (15.0, 0.5)], 0.01, surface)
    path = tmp_path / "flight.html"
    path.write_text(
        build_flight_page("flight", ["found"], flight, [("status", "found")]), encoding="utf-8"
    )
    browser.get(path.as_uri())
    _slide(browser, 10)
    assert browser.get_log("browser") == []
    assert _text(browser, "#now") == "5.00 s"
    assert "gripper" in _text(browser, "#scene .legend")
    pictures = []
    for k in (10, 30):
        _slide(browser, k)
        assert browser.execute_script(
            "return document.querySelector('#scene canvas').dataset.painted"
        ) == str(k)
        pictures.append(browser.find_element("css selector", "#scene canvas").screenshot_as_base64)
    assert pictures[0] != pictures[1]


@pytest.mark.parametrize(
    ("degrees", "length", "mouth"), [(35.0, 2.0, 0.01), (15.0, 0.48, 0.05), (80.0, 1.0, 0.0)]
)
def test_the_lines_of_a_cone_lie_on_it_and_end_at_its_range(degrees, length, mouth):
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    points = cone_lines(axis, degrees, length, mouth)
    along = points @ axis
    across = np.linalg.norm(points - along[:, None] * axis, axis=1)
    assert np.allclose(across, mouth + np.tan(np.radians(degrees)) * along)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(length)
    assert set(np.round(np.linalg.norm(points, axis=1), 9)) == {round(length, 9), round(mouth, 9)}


@pytest.mark.slow
def test_a_page_of_600_scans_becomes_interactive(opened, make_rows):
    browser = opened(rows=make_rows(600, blackout=range(300, 360)))
    assert int(browser.execute_script("return document.documentElement.dataset.ready")) > 0
    _slide(browser, 450)
    assert _text(browser, "#now").startswith("scan 450 ")


@pytest.mark.slow
def test_the_slider_moves_the_markers_the_text_and_the_3d_view(opened):
    browser = opened()
    _slide(browser, 10)
    left, words = _pin(browser), _text(browser, "#now")
    assert words == "scan 10 · 2.00 s · ● used"
    assert (
        browser.execute_script("return document.querySelector('#scene canvas').dataset.painted")
        == "10"
    )
    _slide(browser, 22)
    assert _pin(browser) > left
    assert _pin(browser, "sigma") == pytest.approx(_pin(browser, "nees"), abs=1)
    assert _text(browser, "#now") == "scan 22 · 4.40 s · ~ no scan · injected: full occlusion"
    assert _text(browser, "#chart-fit output") == "\u2013"


@pytest.mark.slow
def test_hover_reads_every_chart_and_ends(opened, make_rows):
    from selenium.webdriver import ActionChains

    rows = make_rows(60)
    browser = opened(rows=rows)
    over = browser.find_element("css selector", "#chart-position .u-over")
    resting = _text(browser, "#now")
    ActionChains(browser).move_to_element(over).perform()
    _settled(browser)
    hovered = _text(browser, "#now")
    k = int(re.match(r"scan (\d+)", hovered)[1])
    assert abs(k - 30) <= 2
    assert float(_text(browser, "#chart-position output")) == pytest.approx(
        1000 * rows[k].pos_err_m, rel=1e-3
    )
    assert float(_text(browser, "#chart-nees output")) == pytest.approx(rows[k].nees, rel=1e-3)
    ActionChains(browser).move_to_element(browser.find_element("id", "verdict")).perform()
    _settled(browser)
    assert _text(browser, "#now") == resting


@pytest.mark.slow
def test_a_drag_zooms_all_charts_and_reset_undoes_it(opened):
    from selenium.webdriver import ActionChains

    browser = opened()
    _slide(browser, 30)
    before = {c: _pin(browser, c) for c in ("position", "nees")}
    over = browser.find_element("css selector", "#chart-position .u-over")
    ActionChains(browser).move_to_element_with_offset(over, -20, 0).click_and_hold().move_by_offset(
        200, 0
    ).release().perform()
    _settled(browser)
    moved = {c: _pin(browser, c) for c in ("position", "nees")}
    assert moved["position"] == pytest.approx(moved["nees"], abs=1)
    assert abs(moved["nees"] - before["nees"]) > 50
    browser.find_element("id", "reset").click()
    _settled(browser)
    assert _pin(browser, "nees") == pytest.approx(before["nees"], abs=1)


@pytest.mark.slow
def test_a_click_chooses_a_scan_and_jump_goes_to_a_fault(opened):
    browser = opened()
    browser.find_element("css selector", "#chart-position .u-over").click()
    _settled(browser)
    chosen = int(browser.execute_script("return document.getElementById('slider').value"))
    assert abs(chosen - 30) <= 2
    browser.execute_script("document.querySelector('.jump').click()")
    assert browser.execute_script("return document.getElementById('slider').value") == "20"


@pytest.mark.slow
def test_the_page_works_with_the_keyboard_alone(opened):
    from selenium.webdriver import Keys

    browser = opened()
    chart = browser.find_element("id", "chart-position")
    value = "return document.getElementById('slider').value"
    for keys, expected in (
        ([Keys.ARROW_RIGHT] * 3, "3"),
        ([Keys.SHIFT + Keys.ARROW_RIGHT + Keys.NULL], "13"),
        ([Keys.ARROW_LEFT], "12"),
        ([Keys.END], "59"),
        ([Keys.HOME], "0"),
    ):
        chart.send_keys(*keys)
        assert browser.execute_script(value) == expected
    slider = browser.find_element("id", "slider")
    slider.send_keys(Keys.ARROW_RIGHT)
    assert browser.execute_script(value) == "1"
    tabbed = (
        "return [...document.querySelectorAll('button, input, figure, canvas[role], a')].every((e)"
        " => e.tabIndex >= 0)"
    )
    assert browser.execute_script(tabbed)
    scene_canvas = browser.find_element("css selector", "#scene canvas")
    before = scene_canvas.screenshot_as_png
    scene_canvas.send_keys(Keys.ARROW_LEFT * 5)
    _settled(browser)
    assert scene_canvas.screenshot_as_png != before


@pytest.mark.slow
def test_points_are_coloured_by_residual_or_by_intensity(browser, make_rows, tmp_path):
    rows = make_rows(3)
    points = _view(rows).clouds[0].points
    cloud = thin_cloud(
        0, points, np.linspace(0, 0.01, len(points)), np.linspace(200, 0, len(points))
    )
    path = tmp_path / "bright.html"
    path.write_text(_page(rows, view=View(BOX, FACES, (cloud,))), encoding="utf-8")
    browser.get(path.as_uri())
    _settled(browser)
    canvas = browser.find_element("css selector", "#scene canvas")
    by_residual = canvas.screenshot_as_png
    assert "residual 0" in _text(browser, "#scene")
    (button,) = [
        b for b in browser.find_elements("css selector", "#scene button") if "intensity" in b.text
    ]
    browser.execute_script("arguments[0].click()", button)
    _settled(browser)
    assert "intensity 0" in _text(browser, "#scene")
    assert canvas.screenshot_as_png != by_residual


@pytest.mark.slow
def test_a_legend_key_hides_its_line(opened):
    browser = opened()
    canvas = browser.find_element("css selector", "#chart-position canvas")
    before = canvas.screenshot_as_png
    key = browser.find_element("css selector", "#chart-position .key")
    key.click()
    _settled(browser)
    assert key.get_attribute("aria-pressed") == "false"
    assert canvas.screenshot_as_png != before


@pytest.mark.slow
def test_play_runs_to_the_end_and_stops(opened):
    browser = opened()
    _slide(browser, 55)
    browser.find_element("id", "play").click()
    while _text(browser, "#play") == "Pause":  # without an end if the button does not stop
        time.sleep(0.05)
    assert _text(browser, "#play") == "Play"
    assert _text(browser, "#now").startswith("scan 59 ")


@pytest.mark.slow
def test_the_theme_button_changes_every_colour(opened):
    browser = opened()
    canvas = browser.find_element("css selector", "#chart-position canvas")
    before = canvas.screenshot_as_png
    browser.find_element("id", "theme").click()
    _settled(browser)
    assert browser.execute_script("return document.documentElement.dataset.theme") == "dark"
    assert canvas.screenshot_as_png != before


@pytest.mark.slow
def test_text_has_contrast_in_both_themes(opened):
    """WCAG contrast of 4.5 for text, 3 for lines."""
    script = """const s = getComputedStyle(document.documentElement);
    return Object.fromEntries(arguments[0].map((n) => [n, s.getPropertyValue(n).trim()]))"""
    names = [
        "--ground",
        "--card",
        "--ink",
        "--faint",
        "--accent",
        "--good",
        "--bad",
        "--warn",
        "--c0",
        "--c1",
        "--c2",
        "--c3",
    ]
    for dark in (False, True):
        found = opened(dark=dark).execute_script(script, names)
        for name in names[2:]:
            for ground in ("--ground", "--card"):
                least = 3.0 if name.startswith("--c") else 4.5
                assert _contrast(found[name], found[ground]) >= least, (dark, name, ground)


def _contrast(one, two):
    def luminance(text):
        return float(_linear(text) @ [0.2126, 0.7152, 0.0722])

    high, low = sorted((luminance(one), luminance(two)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_a_run_of_one_scan_loads(opened, make_rows, n):
    rows = make_rows(n, pos_err_m=None, rot_err_deg=None)
    browser = (
        opened(rows=rows, truth=None, poses=(), view=None)
        if n == 1
        else opened(rows=rows, view=None)
    )
    assert browser.get_log("browser") == []
    assert _text(browser, "#now").startswith("scan 0 ")
    low, high = browser.execute_script(
        "const x = uPlot.sync('time').plots[0].scales.x; return [x.min, x.max];"
    )
    assert high - low <= 1.0


@pytest.mark.slow
def test_a_comparison_overlays_and_reads_runs_of_different_rates(browser, tmp_path, make_rows):
    from avsreplay.report.page import build_comparison

    for name, rows in (("one", make_rows(60)), ("two", make_rows(60)[::2])):
        (tmp_path / name).mkdir()
        write_rows(tmp_path / name / "rows.jsonl", rows)
    results = [load_result(tmp_path / name) for name in ("one", "two")]
    path = tmp_path / "c.html"
    path.write_text(build_comparison(results, []), encoding="utf-8")
    browser.get(path.as_uri())
    assert browser.get_log("browser") == []
    outputs = (
        "return [...document.querySelectorAll('#chart-sigma1 output')].map((o) => o.textContent)"
    )
    _slide(browser, 4)
    one, two = browser.execute_script(outputs)
    assert one == two != "\u2013"
    _slide(browser, 5)
    assert browser.execute_script(outputs)[1] == "\u2013"


@pytest.mark.slow
def test_a_value_between_two_scans_without_one_is_drawn(opened, make_rows):
    rows = [dataclasses.replace(r, rms_m=0.01 if r.seq == 30 else None) for r in make_rows(300)]
    browser = opened(rows=rows)
    script = """const c = document.querySelector('#chart-fit canvas');
    const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
    let n = 0;
    for (let i = 0; i < d.length; i += 4)
        if (d[i] < 40 && d[i + 1] > 80 && d[i + 2] > 140 && d[i + 3] > 200) n++;
    return n;"""
    assert browser.execute_script(script) > 4


@pytest.mark.slow
def test_on_a_narrow_screen_no_table_is_cut_and_each_value_has_its_head(opened):
    browser = opened(width=390)
    script = """const boxes = [...document.querySelectorAll('.scroll')];
    const cell = document.querySelector('.many td:not(:empty)');
    return [Math.max(...boxes.map((b) => b.scrollWidth - b.clientWidth)),
            getComputedStyle(cell, '::before').content, cell.dataset.head,
            document.documentElement.scrollWidth];"""
    hidden, said, head, width = browser.execute_script(script)
    assert hidden <= 0
    assert head
    assert head in said
    assert width <= 390


@pytest.mark.slow
def test_zoom_and_scan_are_in_the_address(opened):
    browser = opened()
    _slide(browser, 10)
    assert "row=10" in browser.execute_script("return location.hash")
    browser.execute_script("location.hash = '#t=2,4&row=17'")
    _settled(browser)
    assert browser.execute_script("return document.getElementById('slider').value") == "17"
    browser.refresh()
    _settled(browser)
    assert browser.execute_script("return document.getElementById('slider').value") == "17"
    assert browser.execute_script("return location.hash") == "#t=2,4&row=17"


@pytest.mark.slow
def test_a_bar_has_a_tooltip_and_hovering_moves_the_3d_view(opened):
    browser = opened()
    script = """const over = document.querySelector('#chart-state .u-over');
    const r = over.getBoundingClientRect(), x = r.width * 22 / 59, y = r.height / 6;
    const at = { clientX: r.left + x, clientY: r.top + y, bubbles: true };
    over.dispatchEvent(new MouseEvent('mousemove', at));
    return over.title;"""
    assert browser.execute_script(script).startswith("flagged: no scan, 4.00 s to 5.00 s")
    _settled(browser)
    assert "no points of this scan" in _text(
        browser, "#scene"
    )  # the scan under the pointer is in the blackout
    assert not _text(browser, "#now").startswith("scan 0 ")


@pytest.mark.slow
def test_the_tables_and_figures_of_a_campaign_can_be_read_at_every_width(browser, tmp_path):
    from avsreplay.sweep.page import build_sweep_page
    from avsreplay.sweep.statistics import quantiles, rate
    from avsreplay.sweep.summary import CAMPAIGN_METRICS, Cell, SweepSummary, WorstRun

    rates = {
        name: rate(3, 9)
        for name in ("converged", "capture planned", "no fault missed", "no false alarm")
    }
    metrics = {name: quantiles([0.1 * k for k in range(9)]) for name in CAMPAIGN_METRICS}
    cells = tuple(
        Cell({"scenario.scanner.noise_m": noise}, 9, {"ok": 9}, metrics, rates, None)
        for noise in (0.004, 0.008)
    )
    worst = (
        WorstRun(
            "a" * 24, 1, 0, 3325833263181678374, "ok", "position error 0.01085 m (healthy scan)"
        ),
    )
    summary = SweepSummary("noise", 18, 18, {"ok": 18}, cells, None, worst=worst)
    (tmp_path / "page.html").write_text(build_sweep_page(summary), encoding="utf-8")
    for width in (1400, 390):
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get((tmp_path / "page.html").as_uri())
        script = """const boxes = [...document.querySelectorAll('.scroll')];
            const labels = [...document.querySelectorAll('.figure text')];
            return [document.documentElement.scrollWidth,
                Math.max(...boxes.map((b) => b.scrollWidth - b.clientWidth)),
                Math.min(...labels.map((t) => t.getBoundingClientRect().height))]"""
        page, hidden, text = browser.execute_script(script)
        assert page <= width
        assert text >= 10  # pixels
        assert width < 500 or hidden <= 0  # nothing is cut off where there is room
