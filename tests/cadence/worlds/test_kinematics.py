"""Synthetic kinematics: units of steps and step lengths, determinism, variety."""

import dataclasses

import numpy as np
import pytest

from cadence.worlds.kinematics import SUBSTEPS, Scenario, draw_scenario, simulate_tracks


def scenarios(num: int) -> list[tuple[np.random.Generator, Scenario]]:
    return [(rng, draw_scenario(rng)) for rng in (np.random.default_rng([7, seed]) for seed in range(num))]


def test_speeds_are_about_one_step_length_a_step() -> None:
    speeds = []
    for rng, scenario in scenarios(24):
        tracks = simulate_tracks(scenario, 6, 48, rng)
        assert tracks.position.shape == (6, 48 * SUBSTEPS + 1, 2)
        assert np.isfinite(tracks.position).all()
        speeds.append(np.linalg.norm(np.diff(tracks.position, axis=1), axis=-1).mean() * SUBSTEPS)
    assert 0.6 < np.mean(speeds) < 1.3
    assert min(speeds) > 0.0 and max(speeds) < 6.0


def test_same_seed_same_tracks() -> None:
    one, two, other = (simulate_tracks(draw_scenario(rng), 4, 32, rng) for rng in (np.random.default_rng(s) for s in (3, 3, 4)))
    assert np.array_equal(one.position, two.position) and np.array_equal(one.is_detected, two.is_detected)
    assert not np.array_equal(one.position, other.position)


def test_detection_rates_vary() -> None:
    rates = [simulate_tracks(scenario, 6, 96, rng).is_detected.mean() * SUBSTEPS for rng, scenario in scenarios(24)]
    assert min(rates) < 0.15 and max(rates) > 0.3
    assert min(rates) > 0.0


def test_gaps_and_intervals_are_those_of_the_scenario() -> None:
    rng = np.random.default_rng(0)
    scenario = dataclasses.replace(draw_scenario(rng), gap=6.0, burst=1e-6, interval=0.5)
    tracks = simulate_tracks(scenario, 20, 400, rng)
    gaps = np.concatenate([np.diff(np.flatnonzero(row)) for row in tracks.is_detected]) / SUBSTEPS
    assert gaps.mean() == pytest.approx(6.0, rel=0.1)


def test_targets_in_an_arena_come_back_and_those_in_the_open_leave() -> None:
    rng = np.random.default_rng(1)
    base = dataclasses.replace(
        draw_scenario(rng), turn_rate=0.3, turn_noise=0.01, turn_memory=1.0, speed_spread=0.0, mode_share=np.eye(5)[0]
    )
    reach = {}
    for radius in (5.0, np.inf):
        tracks = simulate_tracks(dataclasses.replace(base, arena_radius=radius), 8, 120, rng)
        reach[radius] = np.linalg.norm(tracks.position, axis=-1).max()
    assert reach[5.0] < 30.0 < reach[np.inf]


def test_scenarios_are_sane() -> None:
    drawn = [scenario for _, scenario in scenarios(60)]
    for scenario in drawn:
        assert scenario.mode_share.sum() == pytest.approx(1.0)
        assert min(scenario.gap, scenario.burst, scenario.interval, scenario.sigma, scenario.turn_rate) > 0.0
    in_open = np.mean([np.isinf(scenario.arena_radius) for scenario in drawn])
    assert 0.4 < in_open < 0.8
