"""Names that cannot say who was seen, and those that can."""

import numpy as np
import pytest

from pipeline.extract.identity import without_false_names
from pipeline.extract.plausibility import Suspicions
from pipeline.extract.positions import Positions, Rows

NAN = float("nan")


def rows(*items: tuple[int, float, float, float, str | None], sigma_m: float = NAN) -> Positions:
    """(message, seconds, x, y, agent) a row."""
    built = Rows()
    for message, second, x, y, agent in items:
        time_ns = round(second * 1e9)
        built.integers.extend((time_ns, time_ns, message, message))
        built.floats.extend((x, y, NAN, NAN, sigma_m**2, 0.0 * sigma_m, sigma_m**2, NAN, NAN, NAN))
        built.agents.append(agent)
        built.sensors.append(None)
        built.frame_ids.append("map")
    return built.finish("/seen")


def judged(found: Positions, *believed: str) -> tuple[list[str | None], list[str]]:
    suspicions = Suspicions()
    return without_false_names(found, 0.001, believed, suspicions).agent.tolist(), suspicions.lines()


def test_a_name_of_two_places_in_one_message_is_nobody() -> None:
    shared = [(i, float(i), 2.0 * i, y, "T") for i in range(20) for y in (0.0, 50.0)]
    alone = [(i, float(i), 2.0 * i, 99.0, "B") for i in range(20)]
    names, lines = judged(rows(*shared, *alone))
    assert names == [None] * 40 + ["B"] * 20
    assert len(lines) == 1 and '20 of 20 messages have "T" at several places; 40 detections' in lines[0]
    assert judged(rows(*shared, *alone), "/seen") == (["T"] * 40 + ["B"] * 20, [])


def test_one_slip_of_a_tracker_costs_only_that_message() -> None:
    items = [(i, float(i), 2.0 * i, 0.0, "T") for i in range(40)]
    names, lines = judged(rows(*items, (7, 7.0, 14.0, 30.0, "T")))
    assert names == ["T"] * 7 + [None] + ["T"] * 32 + [None]
    assert '1 of 40 messages have "T" at several places; 2 detections' in lines[0]


@pytest.mark.parametrize(
    "items",
    [
        [(i, float(i), 2.0 * i, 0.0, name) for i in range(9) for name in "AB"],  # two names
        [(i, float(i), 2.0 * i, 0.0, "T") for i in range(9) for _ in "ab"],  # copies
        [(i, i + 0.1 * part, 2.0 * i + part, 0.0, "T") for i in range(9) for part in range(3)],  # a track's last three moments
        [(2 * i + part, float(i), 2.0 * i, 9.0 * part, "T") for i in range(9) for part in range(2)],  # two messages
        [(i, float(i), 2.0 * i, y, None) for i in range(9) for y in (0.0, 9.0)],  # no names at all
    ],
)  # fmt: skip
def test_names_that_may_well_be_meant_stay(items: list[tuple[int, float, float, float, str | None]]) -> None:
    assert judged(rows(*items)) == ([item[4] for item in items], [])


def test_views_that_agree_within_their_accuracy_are_of_one_agent() -> None:
    items = [(i, float(i), 2.0 * i, y, "T") for i in range(9) for y in (0.0, 5.0)]
    assert judged(rows(*items, sigma_m=0.8))[0] == [None] * 18  # 5 m are 4.4 standard deviations of their difference
    assert judged(rows(*items, sigma_m=1.0)) == (["T"] * 18, [])


def test_nothing_at_all_is_no_suspicion() -> None:
    assert judged(rows()[:0]) == ([], []) and np.size(rows((1, 0.0, 1.0, 1.0, "T")).agent) == 1
