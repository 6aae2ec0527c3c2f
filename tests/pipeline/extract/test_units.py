"""Positions in other units than their fields are for, by what they are and as what they come out."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, fix, stamp
from pyproj import Transformer
from test_extract import fails, mk, run

from cadence.errors import ConfigError, InputError
from pipeline.frames import to_geodetic

DEGREE_M = 111_195.0
TO_CENTRE = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def track(latitude: float, longitude: float, speed_mps: float, scale: float = 1.0, num: int = 30) -> list[Row]:
    """A target that goes east at a steady speed, in degrees times a scale."""
    east = np.arange(num) * speed_mps / (DEGREE_M * np.cos(np.radians(latitude)))
    return [fix(float(i), latitude * scale, (longitude + step) * scale) for i, step in enumerate(east)]


def metric(positions: np.ndarray, frame: str = "map", **more: Any) -> list[Row]:
    """Odometry of the positions [N, 2 or 3], a second apart."""
    rows = []
    for i, place in enumerate(positions):
        pose = {"pose": {"position": dict(zip("xyz", place.tolist(), strict=False))}, **more}
        rows.append(
            Row("/contacts/a", "nav_msgs/Odometry", float(i), {"header": {"stamp": stamp(i), "frame_id": frame}, "pose": pose})
        )
    return rows


def east_and_north(found: Any) -> tuple[float, float]:
    x, y = (np.ptp(np.asarray(found.detections[name])) for name in ("x_m", "y_m"))
    return float(x), float(y)


def where(found: Any) -> tuple[float, float]:
    latitude, longitude = to_geodetic(found.frame, *(np.asarray(found.detections[name]) for name in ("x_m", "y_m")))
    return float(np.median(latitude)), float(np.median(longitude))


@pytest.mark.parametrize(("unit", "scale"), [("rad", np.pi / 180), ("1e-7 deg", 1e7)])
def test_other_units_of_angle(tmp_path: Path, unit: str, scale: float) -> None:
    rows = track(48.1, 11.6, 20.0, scale)
    if unit == "1e-7 deg":
        for row in rows:
            row.message.update(latitude=round(row.message["latitude"]), longitude=round(row.message["longitude"]))  # type: ignore[union-attr, call-overload, index]
    found = run(tmp_path, rows)
    assert where(found) == pytest.approx((48.1, 11.6), abs=0.01) and east_and_north(found)[0] == pytest.approx(
        20.0 * 29, rel=0.01
    )
    (suspicion,) = found.summary["suspicions"]
    assert (suspicion["kind"], suspicion["subject"]) == ("place", "/contacts/A")
    assert suspicion["setting"] == f'unit = "{unit}" or "deg" in its [[extract.detections]]'
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "unit": unit}])
    assert told.summary["suspicions"] == [] and told.detections.equals(found.detections)


def test_degrees_as_the_user_says(tmp_path: Path) -> None:
    found = run(tmp_path, track(48.1, 11.6, 20.0, np.pi / 180), detections=[{"topic": "/contacts/{agent}", "unit": "deg"}])
    assert found.summary["suspicions"] == [] and where(found) == pytest.approx((0.84, 0.2), abs=0.01)


@pytest.mark.parametrize(
    ("latitude", "longitude", "speed_mps"),
    [
        (0.0, 0.0, 3.0),  # a simulator without a place
        (0.05, 0.03, 1.0),
        (1.0, 2.5, 9.0),  # a ship off Ghana: 500 m/s in radians
        (48.1, 11.6, 900.0),
        (-33.9, 151.2, 0.0),
        (51.5, 0.0, 2.0),
        (89.9, 100.0, 1.0),
    ],
)
def test_degrees_are_left_alone(tmp_path: Path, latitude: float, longitude: float, speed_mps: float) -> None:
    found = run(tmp_path, track(latitude, longitude, speed_mps))
    assert found.summary["suspicions"] == [] and found.summary["num_detections"] == 30


def test_a_slow_ship_off_ghana_with_the_decimals_of_degrees(tmp_path: Path) -> None:
    rows = [fix(float(i), 1.0, round(2.5 + 1e-5 * i, 6)) for i in range(30)]
    assert run(tmp_path, rows).summary["suspicions"] == []


@pytest.mark.parametrize("scale", [1e5, 1e6, 600_000.0])
def test_whole_numbers_of_which_power_nobody_knows(tmp_path: Path, scale: float) -> None:
    rows = [fix(float(i), round((48.1 + 1e-4 * i) * scale), round(11.6 * scale)) for i in range(30)]
    fails(tmp_path, rows, InputError, r"whole numbers: 1e-7 or 1e-6 degrees, parts of minutes, or metres \(UTM\); left out")
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "unit": "1e-7 deg"}])
    assert told.summary["suspicions"] == [] and where(told)[0] == pytest.approx(48.1 * scale / 1e7, rel=1e-3)


def test_degrees_without_decimals_are_named(tmp_path: Path) -> None:
    (suspicion,) = run(tmp_path, [fix(float(i), 48.0, 11.0) for i in range(30)]).summary["suspicions"]
    assert "all without decimals" in suspicion["seen"]


def minutes(degrees: float) -> float:
    """Degrees and minutes in one number."""
    return np.trunc(degrees) * 100 + (degrees - np.trunc(degrees)) * 60


@pytest.mark.parametrize("start", [(48.1, 11.6), (-33.999, 151.2), (48.999, -122.3)])
def test_degrees_and_minutes_as_nmea_has_them(tmp_path: Path, start: tuple[float, float]) -> None:
    ways = [(start[0] + 1e-4 * i, start[1]) for i in range(30)]
    rows = [fix(float(i), minutes(latitude), minutes(longitude)) for i, (latitude, longitude) in enumerate(ways)]
    found = run(tmp_path, rows)
    assert where(found) == pytest.approx(start, abs=0.01) and east_and_north(found)[1] == pytest.approx(322.0, abs=3.0)
    (suspicion,) = found.summary["suspicions"]
    assert suspicion["done"] == "read as degrees and minutes"
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "unit": "ddmm.mm"}])
    assert told.summary["suspicions"] == [] and told.detections.equals(found.detections)


def test_exchanged_latitudes_and_longitudes(tmp_path: Path) -> None:
    rows = [fix(float(i), 151.2 + 1e-4 * i, -33.9) for i in range(30)]
    found = run(tmp_path, rows)
    assert where(found) == pytest.approx((-33.9, 151.2), abs=0.01)
    assert "exchanged" in found.summary["suspicions"][0]["done"]


@pytest.mark.parametrize("start", [(20.0, -40.0), (300.0, 500.0)])
def test_metres_in_fields_of_degrees(tmp_path: Path, start: tuple[float, float]) -> None:
    rows = [fix(float(i), start[0] + 1.5 * i, start[1] + 0.5 * i) for i in range(30)]
    fails(
        tmp_path,
        rows,
        InputError,
        r"nothing that can be meant is left of the detections: place of /contacts/A: .* may be metres",
    )
    told = run(tmp_path, rows, detections=[{"topic": "/contacts/{agent}", "x": "longitude", "y": "latitude"}])
    assert east_and_north(told) == pytest.approx((0.5 * 29, 1.5 * 29))


def test_metres_in_fields_of_degrees_beside_sound_ones(tmp_path: Path) -> None:
    rows = [*track(48.1, 11.6, 5.0), *(fix(float(i), 20.0 + 1.5 * i, 7.0, "/contacts/B") for i in range(30))]
    found = run(tmp_path, rows)
    assert set(found.detections["agent_id"].to_pylist()) == {"A"} and "left out" in found.summary["suspicions"][0]["done"]


def test_degrees_in_fields_of_metres_are_named(tmp_path: Path) -> None:
    way = np.column_stack([11.6 + 2e-4 * np.arange(40), np.full(40, 48.1), np.full(40, 500.0)])
    found = run(tmp_path, metric(way))
    assert "may be degrees" in found.summary["suspicions"][0]["seen"] and found.summary["num_detections"] == 40


@pytest.mark.parametrize(
    "way",
    [
        np.column_stack([3.0 * np.arange(40), np.full(40, 48.1)]),
        np.column_stack([11.6 + 1e-3 * np.random.default_rng(1).normal(size=40), np.full(40, 48.1)]),  # stands, with noise
        np.tile([11.6, 48.1], (40, 1)),
        np.column_stack([11.6 + 0.05 * np.arange(40), np.full(40, 48.1)]),
    ],
)
def test_metres_are_left_alone(tmp_path: Path, way: np.ndarray) -> None:
    assert run(tmp_path, metric(way)).summary["suspicions"] == []


def earth_centred(num: int = 30) -> np.ndarray:
    """Due north at 10 m/s from 60 N 20 E, 30 m above the ellipsoid."""
    latitude = 60.0 + 10.0 * np.arange(num) / 111_412.0
    return np.column_stack(TO_CENTRE.transform(np.full(num, 20.0), latitude, np.full(num, 30.0)))


@pytest.mark.parametrize(("frame", "num_suspicions"), [("earth", 0), ("gnss/ECEF", 0), ("ins", 1)])
def test_earth_centred_positions(tmp_path: Path, frame: str, num_suspicions: int) -> None:
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = 4.0, 4.0, 4.0
    found = run(tmp_path, metric(earth_centred(), frame, covariance=covariance.tolist()))
    assert east_and_north(found) == pytest.approx((0.0, 290.0), abs=0.1) and found.frame.is_georeferenced
    assert np.asarray(found.detections["z_m"]) == pytest.approx(30.0, abs=1e-3)
    assert (
        np.asarray(found.detections["cov_xx_m2"]) == pytest.approx(4.0) and len(found.summary["suspicions"]) == num_suspicions
    )


def test_covariances_turn_with_the_earth(tmp_path: Path) -> None:
    """At 0 N 90 E: the earth's x points west, its y up, its z north."""
    place = np.column_stack([np.zeros(5), np.full(5, 6_378_137.0), np.zeros(5)])
    covariance = np.zeros(36)
    covariance[[0, 7, 14]] = 1.0, 9.0, 4.0
    found = run(tmp_path, metric(place, "earth", covariance=covariance.tolist()))
    assert (found.detections["cov_xx_m2"][0].as_py(), found.detections["cov_yy_m2"][0].as_py()) == pytest.approx((1.0, 4.0))


