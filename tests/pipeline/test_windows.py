"""Tables to windows: grid, kept detections, what lies before and after the origin, truth on the grid, units."""

import math

import numpy as np
import pyarrow as pa
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cadence.errors import InputError
from pipeline.grids import GridConfig, plan_grid, suggest_step_s
from pipeline.tracks import UNKNOWN_AGENT
from pipeline.windows import build_windows, fit_tracks, later_detections, truth_on_grid, window_seeds

START_NS = 1_700_000_000_000_000_000
CONFIG = GridConfig(step_s=1.0, history_steps=8, horizon_steps=4, stride_steps=4)


def table(
    time_s: list[float],
    agent: list[str | None] | str | None = "fox",
    position_m: np.ndarray | None = None,
    sigma_m: list[float | None] | None = None,
    start_ns: int = START_NS,
) -> pa.Table:
    num = len(time_s)
    position = np.stack([np.arange(num), 10.0 * np.arange(num)], -1) if position_m is None else position_m
    names = agent if isinstance(agent, list) else [agent] * num
    square = [None if sigma_m is None or s is None else s**2 for s in (sigma_m or [None] * num)]
    return pa.table(
        {
            "time_ns": pa.array([start_ns + round(t * 1e9) for t in time_s], pa.int64()),
            "agent_id": pa.array(names, pa.string()),
            "x_m": pa.array(position[:, 0], pa.float64()),
            "y_m": pa.array(position[:, 1], pa.float64()),
            "cov_xx_m2": pa.array(square, pa.float64()),
            "cov_xy_m2": pa.array([None if s is None else 0.25 * s for s in square], pa.float64()),
            "cov_yy_m2": pa.array(square, pa.float64()),
        }
    )


# --- the grid


def test_origins_cover_the_mission() -> None:
    grid = plan_grid(table([0.0, 3.0, 10.0, 17.5]), CONFIG)
    assert grid.step_ns == 1_000_000_000 and grid.step_s == 1.0
    assert ((grid.origins_ns - START_NS) / 1e9).tolist() == [4.0, 8.0, 12.0, 16.0, 20.0]
    assert grid.time_s.tolist() == [float(t) for t in range(-7, 5)]
    assert float(grid.time_s[grid.origin_index]) == 0.0 and grid.num_steps == 12


def test_a_single_detection_has_one_window_that_holds_it() -> None:
    found = table([0.0])
    grid = plan_grid(found, CONFIG)
    windows = build_windows(found, grid, 0)
    assert len(grid.origins_ns) == 1
    assert windows.batch.detections.count.tolist() == [[1]]


def test_tables_and_settings_that_cannot_be_used() -> None:
    with pytest.raises(InputError, match="nothing was detected"):
        plan_grid(table([]), CONFIG)
    for wrong in ({"step_s": 0.0}, {"step_s": math.nan}, {"history_steps": 0}, {"stride_steps": 0}, {"horizon_steps": -1}):
        with pytest.raises(ValueError, match=r"must be|at least"):
            GridConfig(**wrong)


def test_suggested_step_is_a_sixteenth_of_the_gap_between_bursts() -> None:
    bursts = np.concatenate([start + np.arange(0.0, 2.0, 0.1) for start in np.arange(0.0, 400.0, 18.0)])
    step = suggest_step_s([np.round(bursts * 1e9).astype(np.int64)])
    assert step == 1.0  # 16 s gaps hold most of the time, though there are twenty times as many short ones
    absent = np.append(bursts, bursts[-1] + 350.0)
    assert suggest_step_s([np.round(absent * 1e9).astype(np.int64)]) == 1.0


@given(st.integers(-3, 6), st.floats(1.0, 9.99))
def test_suggested_step_is_a_plain_number_in_any_unit(exponent: int, mantissa: float) -> None:
    gap_s = mantissa * 10.0**exponent
    times = np.round(np.arange(20) * gap_s * 1e9).astype(np.int64)
    step = suggest_step_s([times])
    assert step == pytest.approx(gap_s / 16.0, rel=0.16)
    assert float(f"{step:.1e}") == pytest.approx(step, rel=1e-9)


def test_nothing_to_suggest_from() -> None:
    assert suggest_step_s([np.array([5])]) == 1.0
    assert suggest_step_s([np.array([5, 5]), np.array([7])]) == 1.0


