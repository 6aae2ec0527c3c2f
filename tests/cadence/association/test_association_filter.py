"""The filter against what can be computed without it: all hypotheses of a short stream, and the bank's Kalman filter."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from cadence.association.history import Ending, Step, drawn_associations, grouped, recently, step_of
from cadence.association.motion import Modes, motion
from cadence.association.particles import Stream, continuations, follow
from cadence.association.presence import Habits, left_by, log_hazards, log_silence, log_silence_between
from cadence.association.tracks import Detection, Tracks, log_densities, updated
from cadence.association.types import CLUTTER
from cadence.bank.components import ornstein_uhlenbeck, transition

ONE = Modes(np.array([40.0]), np.array([2.0]), np.ones(1), 0.0)
TWO = Modes(np.array([20.0, 300.0]), np.array([0.5, 3.0]), np.array([0.4, 0.6]), 0.2)


def habits(num_agents=2, leave_hz=0.0, modes=TWO, temper=1.0):
    return Habits(modes, 0.02, 10.0, 1.0, leave_hz, 0.01, 0.001, 1e6, temper, 0.0, num_agents, 9, None)


def stream(num, seed=0):
    rng = np.random.default_rng(seed)
    covariance = np.broadcast_to(25.0 * np.eye(2), (num, 2, 2)).copy()
    return Stream(np.append(0.0, np.cumsum(rng.uniform(5.0, 40.0, num - 1))), rng.normal(0.0, 60.0, (num, 2)), covariance)


def forced(label, seen, about):
    """Log density of one labelling, agents numbered as they are met."""
    tracks, total, before = Tracks.none(len(about.modes)), 0.0, seen.time_s[0]
    for agent, time_s, place, covariance in zip(label, seen.time_s, seen.position_m, seen.covariance_m2, strict=True):
        detection = Detection(time_s, place, covariance)
        column = -1 if agent == CLUTTER else -2 if agent == tracks.num_agents[0] else agent
        total += continuations(tracks, about, detection, before)[0, column]
        tracks, before = updated(tracks, about.modes, detection, np.array([agent])), time_s
    return total


def labellings(num, most):
    for label in itertools.product(range(-1, most), repeat=num):
        met = 0
        for agent in label:
            if agent > met:
                break
            met = max(met, agent + 1)
        else:
            yield label


def labels(particles):
    """One hypothesis of each particle: the only one where it remembers all detections."""
    return particles.associations(np.arange(len(particles.weight)), np.random.default_rng(0))


@pytest.mark.parametrize(("num_agents", "leave_hz"), [(2, 0.0), (None, 0.002)])
def test_enough_particles_are_the_exact_law_of_all_labellings(num_agents, leave_hz):
    seen, about = stream(5), habits(num_agents, leave_hz)
    every = list(labellings(5, num_agents or 5))
    exact = np.array([forced(label, seen, about) for label in every])
    *_, last = follow(seen, about, 10_000, seed=0, num_recent=5)
    law = dict(zip(every, np.exp(exact - np.logaddexp.reduce(exact)), strict=True))
    np.testing.assert_allclose(last.log_evidence, np.logaddexp.reduce(exact), atol=1e-4)
    for label, weight in zip(labels(last), last.weight, strict=True):
        np.testing.assert_allclose(weight, law[tuple(label.tolist())], atol=1e-4)


def test_few_particles_are_right_on_average():
    seen, about = stream(6), habits()
    *_, exact = follow(seen, about, 10_000, seed=0, num_recent=6)
    wanted = exact.weight @ (labels(exact) == 0)
    found = []
    for seed in range(120):
        *_, last = follow(seen, about, 6, seed, num_recent=6)
        assert len(last.weight) <= 6
        found.append(np.exp(last.log_evidence - exact.log_evidence) * (last.weight @ (labels(last) == 0)))
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (np.abs(np.mean(found, axis=0) - wanted) < 4.5 * error + 1e-3).all()


def test_ways_of_like_future_are_one_and_keep_their_pasts():
    """Two agents wait at one place and part: fewer than half of the particles say as much of who is who."""
    time = 30.0 * np.arange(38)
    way = np.where(time < 480.0, time - 480.0, np.where(time < 660.0, 0.0, time - 660.0)) * 4.0
    place = np.stack([way, np.where(np.arange(38) % 2 == 0, 1.0, -1.0) * np.abs(way) * 0.5], axis=1)
    seen = Stream(time, place + np.random.default_rng(2).normal(0.0, 1.0, place.shape), np.ones((38, 1, 1)) * np.eye(2))
    modes = Modes(np.array([20.0, 700.0, 4000.0]), np.array([1.0, 3.0, 3.0]), np.ones(3) / 3, 0.2)
    about, share, num = dataclasses.replace(habits(modes=modes), area_m2=3e6), [], []
    for num_recent in (38, 6):
        *_, last = follow(seen, about, 3000, seed=0, num_recent=num_recent)
        particle = np.random.default_rng(1).choice(len(last.weight), 4000, p=last.weight)
        label = last.associations(particle, np.random.default_rng(2))
        share.append((label[:, -8] == label[:, 0]).mean())
        num.append(len(last.weight))
    assert 0.05 < share[0] < 0.95
    assert abs(share[0] - share[1]) < 0.04
    assert num[1] < 0.5 * num[0]


def test_pasts_are_drawn_by_their_shares_under_the_childs_names():
    """Two detections; the two hypotheses after the second differ in who is who and become one particle of weights 3 to 1."""
    parts = [np.array([0, 1]), np.array([3.0, 1.0]), np.array([0, 1])]
    recent = recently(np.array([[[0], [1]], [[1], [0]]]), np.array([0, 1]), 2)  # both: detection 2 where 0 was, 1 elsewhere
    group, order = grouped(recent)
    assert group.tolist() == [0, 0]
    step, heaviest = step_of(parts[1], parts[0], parts[2], group, order, np.array([0]))
    assert heaviest.tolist() == [0]
    first = [
        step_of(np.ones(1), np.array([0]), np.array([0]), np.array([0]), np.array([[0, 1]]), np.array([0]))[0],
        Step(np.array([0, 1]), np.array([0, 0]), np.ones(2), np.array([1, 1]), np.array([0, 1]), np.array([[0, 1], [1, 0]])),
    ]
    label = drawn_associations([*first, step], [Ending(3, np.zeros(4000, dtype=np.int64), np.random.default_rng(0))])[0]
    np.testing.assert_array_equal(label[:, 2], 0)
    different, count = np.unique(label, axis=0, return_counts=True)
    assert len(different) == 2
    np.testing.assert_allclose(np.sort(count) / 4000, [0.25, 0.75], atol=0.03)


def test_what_an_ending_is_given_does_not_depend_on_the_others():
    """Two detections a scan of two agents that stay close: many pasts. Together, alone, and in parts: the same labels."""
    *_, last = follow(stream(90, seed=4), habits(), 20, seed=0)
    particle = np.arange(len(last.weight))

    def ending(num_steps, seed):
        return Ending(num_steps, particle if num_steps == 90 else np.zeros(7, dtype=np.int64), np.random.default_rng(seed))

    numbers = [(40, 1), (90, 2), (65, 3)]
    together = drawn_associations(last.steps, [ending(*number) for number in numbers])
    for number, label in zip(numbers, together, strict=True):
        (alone,) = drawn_associations(last.steps, [ending(*number)])
        np.testing.assert_array_equal(label, alone)
        assert label.shape[1] == number[0]
    assert len(np.unique(together[1], axis=0)) > 5


def test_particles_share_the_tracks_on_which_they_agree():
    """Of the tracks of 30 particles, most are common: there are far fewer than particles times agents."""
    *_, last = follow(stream(60, seed=4), habits(), 30, seed=0)
    assert last.tracks.row.shape == (30, 2) and last.tracks.row.min() >= 1
    assert len(last.tracks.last_s) - 1 == len(np.unique(last.tracks.row)) < 40


def test_nobody_exceeds_the_speed_limit():
    tracks = updated(Tracks.none(2), TWO, Detection(0.0, np.zeros(2), np.eye(2)), np.array([0]))
    far = Detection(60.0, np.array([0.0, 400.0]), np.eye(2))
    for limit, is_possible in ((None, True), (7.0, True), (6.0, False)):
        log_density = continuations(tracks, dataclasses.replace(habits(), max_speed_mps=limit), far, 0.0)[0]
        assert np.isfinite(log_density).tolist() == [is_possible, True, True]


def test_motion_is_the_banks_ornstein_uhlenbeck():
    duration = np.array([1e-3, 0.5, 3.0, 4.1, 80.0, 4000.0])
    way = motion(ONE, duration)
    matrix, noise = transition(
        ornstein_uhlenbeck([40.0], [2.0], [0.0])[torch.zeros(6, dtype=torch.int64)], torch.tensor(duration)
    )
    for found, wanted in (
        (way.gain, matrix[:, 0, 2]),
        (way.decay, matrix[:, 2, 2]),
        (way.noise_pp, noise[:, 0, 0]),
        (way.noise_pv, noise[:, 0, 2]),
        (way.noise_vv, noise[:, 2, 2]),
    ):
        np.testing.assert_allclose(found[:, 0], wanted.numpy(), rtol=1e-8, atol=1e-12)


def test_densities_of_one_track_are_those_of_a_joint_gaussian():
    """Three detections of one agent in one mode: the filter's product is the density of the joint Gaussian of all positions."""
    seen = stream(3)
    tracks, total = Tracks.none(1), 0.0
    for index, time_s in enumerate(seen.time_s):
        detection = Detection(time_s, seen.position_m[index], seen.covariance_m2[index])
        if index:
            total += log_densities(tracks, ONE, detection)[1]
        tracks = updated(tracks, ONE, detection, np.array([0]))
    gap = np.diff(seen.time_s)
    first, second = motion(ONE, gap[0]), motion(ONE, gap[1])
    way = second.gain * first.decay + first.gain
    cross = first.gain * 4.0 * way + first.noise_pp + second.gain * first.noise_pv
    last = (
        way**2 * 4.0 + first.noise_pp + 2.0 * second.gain * first.noise_pv + second.gain**2 * first.noise_vv + second.noise_pp
    )
    joint = np.array([[first.gain**2 * 4.0 + first.noise_pp, cross], [cross, last]])[..., 0] + 25.0 + 25.0 * np.eye(2)
    offset = seen.position_m[1:] - seen.position_m[0]
    distance = np.einsum("is,ij,js->", offset, np.linalg.inv(joint), offset)
    wanted = -0.5 * distance - np.log(np.linalg.det(joint)) - 2.0 * np.log(2.0 * np.pi)
    np.testing.assert_allclose(total, wanted, rtol=1e-9)


