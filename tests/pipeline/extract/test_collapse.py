"""Simultaneous detections: copies, weighted means, exact ones, and what stays apart."""

import numpy as np
import pytest

from pipeline.extract.collapse import collapse
from pipeline.extract.positions import Positions, Rows

NAN = float("nan")


def positions(*rows: tuple[int, float, float, tuple[float, float, float], str | None, str | None]) -> Positions:
    """(milliseconds, x, y, covariance, agent, sensor) a row."""
    built = Rows()
    for place, (ms, x, y, covariance, agent, sensor) in enumerate(rows):
        built.integers.extend((ms * 10**6, ms * 10**6, place, place))
        built.floats.extend((x, y, 1.0, NAN, *covariance, NAN, NAN, NAN))
        built.agents.append(agent)
        built.sensors.append(sensor)
        built.frame_ids.append("map")
    return built.finish("/contacts", is_stated=True)


EXACT = (NAN, NAN, NAN)


def test_copies_become_one() -> None:
    found = collapse(positions((0, 1, 2, EXACT, "T", "b"), (0, 1, 2, (4, 0, 4), "T", "a"), (0, 1, 2, EXACT, "T", "b")), 0.001)
    assert found.num_merged.tolist() == [3]
    assert found.positions.sensor.tolist() == ["a+b"]
    assert found.positions.covariance_m2[0].tolist() == [4, 0, 4]


def test_inverse_covariance_weighting() -> None:
    found = collapse(positions((0, 0, 0, (1, 0, 4), "T", None), (0, 6, 6, (3, 0, 4), "T", None)), 0.0)
    assert found.positions.first[0] == pytest.approx(1.5)  # weights 3/4 and 1/4
    assert found.positions.second[0] == pytest.approx(3.0)
    np.testing.assert_allclose(found.positions.covariance_m2[0], [0.75, 0.0, 2.0])
    assert found.positions.sensor[0] is None


def test_exact_detections_leave_nothing_to_say_for_others() -> None:
    rows = positions((0, 0, 0, EXACT, "T", None), (0, 2, 4, EXACT, "T", None), (0, 50, 50, (9, 0, 9), "T", None))
    found = collapse(rows, 0.0)
    assert (found.positions.first[0], found.positions.second[0]) == (1.0, 2.0)
    assert np.isnan(found.positions.covariance_m2).all()


def test_other_agents_unknown_origins_and_later_moments_stay() -> None:
    rows = positions((0, 0, 0, EXACT, "T", None), (0, 0, 0, EXACT, "U", None), (0, 0, 0, EXACT, None, None),
                     (0, 0, 1, EXACT, None, None), (1, 0, 0, EXACT, None, None), (2, 0, 0, EXACT, "T", None))  # fmt: skip
    assert collapse(rows, 0.001).num_merged.tolist() == [1] * 6


def test_of_unknown_origin_only_copies_are_one() -> None:
    rows = positions((0, 0, 0, EXACT, None, "a"), (0, 5, 5, EXACT, None, "a"), (0, 0, 0, EXACT, None, "b"))
    found = collapse(rows, 0.001)
    assert found.num_merged.tolist() == [2, 1] and found.positions.sensor.tolist() == ["a+b", "a"]


def test_views_that_do_not_agree_are_not_averaged() -> None:
    rows = positions((0, 0, 0, (9, 0, 9), "T", "a"), (0, 50, 0, (1, 0, 1), "T", "b"), (0, 51, 0, (4, 0, 4), "T", "c"))
    found = collapse(rows, 0.001)
    assert found.num_disagreeing == 1 and found.num_merged.tolist() == [2] and found.positions.sensor.tolist() == ["b+c"]
    assert found.positions.first[0] == pytest.approx(50.2)  # weights 4/5 and 1/5


def test_a_dense_track_is_cut_into_pieces_of_the_tolerance() -> None:
    rows = positions(*((ms, float(ms), 0.0, (1.0, 0.0, 1.0), "T", None) for ms in range(10)))
    found = collapse(rows, 0.002)
    assert found.num_merged.tolist() == [3, 3, 3, 1]
    assert found.positions.time_ns.tolist() == [0, 3 * 10**6, 6 * 10**6, 9 * 10**6]
