"""Names that cannot say who was seen, and those that can."""

import numpy as np
import pytest
from fixtures.detection_rows import rows

from pipeline.extract.names import Naming, without_false_names
from pipeline.extract.positions import Positions
from pipeline.suspicions import Suspicions

Item = tuple[int, float, float, float, str | None]


def judged(found: Positions, believed: str = "", topical: str = "") -> tuple[list[str | None], list[str]]:
    suspicions = Suspicions()
    naming = Naming({believed}, {topical})
    return without_false_names(found, 0.001, naming, suspicions).agent.tolist(), suspicions.lines()


def test_a_name_of_two_places_in_one_message_is_nobody() -> None:
    shared = [(i, float(i), 2.0 * i, y, "T") for i in range(20) for y in (0.0, 50.0)]
    alone = [(i, float(i), 2.0 * i, 99.0, "B") for i in range(20)]
    names, lines = judged(rows(*shared, *alone))
    assert names == [None] * 40 + ["B"] * 20
    assert len(lines) == 1 and '20 of 20 messages have "T" at several places; 40 detections' in lines[0]
    assert judged(rows(*shared, *alone), topical="/seen") == (names, lines)
    assert judged(rows(*shared, *alone), believed="/seen") == (["T"] * 40 + ["B"] * 20, [])


LABELS = ["car", "CAR", "vehicle.car", "human.pedestrian.adult", "TYPE_PEDESTRIAN", "label/boat", "car 0.87", "person: 93%"]


@pytest.mark.parametrize("label", LABELS)
def test_a_label_is_nobody(label: str) -> None:
    names, lines = judged(rows(*[(i, float(i), 2.0 * i, 0.0, label) for i in range(20)]))
    assert names == [None] * 20 and f'"{label}" is what was seen, not who' in lines[0]


@pytest.mark.parametrize("name", ["car 3", "car3.14", "red.car", "car_7", "type", "adult", "boat-anna"])
def test_a_name_with_a_kind_in_it_stays(name: str) -> None:
    assert judged(rows(*[(i, float(i), 2.0 * i, 0.0, name) for i in range(20)])) == ([name] * 20, [])


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
        [(i, float(i), 2.0 * i, 0.0, "0") for i in range(20)],  # a tracker's first number
        [(i, float(i), 2.0 * i, 0.0, "Seahorse") for i in range(20)],
        [(i, float(i), 5e3 * (i * 7 % 20), 0.0, f"{235000000 + i}") for i in range(20)],  # ships that are heard once each
        [(i, float(i), 2.0 * (i % 10), 0.0, f"{i // 2}") for i in range(40)],  # short tracks
        [(i // 20, float(i // 20), 9.0 * i, 0.0, f"{i % 20}") for i in range(60)],
    ],
)  # fmt: skip
def test_names_that_may_well_be_meant_stay(items: list[Item]) -> None:
    assert judged(rows(*items)) == ([item[4] for item in items], [])


def test_views_that_agree_within_their_accuracy_are_of_one_agent() -> None:
    items = [(i, float(i), 2.0 * i, y, "T") for i in range(9) for y in (0.0, 5.0)]
    assert judged(rows(*items, sigma_m=0.8))[0] == [None] * 18  # 5 m are 4.4 standard deviations of their difference
    assert judged(rows(*items, sigma_m=1.0)) == (["T"] * 18, [])


@pytest.mark.parametrize(
    "name", ["0" * 32, "00000000-0000-0000-0000-000000000000", "0x00000000", "ffffffff", "4294967295", "2147483647"]
)
def test_what_stands_where_nothing_was_filled_in_is_no_name(name: str) -> None:
    items: list[Item] = [(i, float(i), 2.0 * i, 0.0, name if i % 2 else "A7") for i in range(12)]
    names, lines = judged(rows(*items))
    assert names == ["A7", None] * 6 and f'"{name}" is what stands where nothing was filled in; 6 detections' in lines[0]


def test_a_kind_is_no_name_unless_the_topic_says_it() -> None:
    items: list[Item] = [(i, float(i), 2.0 * i, 0.0, "car" if i % 2 else "Person") for i in range(12)]
    names, lines = judged(rows(*items))
    assert names == [None] * 12 and '"Person", "car" are what was seen, not who' in lines[0]
    assert judged(rows(*items), topical="/seen") == (["Person", "car"] * 6, [])


def test_names_that_are_new_in_each_message_are_none() -> None:
    one: list[Item] = [(i, float(i), 2.0 * i, 0.0, f"{i:04x}") for i in range(30)]
    three: list[Item] = [(i, i / 10, 2.0 * i, 40.0 * k, f"{3 * i + k}") for i in range(30) for k in range(3)]
    for items in (one, three):
        names, lines = judged(rows(*items))
        assert set(names) == {None} and f"{len(items)} names for {len(items)} detections: they are new in each" in lines[0]
    kept = [*one[:-12], *((i, float(i), 2.0 * i, 0.0, "A") for i in range(18, 30))]
    assert judged(rows(*kept))[1] != []  # a tracker that holds one of nineteen still names nobody


def test_nothing_at_all_is_no_suspicion() -> None:
    assert judged(rows()[:0]) == ([], []) and np.size(rows((1, 0.0, 1.0, 1.0, "T")).agent) == 1


def test_kinds_are_names_where_the_user_says_so_and_each_is_one_target() -> None:
    alone = [(i, float(i), 2.0 * i, y, name) for i in range(20) for y, name in ((0.0, "boat"), (90.0, "car"))]
    naming = Naming(set(), set(), stated={"/seen"})
    suspicions = Suspicions()
    assert without_false_names(rows(*alone), 0.001, naming, suspicions).agent.tolist() == ["boat", "car"] * 20
    assert not suspicions and judged(rows(*alone))[0] == [None] * 40
    shared = [(i, float(i), 2.0 * i, y, "boat") for i in range(20) for y in (0.0, 90.0)]
    assert without_false_names(rows(*shared), 0.001, naming, suspicions).agent.tolist() == [None] * 40


def scene(place_of: object, names: int = 6, num: int = 40) -> list[Item]:
    return [(i, i / 2, *map(float, place_of(i, k)), str(k)) for i in range(num) for k in range(names)]  # type: ignore[operator]


def test_names_that_change_places_are_nobody() -> None:
    rng = np.random.default_rng(0)
    order = [rng.permutation(6) for _ in range(40)]
    names, (line,) = judged(rows(*scene(lambda i, k: (5.0 * i, 20.0 * order[i][k]))))
    assert set(names) == {None} and "names change places from message to message" in line


@pytest.mark.parametrize("noise_m", [0.0, 2.0, 15.0])
def test_a_column_of_cars_keeps_its_names(noise_m: float) -> None:
    """Each comes to where the one before it was."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, max(noise_m, 1e-9), (40, 6, 2))
    found = rows(*scene(lambda i, k: (20.0 * (i - k), 0.0) + noise[i, k]))
    assert judged(found) == (found.agent.tolist(), [])