def test_mixing_keeps_mean_and_covariance_of_the_whole():
    seen = stream(4)
    results = []
    for switch in (0.0, 0.7):
        modes = Modes(TWO.relaxation_s, TWO.speed_mps, TWO.share, switch)
        tracks = Tracks.none(2)
        for index, time_s in enumerate(seen.time_s[:2]):
            detection = Detection(time_s, seen.position_m[index], seen.covariance_m2[index])
            tracks = updated(tracks, modes, detection, np.array([0]))
        share, mean = np.exp(tracks.log_share[1]), tracks.mean[1]
        overall = share @ mean
        apart = mean - overall
        total = np.einsum("c,cij->ij", share, tracks.covariance[1] + apart[:, :, None] * apart[:, None])
        results.append((overall, total))
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-9)
    np.testing.assert_allclose(results[0][1], results[1][1], rtol=1e-9, atol=1e-9)


def test_silence_and_the_next_detection_are_one_law():
    """What is not silent by a moment was detected or lies ahead: minus the silence's slope is density plus nothing else."""
    tracks = updated(Tracks.none(2), TWO, Detection(0.0, np.zeros(2), np.eye(2)), np.array([0]))
    moments = np.linspace(0.0, 3000.0, 300_001)
    stays = habits()
    density = np.exp([log_silence(tracks, stays, moment)[1][1] for moment in moments[::100]])
    silence = np.exp([log_silence(tracks, stays, moment)[0][1] for moment in moments[::100]])
    np.testing.assert_allclose(silence, 1.0 - np.concatenate([[0], np.cumsum(0.5 * (density[1:] + density[:-1]))]), atol=2e-4)
    leaves = np.exp(log_silence(tracks, habits(leave_hz=0.01), 1e7)[0][1])
    assert 0.0 < leaves < 1.0
    assert np.exp(log_silence(tracks, stays, 1e7)[0][1]) < 1e-5


