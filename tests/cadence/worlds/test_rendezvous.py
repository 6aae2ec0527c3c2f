"""The world rendezvous: who meets, where nobody walks, what is seen; and the rule by which agents have met."""

import numpy as np
import pytest

from cadence.worlds.joint import JointRecordings, meets
from cadence.worlds.rendezvous import (
    STEP_S,
    RendezvousConfig,
    simulate_rendezvous,
    simulate_rendezvous_batch,
)
from cadence.worlds.rendezvous_map import GOALS_M, MAX_SHIFT_M, PLACES_M, SIDE_M, SITES_M, SPOT_M, ground, way
from cadence.worlds.terrain import blocks_segment

NUM_EPISODES = 300
STRIDES_M = (110.0, 157.0)


@pytest.fixture(scope="module")
def recorded() -> JointRecordings:
    return simulate_rendezvous_batch(RendezvousConfig(), 0, np.arange(NUM_EPISODES))


def tracks(joint: JointRecordings) -> list[np.ndarray]:
    """[A, T, 2] of every episode, in float64."""
    return [joint.track_m(episode).astype(np.float64) for episode in range(len(joint))]


def strides(track: np.ndarray) -> np.ndarray:
    """Lengths [A, T - 1] of all steps."""
    return np.hypot(*np.moveaxis(np.diff(track, axis=1), -1, 0))