def test_what_only_looks_earth_centred(tmp_path: Path) -> None:
    """UTM at 57 N: as far from zero as the earth's surface from its centre, but on the ground."""
    way = np.column_stack([500_000.0 + 3.0 * np.arange(30), np.full(30, 6_350_000.0), np.full(30, 12.0)])
    assert run(tmp_path, metric(way, "utm")).summary["suspicions"] == []
    local = run(tmp_path, metric(way - [5e5, 6.35e6, 0.0], "earth"))
    assert "the earth's centre by its name" in local.summary["suspicions"][0]["seen"]


def test_units_that_do_not_fit(tmp_path: Path) -> None:
    source = {"topic": "/contacts/{agent}", "unit": "ecef"}
    fails(
        tmp_path,
        track(48.1, 11.6, 5.0),
        ConfigError,
        "unit 'ecef' is none of latitude and longitude; expected",
        detections=[source],
    )
    source["unit"] = "rad"
    fails(tmp_path, metric(earth_centred()), ConfigError, "unit 'rad' is none of x and y; expected", detections=[source])


def test_a_trusted_log_is_taken_as_it_stands(tmp_path: Path) -> None:
    found = run(tmp_path, track(48.1, 11.6, 20.0, np.pi / 180), trusted=["place"])
    assert found.summary["suspicions"] == [] and where(found) == pytest.approx((0.84, 0.2), abs=0.01)


