import numpy as np

from cadence.worlds.detection import detect, detection_probability
from cadence.worlds.draws import Draws


def test_probability_is_one_within_the_range_and_falls_to_zero_at_three_times_it():
    distance = np.array([0.0, 9.9, 10.0, 15.0, 20.0, 29.0, 30.0, 100.0])
    want = [1.0, 1.0, 1.0, 0.75, 0.5, 0.05, 0.0, 0.0]
    np.testing.assert_allclose(detection_probability(distance, np.array(10.0)), want, atol=1e-12)


def test_nothing_is_seen_without_a_range():
    assert (detection_probability(np.array([0.0, 1.0]), np.zeros(2)) == 0.0).all()


def test_frequencies_follow_the_law():
    count, steps = 500, 40
    draws = Draws(0, np.arange(count))
    distance = np.array([5.0, 12.0, 20.0, 28.0, 31.0])
    sensors = np.stack([distance, np.zeros(5)], axis=-1)
    reach = np.full((count, 5), 10.0)
    hits = np.stack([detect(draws, 3, step, sensors, np.zeros((count, 2)), reach) for step in range(steps)])
    share = hits.mean(axis=(0, 1))
    np.testing.assert_allclose(share, detection_probability(distance, np.array(10.0)), atol=0.012)
    assert share[0] == 1.0 and share[4] == 0.0
    # Sensors draw on their own: both see as often as the product says.
    assert abs((hits[..., 1] & hits[..., 2]).mean() - share[1] * share[2]) < 0.012


def test_batch_neighbours_change_nothing():
    rng = np.random.default_rng(0)
    sensors, target, reach = rng.uniform(0, 50, (6, 7, 2)), rng.uniform(0, 50, (6, 2)), rng.uniform(5, 15, (6, 7))
    together = detect(Draws(1, np.arange(6)), 3, 17, sensors, target, reach)
    for row in range(6):
        alone = detect(Draws(1, [row]), 3, 17, sensors[[row]], target[[row]], reach[[row]])
        assert (alone[0] == together[row]).all()
    assert together.any() and not together.all()
