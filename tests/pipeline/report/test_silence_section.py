"""The section on silence: what was covered when, curves, and how much of it is believed."""

import dataclasses
import re

import numpy as np
import pytest

from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.silence import Looks
from pipeline.looks import Footprint
from pipeline.report.maps import View
from pipeline.report.mission import Mission, Points
from pipeline.report.silence import coverage, silence_section

CURVE = ((0.0, 0.5), (100.0, 0.5), (101.0, 0.0))


def looks(time_s: np.ndarray, place_m: tuple[float, float], hits: int = 0) -> Looks:
    num = len(time_s)
    seen = tuple(frozenset({"T0"}) if i < hits else frozenset() for i in range(num))
    curve = DetectionCurve(*np.array(CURVE).T)
    return Looks(time_s, np.tile(place_m, (num, 1)), np.ones(num), np.zeros(num), curve, seen=seen)


def test_coverage_is_the_share_of_the_time_in_which_one_would_be_seen():
    mast = Footprint("mast", (CURVE,))
    places = np.array([[0.0, 50.0], [0.0, 150.0]])
    always, half = looks(np.arange(0.0, 240.0), (0.0, 0.0)), looks(np.arange(0.0, 120.0), (0.0, 0.0))
    assert coverage([(mast, always)], places, 0.0, 240.0).tolist() == pytest.approx([1.0 - 0.5**10, 0.0], abs=0.002)
    assert coverage([(mast, half)], places, 0.0, 240.0).tolist() == pytest.approx([0.5, 0.0], abs=0.01)
    assert coverage([(mast, half)], places, 120.0, 240.0).tolist() == [0.0, 0.0]
    many = looks(np.arange(0.0, 240.0, 0.05), (0.0, 0.0))
    assert coverage([(mast, many)], places, 0.0, 240.0)[0] == pytest.approx(1.0)


def test_pixels_and_metres_agree():
    view = View(np.array([[0.0, 0.0], [300.0, 500.0]]))
    places = np.array([[10.0, 20.0], [-70.0, 499.0]])
    np.testing.assert_allclose(view.metres(view.pixels(places)), places)


def mission(silence: dict | None, *given: tuple[Footprint, Looks]) -> Mission:
    empty = {field.name: None for field in dataclasses.fields(Mission)}
    seen = Points(np.array([10**9]), np.array([0]), np.array([[20.0, 30.0]]))
    found = Mission.__new__(Mission)
    manifests = {} if silence is None else {"infer": {"summary": {"silence": silence}}}
    values = empty | {"looks": given, "start_ns": 0, "end_ns": 240 * 10**9, "detections": seen}
    values |= {"poses": None, "fans": (), "manifests": manifests}
    for name, value in values.items():
        object.__setattr__(found, name, value)
    return found


def test_the_section_tells_curves_and_belief():
    mast = Footprint("mast <1>", (CURVE,), trust=0.8)
    plane = Footprint("plane", (CURVE, ((0.0, 0.9), (50.0, 0.0))), num_looks=1200, num_hits=90)
    given = ((mast, looks(np.arange(0.0, 240.0), (0.0, 0.0), 3)), (plane, looks(np.arange(0.0, 60.0), (50.0, 0.0))))
    told = {"exponent": 0.6, "num_tests": 20, "ratios": {"0.6": 0.91}}
    page = silence_section(mission(told, *given))
    assert page.count('<svg class="map"') == 4 and page.count('class="covered"') > 20 and page.count('class="detection"') == 1
    assert "count less: by 0.6 of what independent looks would say, as 20 withheld detections advise" in page and "0.91" in page
    assert "mast &lt;1&gt;" in page and "believed 0.80: it contradicts detections" in page
    assert (
        "fitted on 1,200 looks, 90 hits" in page
        and page.count("<polyline") == page.count('fill="none" points') == 3
        and "from 0 %" not in page
    )
    assert re.search(r'240</td><td class="number">3<', page)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (None, "None of it was used"),
        ({"exponent": 0.0, "num_tests": 9, "ratios": {"0.3": 1.1}}, "is not used, as hypotheses weighed by it miss 9 withheld"),
        ({"exponent": 0.3, "num_tests": 2, "ratios": {}}, "as too few withheld detections can tell"),
    ],
)
def test_what_is_not_used_is_said(told, words):
    footprint = Footprint("mast", (CURVE,))
    assert words in silence_section(mission(told, (footprint, looks(np.arange(9.0), (0.0, 0.0)))))
    assert silence_section(mission(told)) == ""