def test_scaled_degrees_in_fields_of_metres(tmp_path: Path) -> None:
    way = np.column_stack([116_000_000 + 1300 * np.arange(40), np.full(40, 481_000_000)])
    fails(tmp_path, metric(way.astype(float)), InputError, "whole numbers, which may be 1e-7 degrees; left out")


def test_degrees_of_several_ships_in_fields_of_metres_are_named(tmp_path: Path) -> None:
    """x is the longitude, as libais writes it; two ships in turn are no smooth way."""
    ways = [(4.0 + 7e-5 * i, 55.0, "1") if i % 2 else (4.0, 55.0 + 5e-5 * i, "2") for i in range(60)]
    found = run(tmp_path, [detection(float(i), x, y, agent_id=name) for i, (x, y, name) in enumerate(ways)])
    (told,) = found.summary["suspicions"]
    assert "which may be degrees" in told["seen"]


def test_radians_in_fields_of_metres_are_named(tmp_path: Path) -> None:
    way = np.radians(np.column_stack([11.6 + 1e-4 * np.arange(40), np.full(40, 48.1)]))
    (suspicion,) = run(tmp_path, metric(way)).summary["suspicions"]
    assert "may be radians" in suspicion["seen"] and "used as metres" in suspicion["done"]


def test_what_stands_and_drifts_is_in_metres(tmp_path: Path) -> None:
    """A filter that settles on a millimetre is smooth, and goes nowhere."""
    way = np.column_stack([0.3 + 1e-3 * np.exp(-np.arange(60) / 8.0), 0.7 - 1e-3 * np.exp(-np.arange(60) / 5.0)])
    assert run(tmp_path, metric(way)).summary["suspicions"] == []