def distance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Between all points [P, 2] and others [Q, 2]: [P, Q]."""
    return np.hypot(*np.moveaxis(points[:, None] - others, -1, 0))


def test_places_are_apart_and_free_of_mountains() -> None:
    place = ground()
    for some in (GOALS_M, SITES_M):
        assert some.shape == (6, 2)
    gaps = distance(PLACES_M, PLACES_M)[~np.eye(len(PLACES_M), dtype=bool)]
    assert gaps.min() > 3000.0
    assert 5 <= len(place.terrain.polygons_m) + len(place.terrain.circles_m) <= 7
    # Wherever an agent stops around a place, a way may begin there.
    bearing = np.linspace(0, 2 * np.pi, 64)
    edge = SPOT_M * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    assert place.is_free(PLACES_M[:, None] + edge).all()
    assert np.abs(PLACES_M).max() < SIDE_M / 2


def test_ways_prefer_cover(recorded: JointRecordings) -> None:
    place = ground()
    column, row = ((recorded.recordings.position_m + SIDE_M / 2) // 250.0).astype(int).T
    # On 300 episodes the mean is 0.50 on the way and 0.46 over all free ground.
    assert place.cover[row, column].mean() > place.cover[place.grid.is_free].mean() + 0.02


def test_moods_make_different_ways() -> None:
    start, goal = np.array([-13000.0, -1000.0]), 3
    ways = [way(start, goal, mood, GOALS_M[goal], np.zeros(2)) for mood in range(12)]
    middles = np.array([points[len(points) // 2] for points in ways])
    assert (distance(middles, middles) > 2000.0).any(axis=1).all()


def test_a_way_beside_another_ends_where_it_should() -> None:
    start, shift = np.array([-13000.0, -1000.0]), np.array([0.0, MAX_SHIFT_M])
    beside, straight = (way(start, 3, 0, GOALS_M[3], by) for by in (shift, 0 * shift))
    np.testing.assert_allclose(beside[[0, -1]], [start, GOALS_M[3]])
    apart = np.hypot(*(beside - straight).T)
    # The smoothing differs a little where one of them comes nearer to a mountain.
    assert apart.max() <= 1.5 * MAX_SHIFT_M and np.median(apart) == pytest.approx(MAX_SHIFT_M, rel=0.1)


@pytest.mark.parametrize("num_agents", [1, 3, 32])
def test_nobody_enters_a_mountain_or_leaves_the_map(num_agents: int) -> None:
    land = ground().terrain.land()
    joint = simulate_rendezvous_batch(RendezvousConfig(num_agents=num_agents), 5, np.arange(120 // num_agents))
    for track in tracks(joint):
        assert not blocks_segment(land, track[:, :-1], track[:, 1:]).any()
        assert np.abs(track).max() < SIDE_M / 2


def test_everybody_walks_at_one_speed_and_stays_where_it_arrived(recorded: JointRecordings) -> None:
    medians = []
    for track in tracks(recorded):
        length = strides(track)
        assert length.max() <= STRIDES_M[1] + 0.01
        for agent in length:
            walked = agent[agent > 1.0]
            # All steps are of one length along the way; a straight line across a bend is a little shorter.
            pace = np.median(walked)
            medians.append(pace)
            assert (walked < pace * 1.02).all() and (walked > 0.9 * pace).mean() > 0.93
    assert STRIDES_M[0] * 0.98 < min(medians) < 115.0 and 152.0 < max(medians) <= STRIDES_M[1]


def test_all_go_to_the_goal_and_the_episode_ends_with_the_last(recorded: JointRecordings) -> None:
    for track, goal in zip(tracks(recorded), recorded.goal_m, strict=True):
        assert goal.tolist() in GOALS_M.tolist()
        assert (np.hypot(*(track[:, -1] - goal).T) <= SPOT_M + 0.01).all()
        assert strides(track)[:, -1].max() > 0.0
        assert (np.hypot(*(track[:, 0] - goal).T) >= 5000.0 - 0.01).all()
        assert np.hypot(*(track[:, 0] - track[0, 0]).T).max() >= 3000.0 - 0.01


def test_half_of_the_episodes_meet_and_go_on_together(recorded: JointRecordings) -> None:
    # 300 draws of one half: the standard error is 0.029.
    assert abs(recorded.is_meeting.mean() - 0.5) < 0.1
    rows = zip(tracks(recorded), recorded.is_meeting, recorded.site_m, recorded.left_site_step, strict=True)
    for track, is_meeting, site, left in rows:
        if not is_meeting:
            assert left == -1
            continue
        away = np.hypot(*np.moveaxis(track - site, -1, 0))
        assert (away[:, left] <= SPOT_M + 0.01).all()
        is_waiting = (strides(track)[:, :left] < 0.01).all(axis=0)
        num_waiting = int(np.argmax(~is_waiting[::-1]))
        assert 2 <= num_waiting <= 10
        # They leave at once, all of them.
        assert (strides(track)[:, left] > 100.0).all()
    assert {tuple(site) for site in recorded.site_m} == {tuple(site) for site in SITES_M}


def test_truth_keeps_the_rule_of_meeting(recorded: JointRecordings) -> None:
    found = np.array([meets(recorded.track_m(episode), SITES_M) for episode in range(len(recorded))])
    np.testing.assert_array_equal(found, recorded.is_meeting)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_share_of_meetings_is_a_setting(share: float) -> None:
    joint = simulate_rendezvous_batch(RendezvousConfig(share_meeting=share), 1, np.arange(10))
    assert (joint.is_meeting == bool(share)).all()


def test_each_agent_is_seen_as_often_as_it_should_be(recorded: JointRecordings) -> None:
    count = np.rint(recorded.recordings.rates() * recorded.recordings.length)
    assert (count >= np.rint(0.1 * recorded.recordings.length)).all()
    assert (count <= np.rint(0.12 * recorded.recordings.length)).all()
    # The steps are uniform: their mean place in the episode is the middle (standard error 0.002 over 26 000 detections).
    step = np.concatenate([np.arange(length) / (length - 1) for length in recorded.recordings.length])
    assert abs(step[recorded.recordings.is_detected].mean() - 0.5) < 0.01


def test_neighbours_in_the_batch_and_repetition_change_nothing(recorded: JointRecordings) -> None:
    alone = simulate_rendezvous_batch(RendezvousConfig(), 0, np.array([17, 5]))
    chosen = recorded.select([17, 5])
    for name in ("position_m", "is_detected", "offset"):
        np.testing.assert_array_equal(getattr(alone.recordings, name), getattr(chosen.recordings, name))
    for name in ("is_meeting", "goal_m", "site_m", "left_site_step"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(chosen, name))
    other = simulate_rendezvous_batch(RendezvousConfig(), 1, np.array([17]))
    assert not np.array_equal(other.track_m(0)[:, 0], alone.track_m(0)[:, 0])


def test_an_episode_is_the_recording_with_everything_in_it(recorded: JointRecordings) -> None:
    for index in (int(np.argmax(recorded.is_meeting)), int(np.argmin(recorded.is_meeting))):
        episode = simulate_rendezvous(RendezvousConfig(), 0, index)
        np.testing.assert_allclose(episode.truth_m, recorded.track_m(index), atol=0.01)
        np.testing.assert_array_equal(episode.is_detected(), recorded.recordings.is_detected[_rows(recorded, index)])
        assert episode.agent_ids == ("agent_1", "agent_2", "agent_3") and (np.diff(episode.time_s) == STEP_S).all()
        seen = episode.detections
        np.testing.assert_array_equal(seen.position_m, episode.truth_m[seen.agent, seen.step])
        assert (np.diff(seen.step) >= 0).all()
        places = [recorded.goal_m[index]]
        if recorded.is_meeting[index]:
            places.insert(0, recorded.site_m[index])
            assert (episode.mode == episode.mode_names.index("waiting")).any(axis=1).all()
        np.testing.assert_array_equal(episode.goals_m, [places] * 3)
        assert (np.diff(episode.mode) >= 0).all() and (episode.mode[:, -1] == episode.mode_names.index("arrived")).all()


def _rows(joint: JointRecordings, index: int) -> np.ndarray:
    """Rows [A, T] of an episode."""
    first, end = joint.recordings.offset[[3 * index, 3 * index + 3]]
    return np.arange(first, end).reshape(3, -1)


def test_noise_and_clutter_are_in_the_logs_only() -> None:
    config = RendezvousConfig(detection_sigma_m=40.0, clutter_per_step=0.5, is_origin_known=False)
    exact = simulate_rendezvous(RendezvousConfig(), 2, 3)
    noisy = simulate_rendezvous(config, 2, 3)
    np.testing.assert_array_equal(noisy.truth_m, exact.truth_m)
    np.testing.assert_array_equal(noisy.is_detected(), exact.is_detected())
    is_clutter = noisy.detections.agent < 0
    count = exact.truth_m.shape[1]
    assert 0.5 * count - 4 * np.sqrt(0.5 * count) < is_clutter.sum() < 0.5 * count + 4 * np.sqrt(0.5 * count)
    error = noisy.detections.position_m[~is_clutter] - exact.detections.position_m
    assert 30.0 < error.std() < 50.0 and (noisy.detections.covariance_m2[:, 0, 0] == 1600.0).all()
    assert (np.diff(noisy.detections.step) >= 0).all()
    together = [simulate_rendezvous_batch(some, 2, np.array([3])).recordings for some in (config, RendezvousConfig())]
    np.testing.assert_array_equal(*(some.position_m for some in together))


def test_meets_by_hand() -> None:
    sites = np.array([[0.0, 0.0], [10000.0, 0.0]])
    far, near, other = [5000.0, 5000.0], [300.0, 300.0], [10000.0, 100.0]
    nobody = [np.nan, np.nan]

    def met(*steps: list[list[float]]) -> bool:
        return bool(meets(np.array(steps).swapaxes(0, 1), sites, 600.0))

    assert met([near, near], [far, far])
    assert met([other, other])
    assert not met([near, other])  # at two sites
    assert not met([near, far], [far, near])  # one after the other
    assert met([near, near, nobody])  # the third is not there
    assert not met([near, nobody, nobody])  # one alone meets nobody
    assert not met([nobody, nobody])
    assert not met([[599.0, 0.0], [601.0, 0.0]])
    batch = np.array([[[near], [near]], [[near], [far]]])
    assert meets(batch, sites).tolist() == [True, False]
    assert meets(batch[None], sites).shape == (1, 2)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(num_agents=0),
        dict(num_agents=33),
        dict(share_meeting=1.5),
        dict(detection_rate=(0.2, 0.1)),
        dict(detection_rate=(0.0, 0.1)),
        dict(detection_sigma_m=-1.0),
        dict(detection_sigma_m=float("nan")),
        dict(clutter_per_step=1.0),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must"):
        RendezvousConfig(**wrong)
