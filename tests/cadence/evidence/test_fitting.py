"""Fitted curves of P(detect): right where there is much, refused where there is little, never rising."""

import numpy as np
import pytest

from cadence.evidence.fitting import fit_curve
from cadence.evidence.footprints import DetectionCurve

LAW = DetectionCurve(np.array([0.0, 1000.0, 3000.0]), np.array([0.9, 0.9, 0.0]))


@pytest.mark.parametrize(("num", "off"), [(300, 0.2), (20_000, 0.08)])
def test_the_law_is_found(num, off):
    generator = np.random.default_rng(2)
    distance = 6000.0 * np.sqrt(generator.random(num))
    found = fit_curve(distance, generator.random(num) < LAW(distance))
    assert found is not None and found.num_looks == num
    at = np.linspace(300.0, 2800.0, 12)
    assert np.abs(found.curve(at) - LAW(at)).max() < off
    assert (np.diff(found.curve.probability) <= 1e-12).all() and found.curve.reach <= 4500.0


def test_too_little_tells_nothing():
    generator = np.random.default_rng(2)
    distance = 6000.0 * generator.random(200)
    assert fit_curve(distance[:20], distance[:20] < 3000) is None
    assert fit_curve(distance, distance < 100) is None  # hardly a hit
    assert fit_curve(distance, distance > -1) is None  # never a miss: no end is seen
    assert fit_curve(np.full(200, np.nan), distance < 3000) is None