def test_millimetres_are_named(tmp_path: Path) -> None:
    way = np.column_stack([1500.0 * np.arange(40), np.full(40, 3e4)])
    (suspicion,) = run(tmp_path, metric(way)).summary["suspicions"]
    assert "which move on at 1500 m/s: may be millimetres" in suspicion["seen"]
    told = run(tmp_path, metric(way), detections=[{"topic": "/contacts/{agent}", "unit": "m"}])
    assert told.summary["suspicions"] == []


def test_millimetres_of_the_only_target_are_named(tmp_path: Path) -> None:
    ways = np.column_stack([10_000.0 * np.arange(60), 4000.0 * np.arange(60)])
    rows = [Row("/target/detections", row.schema, row.time_s, row.message) for row in metric(ways)]
    assert "may be millimetres" in run(mk(tmp_path / "a"), rows).summary["suspicions"][0]["seen"]
    turns = np.random.default_rng(0).uniform(0, 1e5, (60, 2))  # several targets far from each other, in turn
    several = [Row("/target/detections", row.schema, row.time_s, row.message) for row in metric(turns)]
    assert run(mk(tmp_path / "b"), several).summary["suspicions"] == []


@pytest.mark.parametrize(
    ("reading", "words", "num"),
    [
        (lambda place: np.radians(place), "if they were radians", 90),
        (lambda place: np.rint(place * 1e7), "if they were 1e-7 degrees", 90),
        (lambda place: place[::-1], "if they were exchanged", 60),
        (lambda place: place * [1, -1], "if they were of the other side of Greenwich", 60),
        (lambda place: place + 0.5, "", 90),
        (lambda place: place + 20.0, "", 90),
    ],
)
@pytest.mark.parametrize("is_first", [True, False])
def test_a_source_that_changes_in_its_midst(tmp_path: Path, reading: Any, words: str, num: int, is_first: bool) -> None:
    """A third of it is in another reading: at its beginning, or at its end."""
    places = np.column_stack([np.full(90, 48.1), 11.6 + 1e-4 * np.arange(90)])
    other = range(30) if is_first else range(60, 90)
    rows = [fix(float(i), *(reading(place) if i in other else place), topic="/target/fix") for i, place in enumerate(places)]
    found = run(tmp_path, rows)
    assert found.summary["num_detections"] == num
    assert [words in suspicion["seen"] for suspicion in found.summary["suspicions"]] == [True] * bool(words)
    if words:
        assert where(found) == pytest.approx((48.1, 11.6045), abs=0.01) and max(east_and_north(found)) < 700.0


@pytest.mark.parametrize("longitude", [lambda degrees: (degrees + 180.0) % 360.0 - 180.0, lambda degrees: degrees])
def test_a_way_over_the_antimeridian_is_one(tmp_path: Path, longitude: Any) -> None:
    rows = [fix(float(i), -17.0, longitude(179.99123 + 1e-3 * i), topic="/target/fix") for i in range(60)]
    found = run(tmp_path, rows)
    assert (found.summary["num_detections"], found.summary["suspicions"]) == (60, [])
    assert max(east_and_north(found)) == pytest.approx(59 * 106.5, rel=0.01)


@pytest.mark.parametrize("unknown", [-2e10, -999.0])
def test_radians_of_a_receiver_that_says_what_it_does_not_know(tmp_path: Path, unknown: float) -> None:
    places = np.radians(np.column_stack([48.1 + 5e-5 * np.arange(60), 11.6 + 1e-4 * np.arange(60)]))
    places[:20] = unknown
    found = run(tmp_path, [fix(float(i), *place, topic="/target/fix") for i, place in enumerate(places)])
    assert found.summary["num_detections"] == 40 and where(found) == pytest.approx((48.1, 11.604), abs=0.01)
    assert "radians" in found.summary["suspicions"][0]["seen"]


def test_targets_on_both_sides_of_greenwich(tmp_path: Path) -> None:
    """Ships without names, seen in turn, are no target that leaps."""
    rows = [fix(float(i), 50.0 + 1e-4 * i, 3.0 if i % 2 else -3.0, topic="/ais/detections") for i in range(40)]
    assert run(tmp_path, rows).summary["suspicions"] == []


def test_noise_of_a_fast_source_is_no_speed(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = metric(rng.normal(0, 30.0, (60, 2)))
    fast = [Row(row.topic, row.schema, 0.01 * i, row.message | {"header": {"stamp": stamp(0.01 * i), "frame_id": "map"}})  # type: ignore[operator]
            for i, row in enumerate(rows)]  # fmt: skip
    assert not any("millimetres" in found["seen"] for found in run(tmp_path, fast).summary["suspicions"])
