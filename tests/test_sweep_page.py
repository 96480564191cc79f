"""The campaign's page: self-contained, well-formed, its figures where the numbers are."""

import re
from html.parser import HTMLParser

import pytest

from avsreplay.sweep.page import build_page, words
from avsreplay.sweep.statistics import ScoreHistogram, consistency, quantiles, rate
from avsreplay.sweep.summary import HEADLINES, Cell, Detector, SweepSummary

VOID = {"meta"}


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
    metrics = dict.fromkeys(HEADLINES) | {"convergence.t1_s": quantiles([1.0, 2.0, 3.0, 4.0])}
    cells = tuple(
        Cell({"scenario.name": name}, 4, {"ok": 4}, metrics, {"converged": rate(3, 4)}, consistency([20.0] * 4, 20))
        for name in ("<b>plain</b>", "other")
    )
    detector = Detector(50, 50, rate(40, 50), rate(1, 50), {"rms_m": curve(), "nis": None})
    return SweepSummary("a & b", 8, 8, {"ok": 8}, cells, detector)


def test_the_page_is_well_formed_and_needs_nothing_else(summary):
    page = build_page(summary)
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    assert checker.links == []
    assert "script" not in checker.seen
    assert "http" not in page
    assert page == build_page(summary)


def test_text_from_the_campaign_is_escaped(summary):
    page = build_page(summary)
    assert "<b>" not in page
    assert "name=&lt;b&gt;plain&lt;/b&gt;" in page
    assert "<title>a &amp; b</title>" in page


def test_figures_stand_where_their_numbers_are(summary):
    page = build_page(summary)
    (dot, *_) = re.findall(r'class="dot" cx="([\d.]+)"', page)
    ends = re.findall(r'<text x="([\d.]+)" y="32" text-anchor="middle">([\d.]+)<', page)
    (x0, low), (x1, high) = ends[0], ends[-1]
    expected = float(x0) + (2.5 - float(low)) / (float(high) - float(low)) * (float(x1) - float(x0))
    assert abs(float(dot) - expected) < 0.2
    assert "median 2.5" in page


def test_the_curve_rises_and_stays_in_its_frame(summary):
    points = re.search(r'<polyline[^>]*points="([^"]+)"', build_page(summary))[1]
    places = [tuple(map(float, p.split(","))) for p in points.split()]
    assert all(60 <= x <= 480 and 20 <= y <= 440 for x, y in places)
    assert [x for x, _ in places] == sorted(x for x, _ in places)
    assert [y for _, y in places] == sorted((y for _, y in places), reverse=True)


def test_an_empty_campaign_has_a_page_too():
    assert "0 of 3 runs done: none." in build_page(SweepSummary("x", 3, 0, {}, (), None))


def test_words_of_a_combination():
    assert words({"scenario.scanner.noise_m": 0.1, "run.faults.policy": "any", "case": "a"}) == (
        "scanner.noise_m=0.1, faults.policy=any, case=a"
    )
    assert words({}) == "as it is"
