import numpy as np
import pyarrow as pa
import pytest

from cadence.errors import ConfigError
from pipeline.grids import GridConfig, absences, plan_grid, suggest_step_s
from schemas.tables import DETECTIONS

SECOND_NS = 1_000_000_000


def table(*time_s: np.ndarray) -> pa.Table:
    """Detections of one agent for each array of times."""
    rows = [
        dict.fromkeys(DETECTIONS.names) | {"time_ns": round(t * 1e9), "agent_id": f"T{agent}", "x_m": t, "y_m": 0.0}
        for agent, times in enumerate(time_s)
        for t in times
    ]
    return pa.Table.from_pylist(rows, schema=DETECTIONS)


def at(*starts: float, step: float = 1.0, count: int = 77) -> np.ndarray:
    """Passes of detections, each as long."""
    return np.concatenate([start + step * np.arange(count) for start in starts])


def test_a_dense_log_is_planned_by_what_can_be_answered() -> None:
    dense = table(np.arange(0.0, 1000.0, 0.05))
    grid = plan_grid(dense, GridConfig())
    assert 1000 < len(grid.origins_ns) <= 2000
    (remark,) = grid.remarks
    assert "would take 20833 windows; infer.grid.max_windows = 2000" in remark
    assert len(plan_grid(dense, GridConfig(max_windows=300)).origins_ns) <= 300
    stated = plan_grid(dense, GridConfig(step_s=0.05))
    assert len(stated.origins_ns) == 1250 and not stated.remarks, "a stated step is the user's"


def test_two_passes_are_followed_and_the_time_between_is_said_to_be_left_out() -> None:
    grid = plan_grid(table(at(0.0, 10_076.0)), GridConfig())
    assert grid.step_s == pytest.approx(0.06)
    seconds = grid.origins_ns / 1e9
    assert not ((seconds > 85.0) & (seconds < 10_070.0)).any()
    assert seconds[-1] >= 10_152.0
    (remark,) = grid.remarks
    assert remark == (
        "9,991 of the 10,152 s from the first detection to the last lie in no window, as nothing was detected for up to "
        "10,000 s; infer.grid.step_s = 600 spans that time"
    )
    spanned = plan_grid(table(at(0.0, 10_076.0)), GridConfig(step_s=600.0))
    assert not spanned.remarks


@pytest.mark.parametrize(
    ("times", "num"),
    [
        (at(0.0, 1e4), 1),
        (at(0.0, 1e4, 2e4, 3e4), 3),
        (at(*np.arange(0.0, 5e4, 1e4)), 0),  # visits that keep coming are the rhythm of the log
        (at(0.0, 100.0, step=1.0, count=10), 0),  # two bursts: the gap is what is asked for
        (at(0.0, 1e4, count=3), 0),  # hardly a pass
        (np.array([0.0, 1e6, 2.6e6]), 0),
        (np.zeros(1), 0),
    ],
)
def test_absences_lie_between_passes(times: np.ndarray, num: int) -> None:
    time_ns = np.round(times * 1e9).astype(np.int64)
    assert np.count_nonzero(absences(time_ns)) == num


def test_each_agent_has_its_own_absences() -> None:
    times = [np.round(at(0.0 + k, 1e4 + k) * 1e9).astype(np.int64) for k in range(12)]
    assert suggest_step_s(times) == pytest.approx(0.06)


def test_only_windows_that_see_something_are_drawn_and_the_last() -> None:
    config = GridConfig(step_s=1.0, history_steps=8, horizon_steps=4, stride_steps=4)
    grid = plan_grid(table(np.array([0.0, 3.0, 40.0])), config)
    assert (grid.origins_ns / SECOND_NS).tolist() == [4.0, 8.0, 40.0]
    assert grid.remarks[0].startswith("20 of the 40 s from the first detection to the last lie in no window")
    assert grid.remarks[0].endswith("a longer step spans that time")
    assert not plan_grid(table(np.array([0.0, 3.0, 19.0])), config).remarks, "all of that time lies in some window"
    blind = plan_grid(table(np.array([0.0])), GridConfig(step_s=1.0, history_steps=8, horizon_steps=16, stride_steps=9))
    assert (blind.origins_ns / SECOND_NS).tolist() == [9.0]


def test_every_origin_that_is_left_out_sees_nothing() -> None:
    rng = np.random.default_rng(4)
    config = GridConfig(step_s=1.0, history_steps=16, horizon_steps=8, stride_steps=5)
    for _ in range(20):
        times = np.unique(np.round(np.cumsum(rng.exponential(15.0, 30)), 3))
        grid = plan_grid(table(times), config)
        every = times[0] + 5.0 * np.arange(1, int(np.ceil((times[-1] - times[0]) / 5.0)) + 1)
        is_drawn = np.isin(np.round(every * 1e9).astype(np.int64), grid.origins_ns)
        sees = np.array([((times > origin - 16.0) & (times <= origin)).any() for origin in every])
        assert len(grid.origins_ns) == is_drawn.sum()
        assert (is_drawn == sees)[:-1].all() and is_drawn[-1]


def test_steps_that_no_future_covers_are_said() -> None:
    found = table(np.arange(0.0, 400.0, 5.0))
    (remark,) = plan_grid(found, GridConfig(step_s=1.0, stride_steps=40)).remarks
    assert (
        remark == "infer.grid.stride_steps = 40 is more than horizon_steps = 32: 8 of every 40 steps are in no window's future"
    )
    assert not plan_grid(found, GridConfig(step_s=1.0, stride_steps=32)).remarks


def test_what_nobody_can_have_meant_is_refused() -> None:
    endless = GridConfig(step_s=1e-6, history_steps=10**6, horizon_steps=1, stride_steps=1)
    with pytest.raises(ConfigError, match=r"2990000 windows with steps of 1e-06 s; choose a larger step_s or stride_steps"):
        plan_grid(table(np.arange(0.0, 3.0, 0.01)), endless)
    with pytest.raises(ValueError, match="max_windows must be at least 1"):
        GridConfig(max_windows=0)