def test_new_agents_are_met_as_often_as_their_rate_says():
    """Nobody is met yet: the log probability of silence is minus the integral of the rate of new agents."""
    about, nobody = habits(num_agents=None, leave_hz=2e-4), Tracks.none(2)
    moments = np.linspace(0.0, 2000.0, 4001)
    rate = np.exp([log_hazards(nobody, about, moment)[0, -2] for moment in moments])
    silence = log_silence_between(nobody, about, 0.0, 2000.0)[0]
    np.testing.assert_allclose(-silence, np.trapezoid(rate, moments), rtol=1e-4)
    # those there at first are met, then only who comes: as many as leave
    np.testing.assert_allclose(rate[[0, -1]], about.num_present * np.array([0.0202, 2e-4]), rtol=1e-3)


def test_who_is_silent_for_long_has_left_rather_than_stayed():
    seen, about = updated(Tracks.none(2), TWO, Detection(0.0, np.zeros(2), np.eye(2)), np.array([0])), habits(leave_hz=0.001)
    moments = np.linspace(0.0, 1500.0, 30_001)
    # by Bayes: the share of leaving times that lie before the end, among all ways to be silent
    staying = np.exp([log_silence(seen, habits(), moment)[0][1] for moment in moments])
    leaving = np.trapezoid(about.leave_hz * np.exp(-about.leave_hz * moments) * staying, moments)
    stayed = np.exp(-about.leave_hz * moments[-1]) * staying[-1]
    assert left_by(seen, about, 0.0)[0, 0] == 0.0
    np.testing.assert_allclose(left_by(seen, about, 1500.0)[0, 0], leaving / (leaving + stayed), atol=0.02)


def test_an_agents_rate_is_relearned_where_rates_change():
    """Ten detections every 10 s, then twenty every 100 s: with a short memory the last ones are no surprise any more."""
    for memory, fewest, most in ((1.0, 0.012, 0.02), (0.75, 0.0095, 0.0115)):
        tracks = Tracks.none(2)
        for time_s in np.concatenate([10.0 * np.arange(10), 90.0 + 100.0 * np.arange(1, 21)]):
            tracks = updated(tracks, TWO, Detection(time_s, np.zeros(2), np.eye(2)), np.array([0]), memory)
        about = dataclasses.replace(habits(), rate_weight=1.0)
        rate_hz = np.exp(log_silence(tracks, about, float(tracks.last_s[1]))[1][1])
        assert fewest < rate_hz < most
