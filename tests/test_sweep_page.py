"""The page of a campaign: self-contained, well-formed, with figures at their values."""

import dataclasses
import itertools
import re
from html.parser import HTMLParser

import pytest

from avsreplay.report.episodes import Peak
from avsreplay.sweep.page import build_sweep_page, round_ticks, words
from avsreplay.sweep.statistics import (
    FaultKind,
    ScoreHistogram,
    consistency,
    quantiles,
    rate,
    typical,
)
from avsreplay.sweep.summary import CAMPAIGN_METRICS, Cell, Detector, SweepSummary

VOID = {"meta", "link"}


class Checker(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.seen, self.links = [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.links += [v for k, v in attrs if k in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def curve():
    histogram = ScoreHistogram()
    for k in range(50):
        histogram.add(0.001 * (k + 1), False)
        histogram.add(0.02 + 0.001 * k, True)
    return histogram.roc()


@pytest.fixture
def summary():
    metrics = dict.fromkeys(CAMPAIGN_METRICS) | {
        "convergence.t1_s": quantiles([1.0, 2.0, 3.0, 4.0])
    }
    cells = tuple(
        Cell(
            {"scenario.name": name},
            4,
            {"ok": 4},
            metrics,
            {"converged": rate(3, 4)},
            consistency([20.0] * 4, 20),
        )
        for name in ("<b>plain</b>", "other")
    )
    detector = Detector(50, 50, rate(40, 50), rate(1, 50), {"rms_m": curve(), "nis": None})
    return SweepSummary("a & b", 8, 8, {"ok": 8}, cells, detector)


def test_the_page_is_well_formed_and_self_contained(summary):
    page = build_sweep_page(summary)
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert checker.links == ["data:,"]
    assert "script" not in checker.seen
    assert "http:" not in page
    assert "https:" not in page
    assert page == build_sweep_page(summary)


def test_text_from_the_campaign_is_escaped(summary):
    page = build_sweep_page(summary)
    assert "<b>" not in page
    assert "name=&lt;b&gt;plain&lt;/b&gt;" in page
    assert "<title>a &amp; b - avsreplay</title>" in page


def test_figures_are_placed_at_their_values(summary):
    page = next(re.finditer(r"<svg.*?</svg>", build_sweep_page(summary), re.S))[0]
    (dot, *_) = re.findall(r'class="dot" cx="([\d.]+)"', page)
    ends = re.findall(r'<text x="([\d.]+)" y="[\d.]+" text-anchor="middle">([\d.]+)<', page)
    (x0, low), (x1, high) = ends[0], ends[-1]
    expected = float(x0) + (2.5 - float(low)) / (float(high) - float(low)) * (float(x1) - float(x0))
    assert abs(float(dot) - expected) < 0.2
    assert "median 2.5" in page
    assert ">0: name=&lt;b&gt;plain&lt;/b&gt;<" in page  # the line is called by what was varied


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 4.38), (0.0, 8.76), (-0.3, 17.0), (2e-7, 3e-7), (5.0, 5.0), (0.0, 0.0)]
)
def test_the_ticks_of_an_axis_are_round_and_enclose_the_values(low, high):
    ticks = round_ticks(low, high)
    steps = {round((b - a) / (ticks[1] - ticks[0]), 6) for a, b in itertools.pairwise(ticks)}
    assert steps == {1.0}
    assert 2 <= len(ticks) <= 7
    assert ticks[0] <= low
    assert ticks[-1] >= high
    assert all(len(f"{tick:.10g}".lstrip("-0.").split("e")[0].rstrip("0")) <= 4 for tick in ticks)


def test_the_curve_rises_and_stays_in_its_frame(summary):
    points = re.search(r'<polyline[^>]*points="([^"]+)"', build_sweep_page(summary))[1]
    places = [tuple(map(float, p.split(","))) for p in points.split()]
    assert all(60 <= x <= 480 and 20 <= y <= 440 for x, y in places)
    assert [x for x, _ in places] == sorted(x for x, _ in places)
    assert [y for _, y in places] == sorted((y for _, y in places), reverse=True)


def _cells(text):
    rows = re.findall(r"<tr>(<th scope=.row.*?)</tr>", text[text.index("By kind of fault") :])
    return [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]


def test_faults_are_grouped_by_kind_with_false_alarms_first(summary):
    frozen = FaultKind(
        harmful=True,
        strengths=(),
        lengths_s=(2.0,),
        scans=8,
        flagged=rate(6, 8),
        episodes=2,
        detected=rate(2, 2),
        delay_s=typical([0.5, 1.5]),
        delay_scans=typical([1, 3]),
        lost=1,
        peak_flagged=Peak(0.0123, 0.004),
        peak_used=Peak(1.25, 178.6),
        peak_after=Peak(0.0003, 0.057),
    )
    clutter = FaultKind(False, (0.5,), (2.0,), 4, rate(0, 4), 1, rate(0, 1))
    none = FaultKind(False, (), (), 200, rate(1, 200))
    kinds = {"clutter": clutter, "frozen": frozen, "none": none}
    cells = tuple(dataclasses.replace(cell, kinds=kinds) for cell in summary.cells)
    page = build_sweep_page(dataclasses.replace(summary, cells=cells, detector=None))
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    found = _cells(page)
    assert [row[:2] for row in found] == [
        [k, n] for k in ("none", "clutter ~", "frozen") for n in ("0", "1")
    ]
    assert found[0][2:] == ["", "0.5%", *[""] * 7]
    assert found[2][2:] == ["0.5, 2 s", "0.0%", "0/1", "", "", "0", "", "", ""]
    peaks = ["12, 0.004", "1250, 179", "0.3, 0.057"]
    assert found[4][2:] == ["2 s", "75.0%", "2/2", "1, 1.5", "", "1", *peaks]


def test_without_faults_there_is_no_table_of_them(summary):
    none = {"none": FaultKind(False, (), (), 200, rate(1, 200))}
    cells = tuple(dataclasses.replace(cell, kinds=none) for cell in summary.cells)
    assert "By kind of fault" not in build_sweep_page(dataclasses.replace(summary, cells=cells))


def test_an_empty_campaign_has_a_page_too():
    assert "0 of 3 runs done: none." in build_sweep_page(SweepSummary("x", 3, 0, {}, (), None))


def test_words_of_a_combination():
    assert words({"scenario.scanner.noise_m": 0.1, "run.faults.policy": "any", "case": "a"}) == (
        "scanner.noise_m=0.1, faults.policy=any, case=a"
    )
    assert words({}) == "no change"