# --- windows


def test_times_and_positions_are_relative() -> None:
    found = table([0.0, 1.0, 3.0], position_m=np.array([[1e6, 2e6], [1e6 + 2, 2e6], [1e6 + 4, 2e6 + 6]]))
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    d = windows.batch.detections
    assert d.time_s[0, 0].tolist() == [-4.0, -3.0, -1.0]
    assert windows.datum_m[0].tolist() == pytest.approx([1e6 + 2, 2e6 + 2])
    absolute = d.position_m[0, 0].numpy() + windows.datum_m[0]
    np.testing.assert_allclose(absolute, np.stack([found["x_m"], found["y_m"]], -1))
    assert windows.agent_ids == ("fox",)


def test_a_window_holds_its_history_and_nothing_after_the_origin() -> None:
    times = [0.0, 4.0, 4.0 + 1e-9, 9.0, 12.0, 20.0]
    found = table(times)
    grid = plan_grid(found, CONFIG)
    windows = build_windows(found, grid, 0)
    later = later_detections(found, grid, windows)
    history, horizon = 8.0, 4.0
    for index, origin in enumerate((grid.origins_ns - START_NS) / 1e9):
        mine, after = windows.batch.detections, later
        got = (mine.time_s[index, 0][mine.is_observed[index, 0]] + origin).tolist()
        assert got == pytest.approx([t for t in times if origin - history < t <= origin], abs=1e-12)
        got = (after.time_s[index, 0][after.is_observed[index, 0]] + origin).tolist()
        assert got == pytest.approx([t for t in times if origin < t <= origin + horizon], abs=1e-12)
        assert bool((after.time_s[index][after.is_observed[index]] > 0).all())


def test_agents_without_detections_join_behind_and_windows_of_them_alone_lie_near_whom_is_told() -> None:
    found = table([0.0, 4.0], position_m=np.array([[1000.0, 500.0], [1010.0, 500.0]]))
    windows = build_windows(found, plan_grid(table([0.0, 20.0, 40.0, 60.0]), CONFIG), 0)
    assert windows.with_unseen((), np.zeros(2)) is windows
    more = windows.with_unseen(("owl", "bat"), np.array([900.0, 400.0]))
    assert more.agent_ids == ("fox", "owl", "bat")
    assert not more.batch.is_active[:, 1:].any() and torch.equal(more.batch.is_active[:, :1], windows.batch.is_active)
    is_empty = ~windows.batch.is_active[:, 0].numpy()
    assert is_empty.any() and (more.datum_m[is_empty] == [900.0, 400.0]).all()
    assert (more.datum_m[~is_empty] == windows.datum_m[~is_empty]).all()
    assert torch.equal(more.batch.detections.position_m[:, :1], windows.batch.detections.position_m)
    assert (torch.linalg.det(more.batch.detections.covariance_m2[:, 1:]) == 1).all()


def test_first_and_last_of_a_step_are_kept() -> None:
    found = table([0.0, 0.2, 0.4, 0.9, 1.5, 2.0, 2.1])
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    kept = windows.batch.detections.time_s[0, 0][windows.batch.detections.is_observed[0, 0]] + 4.0
    assert kept.tolist() == pytest.approx([0.0, 0.9, 1.5, 2.0, 2.1])


def test_agents_are_apart_and_the_nameless_are_one() -> None:
    found = table([0.0, 1.0, 2.0, 3.0], agent=["wolf", None, "fox", None])
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    assert windows.agent_ids == ("fox", UNKNOWN_AGENT, "wolf")
    assert windows.batch.detections.count[0].tolist() == [1, 2, 1]


def test_order_of_rows_does_not_matter() -> None:
    found = table([0.0, 1.0, 2.0, 3.0, 9.0], agent=["wolf", "fox", "fox", "wolf", "fox"])
    grid = plan_grid(found, CONFIG)
    shuffled = found.take([3, 0, 4, 2, 1])
    one, two = build_windows(found, grid, 0), build_windows(shuffled, plan_grid(shuffled, CONFIG), 0)
    for name in ("time_s", "position_m", "covariance_m2", "is_observed"):
        assert torch.equal(getattr(one.batch.detections, name), getattr(two.batch.detections, name))


