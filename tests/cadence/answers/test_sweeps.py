"""What looks that saw nothing make of stories, by hand."""

import numpy as np
import pytest

from cadence.answers.sweeps import NUM_TIMES, swept
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.silence import Looks, Silence
from cadence.stories import Stories

CURVE = DetectionCurve(np.array([0.0, 10.0]), np.array([0.8, 0.8]))


def stories() -> Stories:
    """One of two stories stays at 0, 0, the other at 100, 0 and leaves after 50 s."""
    position_m = np.zeros((2, 1, 3, 2))
    position_m[1, 0, :, 0] = 100.0
    position_m[1, 0, 2] = np.nan
    return Stories(np.array([0.0, 50.0, 100.0]), position_m, np.array([0.5, 0.5]), ("a",))


def looks(*time_s: float, x_m: float = 0.0, seen: tuple[str, ...] = ()) -> Silence:
    num = len(time_s)
    place_m = np.tile([x_m, 0.0], (num, 1))
    own = Looks(np.array(time_s), place_m, np.ones(num), np.zeros(num), CURVE, seen=(frozenset(seen),) * num)
    return Silence((own,))


def test_by_hand() -> None:
    found = swept(stories(), 0, [looks(10.0, 20.0)], (0.0, 100.0))
    assert found.success.value == pytest.approx(0.5 * (1 - 0.2**2)) and found.num_looks == 2
    assert found.success_by[[0, 2, -1]] == pytest.approx([0.0, 0.5 * 0.8, 0.48])
    # the story that was searched in vain is the only one that is anywhere at the end, as likely as it is left
    assert found.next_look is not None and found.next_look.place_m == (0.0, 0.0)
    assert found.next_look.success == pytest.approx(0.8 * 0.04 / 1.04)


def test_a_look_on_a_border_counts_once_and_looks_outside_the_time_do_not() -> None:
    border_s = 100.0 / NUM_TIMES * 3
    found = swept(stories(), 0, [looks(border_s)], (0.0, 100.0))
    assert found.success.value == pytest.approx(0.4)
    assert swept(stories(), 0, [looks(border_s)], (20.0, 100.0)).num_looks == 0


def test_looks_that_saw_it_did_not_search_in_vain() -> None:
    found = swept(stories(), 0, [looks(10.0, seen=("a",)), looks(20.0, x_m=100.0)], (0.0, 40.0))
    assert found.num_looks == 1 and found.success.value == pytest.approx(0.4)
    assert found.next_look is not None and found.next_look.place_m == (0.0, 0.0)


def test_an_agent_in_no_story_is_refused() -> None:
    gone = Stories(np.array([0.0, 1.0]), np.full((1, 1, 2, 2), np.nan), np.ones(1), ("a",))
    with pytest.raises(ValueError, match="in no story"):
        swept(gone, 0, [looks(0.5)], (0.0, 1.0))
