"""The trajectory library on small recordings whose answer is known."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from cadence.baselines.library import LibraryConfig, TrajectoryLibrary, _draw, _flattened, spaced_lags
from cadence.recordings import ForecastWindows, Recordings, choose_windows, cut_windows
from cadence.types import Estimator

STEP_M = 100.0
SHARP = dataclasses.replace(LibraryConfig(), sigma=1.0, sigma_per_lag=0.02, stride=1)

PLAIN = LibraryConfig(
    sigma=8.5, sigma_per_lag=0.0, lag_growth=1.0, age_sigma=math.inf, count_sigma=math.inf, elapsed_sigma=math.inf,
    goal_penalty=0.0, fade=0.0, min_episodes=0.0, is_systematic=False,
)  # fmt: skip
SHIFTED = dataclasses.replace(PLAIN, sigma_per_lag=0.28, goal_penalty=2.0, fade=100.0, is_systematic=True)


def recorded(paths: list[np.ndarray], rate: float = 0.3, goals: np.ndarray | None = None) -> Recordings:
    """Recordings of paths [T, 2] in metres."""
    rng = np.random.default_rng(0)
    place = np.concatenate(paths).astype(np.float32)
    return Recordings(
        60.0,
        np.concatenate([[0], np.cumsum([len(path) for path in paths])]),
        place,
        rng.random(len(place)) < rate,
        np.zeros((len(place), 0, 2), dtype=np.float32),
        np.full((len(paths), 2), np.nan, dtype=np.float32) if goals is None else goals.astype(np.float32),
    )


def forked(num: int, length: int = 200, fork: int = 60) -> list[np.ndarray]:
    """East along y = 0, from the fork on north (even) or south (odd)."""
    steps = np.arange(length)
    paths = []
    for i in range(num):
        side = (1.0 if i % 2 == 0 else -1.0) * np.maximum(steps - fork, 0)
        paths.append(STEP_M * np.stack([np.minimum(steps, fork), side], axis=1) + [0.0, 0.3 * i])
    return paths


def wander(num: int, seed: int = 1) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    paths = []
    for _ in range(num):
        heading = np.cumsum(0.1 * rng.standard_normal(int(rng.integers(80, 200))))
        paths.append(np.cumsum(STEP_M * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0))
    return paths


RECORDED = recorded(wander(12))
NOW = recorded(wander(4, seed=2))


def cut(recordings: Recordings, number: int, **options: bool) -> ForecastWindows:
    return cut_windows(recordings, *choose_windows(recordings, number, np.random.default_rng(3)), **options)


def ask(library: TrajectoryLibrary, windows: ForecastWindows, number: int = 8) -> torch.Tensor:
    return library.sample(windows.windows, number).position_m


def test_continues_along_the_branch_that_was_taken() -> None:
    library = TrajectoryLibrary.from_recordings(recorded(forked(20)), SHARP)
    now = recorded(forked(2), rate=1.0)
    windows = cut_windows(now, np.array([0, 1]), np.array([70, 70]))
    found = ask(library, windows)
    error = torch.linalg.vector_norm(found - windows.truth_m[:, None], dim=-1)
    assert float(error[..., 0].max()) < 1e-2
    assert float(error[..., 100].max()) < 4.0 * STEP_M
    before = ask(library, cut_windows(now, np.array([0]), np.array([40])), 16)[0, :, 0, 100, 1]
    assert 4 <= int((before > 0).sum()) <= 12


@pytest.mark.parametrize("config", [PLAIN, SHIFTED, LibraryConfig()])
@pytest.mark.parametrize("known_start", [True, False])
def test_the_call_is_that_of_every_estimator(config: LibraryConfig, known_start: bool) -> None:
    library = TrajectoryLibrary.from_recordings(RECORDED, config)
    estimator: Estimator = library
    assert estimator.fit(cut(NOW, 2).windows.detections) is library
    windows = cut(NOW, 20, known_start=known_start)
    found = library.sample(windows.windows, 6)
    assert tuple(found.position_m.shape) == (20, 6, 1, 120, 2)
    assert torch.isfinite(found.position_m[windows.windows.is_active[:, 0]]).all()
    assert torch.allclose(found.weight.sum(1), torch.ones(20, dtype=found.weight.dtype))
    again = ask(library, windows, 6)
    assert torch.equal(again.nan_to_num(), found.position_m.nan_to_num())
    alone = torch.cat([ask(library, windows[i : i + 1], 6) for i in range(20)])
    assert torch.equal(alone.nan_to_num(), again.nan_to_num())


def test_what_comes_after_the_origin_does_not_matter() -> None:
    library = TrajectoryLibrary.from_recordings(RECORDED)
    episode, step = np.array([0, 1, 2]), np.array([50, 30, 60])
    other = dataclasses.replace(NOW, position_m=NOW.position_m.copy(), is_detected=NOW.is_detected.copy())
    for e, t in zip(episode, step, strict=True):
        later = slice(NOW.offset[e] + t + 1, NOW.offset[e + 1])
        other.position_m[later] += 5000.0
        other.is_detected[later] ^= True
    assert torch.equal(ask(library, cut_windows(NOW, episode, step)), ask(library, cut_windows(other, episode, step)))


def test_episodes_that_would_have_ended_by_now_take_no_part() -> None:
    steps = np.arange(150)
    east = STEP_M * np.stack([steps, 0.0 * steps], axis=1)
    library = TrajectoryLibrary.from_recordings(recorded([east[:60]] * 30 + [east]), SHARP)
    now = recorded([east], rate=0.0)
    found = ask(library, cut_windows(now, np.array([0]), np.array([90])))
    assert float(found[0, :, 0, 0, 0].min()) > 75 * STEP_M


def test_goal_elapsed_time_and_silence_choose_between_equal_paths() -> None:
    paths = forked(40)
    goals = np.where(np.arange(40)[:, None] % 2 == 0, [0.0, 9e3], [0.0, -9e3])
    off = dict(age_sigma=np.inf, count_sigma=np.inf, elapsed_sigma=np.inf, goal_penalty=0.0, min_episodes=0.0)
    by_goal = TrajectoryLibrary.from_recordings(
        recorded(paths, goals=goals), dataclasses.replace(SHARP, **off | {"goal_penalty": 30.0})
    )
    now = recorded(forked(2), rate=1.0, goals=goals[:2])
    found = ask(by_goal, cut_windows(now, np.array([0, 1]), np.array([40, 40])), 16)[:, :, 0, 100, 1]
    assert bool((found[0] > 0).all()) and bool((found[1] < 0).all())
    # odd episodes wait for 50 steps before they set out: only the elapsed time tells them apart
    late = [path if i % 2 == 0 else np.concatenate([np.repeat(path[:1], 50, axis=0), path]) for i, path in enumerate(paths)]
    by_time = TrajectoryLibrary.from_recordings(
        recorded(late, rate=1.0), dataclasses.replace(SHARP, **off | {"elapsed_sigma": 5.0, "elapsed_growth": 0.0})
    )
    found = ask(by_time, cut_windows(now, np.array([0]), np.array([40])), 16)[:, :, 0, 100, 1]
    assert bool((found > 0).all())
    # even episodes are never seen, odd ones always
    rec = recorded(paths)
    rec.is_detected[:] = np.repeat(np.arange(40) % 2 == 1, rec.length)
    by_age = TrajectoryLibrary.from_recordings(rec, dataclasses.replace(SHARP, **off | {"age_sigma": 0.2}))
    silent = recorded(forked(1), rate=0.0)
    silent.is_detected[20] = True
    found = ask(by_age, cut_windows(silent, np.array([0]), np.array([45])), 16)[:, :, 0, 100, 1]
    assert bool((found > 0).all())


def test_the_unit_of_length_does_not_matter() -> None:
    windows = cut(NOW, 10)
    found = ask(TrajectoryLibrary.from_recordings(RECORDED), windows)
    doubled = [dataclasses.replace(rec, position_m=2.0 * rec.position_m) for rec in (RECORDED, NOW)]
    again = ask(TrajectoryLibrary.from_recordings(doubled[0]), cut(doubled[1], 10))
    torch.testing.assert_close(again, 2.0 * found, rtol=1e-5, atol=1e-2)


def test_cells_hold_every_state_within_reach() -> None:
    library = TrajectoryLibrary.from_recordings(RECORDED, dataclasses.replace(LibraryConfig(), stride=1))
    states, rng = library.states, np.random.default_rng(5)
    place = RECORDED.position_m[states.row].astype(float)
    assert np.array_equal(np.sort(states.row), np.arange(len(RECORDED.position_m)))
    for _ in range(30):
        at, reach = rng.uniform(place.min(0) - 2000, place.max(0) + 2000), rng.uniform(100, 4000)
        near = np.flatnonzero(np.linalg.norm(place - at, axis=1) <= reach)
        assert np.isin(near, states.around(at, reach)).all()


def test_weights_sum_to_one_and_are_shared_by_enough_episodes() -> None:
    rng = np.random.default_rng(0)
    log_weight, episode = 50.0 * rng.standard_normal(400), np.repeat(np.arange(20), 20)
    for wanted in (0.0, 3.0, 8.0):
        weight = _flattened(log_weight, episode, wanted)
        assert weight.sum() == pytest.approx(1.0) and (weight >= 0).all()
        assert 1.0 / np.square(np.bincount(episode, weight)).sum() >= wanted
    plain = np.exp(log_weight - log_weight.max())
    assert np.allclose(_flattened(log_weight, episode, 0.0), plain / plain.sum())


@pytest.mark.parametrize("is_systematic", [True, False])
def test_draws_follow_the_weights(is_systematic: bool) -> None:
    weight = np.array([0.0, 0.5, 0.2, 0.0, 0.3])
    drawn = np.concatenate([_draw(weight, 10, np.random.default_rng(i), is_systematic) for i in range(300)])
    assert np.allclose(np.bincount(drawn, minlength=5) / 3000, weight, atol=0.03)
    if is_systematic:
        assert np.bincount(_draw(weight, 10, np.random.default_rng(0), True), minlength=5).tolist() == [0, 5, 2, 0, 3]


def test_lags_grow() -> None:
    lag = np.arange(100)
    assert lag[spaced_lags(lag, 6, 1.6)].tolist() == [0, 2, 4, 7, 12, 20]
    assert lag[spaced_lags(lag, 3, 1.0)].tolist() == [0, 1, 2]
    assert spaced_lags(np.array([0, 1]), 8, 1.6).tolist() == [0]


def test_misuse_is_refused() -> None:
    library = TrajectoryLibrary.from_recordings(RECORDED)
    with pytest.raises(ValueError, match="where they are"):
        library.sample(cut(NOW, 2).windows.with_context(None), 3)
    with pytest.raises(ValueError, match="no episodes"):
        TrajectoryLibrary.from_recordings(RECORDED.select(slice(0, 0)))
    with pytest.raises(ValueError, match="positive"):
        LibraryConfig(sigma=0.0)
