import numpy as np
import pytest

from cadence.errors import ConfigError
from pipeline.retrospect.config import RetrospectConfig
from pipeline.retrospect.timing import Timing, plan_times

DAY_NS = 86_400 * 10**9
START_NS = 1_700_000_000 * 10**9


def times(*seconds: float) -> np.ndarray:
    return START_NS + np.array([round(second * 1e9) for second in seconds], dtype=np.int64)


def test_a_month_with_three_detections_has_a_sensible_grid():
    seen = START_NS + np.array([0, 11 * DAY_NS, 30 * DAY_NS])
    timing = plan_times([seen], RetrospectConfig(), DAY_NS // 2, 64)
    assert len(timing.time_ns) == 61 and not timing.remarks
    fine = plan_times([seen], RetrospectConfig(), 60 * 10**9, 64)  # a step that would take 43 200
    assert len(fine.time_ns) < 140 and not fine.remarks
    assert fine.time_ns[0] == seen[0] and fine.time_ns[-1] >= seen[-1]
    assert all(np.abs(fine.time_ns - at).min() <= 60 * 10**9 for at in seen)  # near detections steps are short
    assert np.diff(fine.time_ns).max() < 19 * DAY_NS / 60


def test_ten_minutes_at_100_hz_have_a_sensible_grid():
    seen = START_NS + 10_000_000 * np.arange(60_000)
    timing = plan_times([seen], RetrospectConfig(), 20_000_000, 64)
    assert 2000 < len(timing.time_ns) <= 4000
    assert "steps of 0.16 s, not the 0.02 s of the windows" in timing.remarks[0]
    assert (np.diff(timing.time_ns) == 160_000_000).all()


def test_many_agents_share_the_room_for_positions():
    seen = [START_NS + 10**9 * np.arange(0, 3000, 7) + agent for agent in range(50)]
    timing = plan_times(seen, RetrospectConfig(max_positions=6_000_000), 10**9, 64)
    assert len(timing.time_ns) <= 6_000_000 // (300 * 50)


def test_steps_are_those_of_windows_where_their_step_is():
    seen = times(0.0, 3.3, 10.0, 500.0, 501.0)
    timing = plan_times([seen], RetrospectConfig(gap_steps=50), 2 * 10**9, 64)
    assert ((timing.time_ns - START_NS) % (2 * 10**9) == 0).all()
    apart_s = np.diff(timing.time_ns) * 1e-9
    assert apart_s.max() == 10.0 and (apart_s[:6] == 2.0).all() and apart_s[-1] == 2.0


def test_before_and_after_are_there():
    timing = plan_times([times(0.0, 10.0)], RetrospectConfig(before_s=7.0, after_s=5.5), 2 * 10**9, 64)
    assert (timing.time_ns[[0, -1]] - START_NS).tolist() == [-8 * 10**9, 16 * 10**9]


def test_one_detection_has_two_steps():
    timing = plan_times([times(3.0)], RetrospectConfig(), 10**9, 64)
    assert (timing.time_ns - START_NS).tolist() == [3 * 10**9, 4 * 10**9]
    (block,) = timing.blocks
    assert (block.first, block.stop, block.step_ns) == (0, 2, 10**9)


def test_blocks_hold_even_steps_of_one_stretch():
    timing = plan_times([times(0.0, 30.0, 1000.0, 1005.0)], RetrospectConfig(gap_steps=20, block_steps=16), 10**9, 64)
    blocks = timing.blocks
    assert [block.first for block in blocks[1:]] == [block.stop for block in blocks[:-1]]
    assert np.concatenate([block.time_ns for block in blocks]).tolist() == timing.time_ns.tolist()
    assert all(block.first // 16 == (block.stop - 1) // 16 for block in blocks)
    timeline = timing.timeline(1.0)
    assert timeline.first.tolist() == list(range(0, len(timing.time_ns), 16))


def test_a_stated_step_holds_and_one_that_nobody_can_mean_is_refused():
    seen = times(0.0, 100.0)
    timing = plan_times([seen], RetrospectConfig(step_s=0.5, gap_steps=1000, max_steps=10), 10**9, 64)
    assert len(timing.time_ns) == 201 and (np.diff(timing.time_ns) == 500_000_000).all()
    with pytest.raises(ConfigError, match=r"takes \d+ steps"):
        plan_times([times(*np.arange(0.0, 1000.0, 0.1))], RetrospectConfig(step_s=1e-5), 10**9, 64)


@pytest.mark.parametrize("wrong", [{"num_hypotheses": 0}, {"before_s": -1.0}, {"step_s": 0.0}, {"gap_steps": 1}])
def test_settings_that_mean_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RetrospectConfig(**wrong)


def test_times_increase_strictly():
    timing = Timing(times(0.0, 1.0, 2.0), 10**9, 64)
    assert (np.diff(timing.timeline(1.0).time_s.numpy()) > 0).all()
