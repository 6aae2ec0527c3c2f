import numpy as np
import pytest

from pipeline.tracks import DetectionTrack, interpolated


def test_positions_between_samples_by_hand() -> None:
    time_ns = np.array([0, 10, 20, 100])
    position_m = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [90.0, 10.0]])
    at_ns = np.array([[-1, 0, 5, 15], [20, 50, 100, 101]])
    unknown = [np.nan, np.nan]
    expected = [[unknown, [0, 0], [5, 0], [10, 5]], [[10, 10], unknown, [90, 10], unknown]]
    np.testing.assert_allclose(interpolated(time_ns, position_m, at_ns, 30), expected)
    np.testing.assert_allclose(interpolated(time_ns, position_m, at_ns, 80)[1, 1], [40, 10])


@pytest.mark.parametrize("num", [0, 1, 2, 7])
def test_a_track_is_known_at_its_samples_whatever_the_gaps(num: int) -> None:
    time_ns, position_m = np.arange(num) ** 3, np.arange(2.0 * num).reshape(num, 2)
    np.testing.assert_allclose(interpolated(time_ns, position_m, time_ns, 0), position_m)
    assert np.isnan(interpolated(time_ns, position_m, np.array([-1, 10**6]), 10**9)).all()


def test_samples_of_one_time_are_no_gap() -> None:
    found = interpolated(np.array([5, 5, 5]), np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), np.array([4, 5, 6]), 10)
    assert np.isfinite(found[:, 0]).tolist() == [False, True, False]


def test_tracks_one_behind_the_other() -> None:
    one, other = (
        DetectionTrack(np.arange(n), np.full((n, 2), float(n)), np.broadcast_to(np.eye(2), (n, 2, 2))) for n in (2, 3)
    )
    both = DetectionTrack.one_behind_the_other([one, other])
    assert len(both) == 5 and both.time_ns.tolist() == [0, 1, 0, 1, 2]
    assert both[2:].position_m.tolist() == other.position_m.tolist()