def test_covariances() -> None:
    found = table([0.0, 1.0], sigma_m=[2.0, None])
    d = build_windows(found, plan_grid(found, CONFIG), 0, default_sigma_m=3.0).batch.detections
    assert d.covariance_m2[0, 0].tolist() == [[[4.0, 1.0], [1.0, 4.0]], [[9.0, 0.0], [0.0, 9.0]]]


@settings(max_examples=20)
@given(st.integers(-(10**17), 10**17), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_shifting_time_and_place_changes_no_window(shift_ns: int, x: float, y: float) -> None:
    times, position = [0.0, 0.7, 3.0, 6.0, 6.1, 15.0], np.array([[0, 0], [1, 2], [3, 1], [4, 4], [5, 4], [9, 7.0]])
    found = table(times, position_m=position)
    moved = table(times, position_m=position + np.array([x, y]), start_ns=START_NS + shift_ns)
    one, two = (build_windows(t, plan_grid(t, CONFIG), 3) for t in (found, moved))
    assert torch.equal(one.batch.detections.time_s, two.batch.detections.time_s)
    assert torch.equal(one.batch.detections.is_observed, two.batch.detections.is_observed)
    torch.testing.assert_close(one.batch.detections.position_m, two.batch.detections.position_m, rtol=0, atol=1e-8)
    assert torch.equal(one.batch.seeds, two.batch.seeds)
    assert np.array_equal(two.origins_ns - one.origins_ns, np.full(len(one.origins_ns), shift_ns))


def test_seeds() -> None:
    assert torch.equal(window_seeds(7, 3), window_seeds(7, 9)[:3])
    assert len(set(window_seeds(7, 100).tolist())) == 100
    assert not torch.equal(window_seeds(7, 3), window_seeds(8, 3))
    assert bool((window_seeds(0, 50) >= 0).all())
    assert len(window_seeds(0, 0)) == 0


def test_stretches_to_fit_to() -> None:
    found = table([0.0, 1.0, 7.9, 8.0, 30.0, 2.0], agent=["fox"] * 5 + ["wolf"])
    tracks = fit_tracks(found, plan_grid(found, CONFIG))
    assert tracks.count[:, 0].tolist() == [3, 1, 1, 1]
    assert tracks.time_s[0, 0].tolist() == pytest.approx([0.0, 1.0, 7.9])
    assert not tracks.position_m[:, 0, 0].any()
    assert tracks.position_m[0, 0, 2].tolist() == [2.0, 20.0]


# --- truth


def test_truth_is_interpolated_where_it_is_known() -> None:
    found = table([0.0, 4.0])
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    truth = table([0.0, 2.0, 7.0], position_m=np.array([[0.0, 0.0], [4.0, -2.0], [14.0, -12.0]]))
    position, known = truth_on_grid(truth, windows, max_gap_s=2.5)
    # the window's origin is at 4 s, so that step i is at i - 3 s: known from 0 to 2 s, then at the sample of 7 s alone
    assert known[0, 0].nonzero()[:, 0].tolist() == [3, 4, 5, 10]
    absolute = position[0, 0].numpy() + windows.datum_m[0]
    np.testing.assert_allclose(absolute[3:6], [[0, 0], [2, -1], [4, -2]], atol=1e-12)
    assert torch.isfinite(position).all()
    _, patient = truth_on_grid(truth, windows, max_gap_s=5.0)
    assert patient[0, 0].tolist() == [False] * 3 + [True] * 8 + [False]


def test_agents_without_truth_are_unknown() -> None:
    found = table([0.0, 4.0], agent=["fox", "wolf"])
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    truth = table([0.0, 20.0], agent="wolf")
    _, known = truth_on_grid(truth, windows, max_gap_s=100.0)
    assert not known[0, 0].any() and bool(known[0, 1, 3:].all())


def test_one_sample_of_truth_is_known_only_there() -> None:
    found = table([0.0, 4.0])
    windows = build_windows(found, plan_grid(found, CONFIG), 0)
    _, known = truth_on_grid(table([2.0]), windows, max_gap_s=100.0)
    assert known[0, 0].nonzero()[:, 0].tolist() == [5]
