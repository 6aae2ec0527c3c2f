"""Geodetic ↔ local metres, against the ellipsoid's own geodesics."""

import numpy as np
import pytest
from pyproj import Geod

from cadence.errors import InputError
from pipeline.frames import georeferenced_frame, to_geodetic, to_local
from pipeline.tables import Frame

SOLENT = Frame("mission", 50.7947, -1.1112)


def test_distance_and_bearing_from_the_datum_are_those_of_the_ellipsoid() -> None:
    latitude, longitude = np.array([50.9, 50.0, 55.0]), np.array([-1.0, -3.0, 4.0])
    x_m, y_m = to_local(SOLENT, latitude, longitude)
    ones = np.ones(3)
    bearing, _, distance = Geod(ellps="WGS84").inv(ones * -1.1112, ones * 50.7947, longitude, latitude)
    np.testing.assert_allclose(np.hypot(x_m, y_m), distance, atol=1e-3)
    np.testing.assert_allclose(np.degrees(np.arctan2(x_m, y_m)), bearing, atol=1e-6)


def test_round_trip() -> None:
    generator = np.random.default_rng(0)
    latitude, longitude = 50.8 + generator.normal(size=50), -1.1 + generator.normal(size=50)
    back = to_geodetic(SOLENT, *to_local(SOLENT, latitude, longitude))
    np.testing.assert_allclose(back, (latitude, longitude), atol=1e-9)


@pytest.mark.parametrize(("distance_m", "bound"), [(50e3, 1.1e-5), (100e3, 4.2e-5), (500e3, 1.1e-3)])
def test_distortion_is_what_the_docstring_says(distance_m: float, bound: float) -> None:
    geod = Geod(ellps="WGS84")
    longitude, latitude, _ = geod.fwd([-1.1112] * 2, [50.7947] * 2, [90.0, 90.01], [distance_m] * 2)
    x_m, y_m = to_local(SOLENT, np.array(latitude), np.array(longitude))
    _, _, true_m = geod.inv(longitude[0], latitude[0], longitude[1], latitude[1])
    stretch = np.hypot(np.diff(x_m), np.diff(y_m))[0] / true_m - 1
    assert 0.8 * bound < stretch < bound


def test_datum_is_the_rounded_median() -> None:
    frame = georeferenced_frame(np.array([50.11111, 50.22222, 59.0]), np.array([-1.0, -1.234567, -2.0]))
    assert (frame.frame_id, frame.latitude_deg, frame.longitude_deg) == ("mission", 50.2222, -1.2346)


def test_datum_across_the_antimeridian() -> None:
    frame = georeferenced_frame(np.array([-17.0, -17.0, -17.0]), np.array([179.9, -179.9, -179.8]))
    assert frame.longitude_deg == pytest.approx(-179.9)
    x_m, _ = to_local(frame, np.array([-17.0, -17.0]), np.array([179.9, -179.8]))
    assert x_m == pytest.approx([-21290, 10645], rel=1e-3)


def test_stated_datum_wins() -> None:
    assert georeferenced_frame(np.array([50.0]), np.array([1.0]), (49.5, 0.5)) == Frame("mission", 49.5, 0.5)


def test_errors() -> None:
    with pytest.raises(InputError, match=r"extract\.datum"):
        georeferenced_frame(np.zeros(0), np.zeros(0))
    with pytest.raises(InputError, match="no datum"):
        to_local(Frame("map"), np.zeros(1), np.zeros(1))
