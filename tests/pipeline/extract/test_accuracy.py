"""The accuracy of detections that state none, by their likelihood; and statements that it contradicts."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, fix
from test_extract import run

from pipeline.accuracies import lines
from pipeline.extract.one_target import is_one_target

SECONDS = np.arange(240.0)
STRAIGHT = np.column_stack([5.0 * SECONDS, 0.0 * SECONDS])
CIRCLE = 200.0 * np.column_stack([np.cos(SECONDS / 20.0), np.sin(SECONDS / 20.0)])


def noise(sigma_m: float, num: int = 240, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, sigma_m, (num, 2))


def several(num_targets: int, apart_m: float, sigma_m: float) -> np.ndarray:
    """Each second one of several targets that go side by side, at random."""
    who = np.random.default_rng(8).integers(0, num_targets, 120)
    places = apart_m * np.array([[0, 0], [0, 1], [1, 0], [1, 1], [2, 0]])
    return STRAIGHT[:120] + places[who] + noise(sigma_m, 120)


@pytest.mark.parametrize("way", [STRAIGHT, CIRCLE, 0.0 * STRAIGHT])
@pytest.mark.parametrize("sigma_m", [2.0, 10.0])
def test_one_target_with_noise(way: np.ndarray, sigma_m: float) -> None:
    assert is_one_target(SECONDS, way + noise(sigma_m))


@pytest.mark.parametrize(
    ("num", "apart_m", "sigma_m"), [(2, 10.0, 2.0), (2, 50.0, 0.0), (2, 100.0, 2.0), (4, 30.0, 2.0), (5, 100.0, 2.0)]
)
def test_several_targets_are_not_one_noisy_one(num: int, apart_m: float, sigma_m: float) -> None:
    assert not is_one_target(SECONDS[:120], several(num, apart_m, sigma_m))


def test_two_targets_in_turn() -> None:
    assert not is_one_target(SECONDS, STRAIGHT + np.column_stack([0.0 * SECONDS, 30.0 * (SECONDS % 2)]))


@pytest.mark.parametrize("num", [0, 1, 5, 27])
def test_too_few_rows(num: int) -> None:
    assert not is_one_target(SECONDS[:num], (STRAIGHT + noise(2.0))[:num])


def accuracies(summary: dict) -> dict[str, float]:
    """What is taken, by source."""
    return {record["sources"][0]: record["sigma_m"] for record in summary["accuracy"] if record["is_taken"]}


def rows(position_m: np.ndarray, agent: str | None = "a", covariance_m2: float | None = None) -> list[Row]:
    more = {} if agent is None else {"agent_id": agent}
    more |= {} if covariance_m2 is None else {"covariance": [covariance_m2, 0.0, 0.0, covariance_m2]}
    return [detection(float(i), *place, **more) for i, place in enumerate(position_m.tolist())]


@pytest.mark.parametrize("agent", ["a", None])
@pytest.mark.parametrize("stated", [None, 0.0, -1.0, float("nan"), 1e308])
def test_unknown_accuracy_is_that_of_the_scatter(tmp_path: Path, agent: str | None, stated: float | None) -> None:
    found = run(tmp_path, rows(STRAIGHT + noise(2.0), agent, stated))
    sigmas_m = accuracies(found.summary)
    assert sigmas_m == {"/detections": pytest.approx(2.0, rel=0.2)} and found.summary["suspicions"] == []
    low_m, high_m = found.summary["accuracy"][0]["sigma_interval_m"]
    assert low_m < 2.0 < high_m
    assert found.detections["cov_xx_m2"].to_pylist() == pytest.approx([sigmas_m["/detections"] ** 2] * 240)
    assert lines(found.summary["accuracy"])[0].startswith("/detections: no accuracy is stated; a standard deviation of ")


@pytest.mark.parametrize(("num", "words"), [(240, "no noise of the detections can be told"), (10, "too few detections")])
def test_where_nothing_shows_noise_they_stay_exact(tmp_path: Path, num: int, words: str) -> None:
    found = run(tmp_path, rows(CIRCLE)[:num])
    assert accuracies(found.summary) == {} and found.detections["cov_xx_m2"].null_count == num
    assert words in lines(found.summary["accuracy"])[0]


@pytest.mark.parametrize(
    "told",
    [
        {"default_sigma_m": 7.0},
        {"detections": [{"topic": "/detections", "agent_path": "agent_id", "sigma_m": 7.0}]},
    ],
)
def test_what_the_user_states_counts(tmp_path: Path, told: dict[str, object]) -> None:
    found = run(tmp_path, rows(STRAIGHT + noise(2.0)), **told)
    assert set(found.detections["cov_xx_m2"].to_pylist()) == {49.0} and found.summary["accuracy"] == []


@pytest.mark.parametrize(
    ("way", "stated_m2", "taken"),
    [
        (lambda: STRAIGHT, 1e6, "taken as not stated"),  # a driver's "I do not know"
        (lambda: STRAIGHT + noise(5.0), 1e-4, r" m are taken"),  # as sure as it is wrong
    ],
)
def test_statements_that_cannot_be_meant(tmp_path: Path, way: Callable[[], np.ndarray], stated_m2: float, taken: str) -> None:
    found = run(tmp_path, rows(way(), "a", stated_m2))
    (suspicion,) = found.summary["suspicions"]
    assert suspicion["kind"] == "covariance" and suspicion["done"].endswith(taken)
    trusted = run(tmp_path, rows(way(), "a", stated_m2), trusted=["covariance"])
    assert trusted.summary["suspicions"] == [] and set(trusted.detections["cov_xx_m2"].to_pylist()) == {stated_m2}


def test_a_walk_over_the_cells_of_a_grid_once_a_minute_contradicts_nothing(tmp_path: Path) -> None:
    """Cells of 21 m; it sways by one or two of them, as any walker may in a minute."""
    sway = np.random.default_rng(4).integers(-2, 3, 240)
    walk = 21.0 * np.column_stack([7 * np.arange(240), sway])
    slow = [detection(60.0 * i, *place, agent_id="a", covariance=[1.0, 0.0, 0.0, 1.0]) for i, place in enumerate(walk.tolist())]
    assert run(tmp_path, slow).summary["suspicions"] == []


@pytest.mark.parametrize(("sigma_m", "stated_m"), [(2.0, 2.0), (2.0, 0.5), (0.0, 15.0), (0.05, 3.0), (30.0, 500.0)])
def test_statements_that_can_be_meant(tmp_path: Path, sigma_m: float, stated_m: float) -> None:
    """A receiver smooths: its positions scatter by centimetres and are off by metres."""
    found = run(tmp_path, rows(STRAIGHT + noise(sigma_m), "a", stated_m**2))
    assert found.summary["suspicions"] == [] and set(found.detections["cov_xx_m2"].to_pylist()) == {stated_m**2}


def test_a_covariance_that_its_type_disowns(tmp_path: Path) -> None:
    matrix = np.diag([100.0, 100.0, 400.0]).ravel().tolist()
    metres = (CIRCLE + noise(10.0)) / 111_000.0
    log = [
        fix(float(i), 48.1 + y, 11.6 + x / 0.668, position_covariance=matrix, position_covariance_type=0)
        for i, (x, y) in enumerate(metres.tolist())
    ]
    found = run(tmp_path, log)
    assert found.summary["disowned_covariance"] == 240
    assert accuracies(found.summary)["/contacts/A"] == pytest.approx(10.0, rel=0.2)
    told = run(tmp_path, log, detections=[{"topic": "/contacts/{agent}", "covariance": "position_covariance"}])
    assert set(told.detections["cov_xx_m2"].to_pylist()) == {100.0} and told.summary["disowned_covariance"] == 0


def test_one_agents_numbers_do_not_touch_anothers(tmp_path: Path) -> None:
    log = [
        detection(float(i), *place, topic=f"/contacts/{name}", covariance=[value, 0.0, 0.0, value])
        for i, place in enumerate((STRAIGHT + noise(2.0)).tolist())
        for name, value in (("a", 1e308), ("b", -1.0), ("c", float("nan")), ("d", 4.0))
    ]
    found = run(tmp_path, log)
    assert set(accuracies(found.summary)) == {"/contacts/a", "/contacts/b", "/contacts/c"}
    sound = [row for row in log if row.topic == "/contacts/d"]
    alone = run(tmp_path, sound).detections.drop(["sequence"])
    of_all = found.detections.drop(["sequence"]).filter([name == "d" for name in found.detections["agent_id"].to_pylist()])
    assert of_all.to_pydict() == alone.to_pydict()


def mixed(few_m2: float, many_m2: float, num_few: int = 5) -> list[Row]:
    """A target with noise of 5 m whose detections state one of two covariances."""
    found = rows(STRAIGHT + noise(5.0), "a", many_m2)
    found[7 : 7 * (num_few + 1) : 7] = rows(STRAIGHT + noise(5.0), "a", few_m2)[7 : 7 * (num_few + 1) : 7]
    return found


def test_a_few_absurdly_exact_detections_are_as_exact_as_the_others(tmp_path: Path) -> None:
    found = run(tmp_path, mixed(1e-12, 25.0))
    (suspicion,) = found.summary["suspicions"]
    assert suspicion["kind"] == "covariance" and suspicion["done"] == "taken as exact as the others"
    assert suspicion["seen"] == "5 of 240 detections state a standard deviation of 1e-06 m at most, the others 5 m"
    assert set(found.detections["cov_xx_m2"].to_pylist()) == {25.0}
    trusting = run(tmp_path, mixed(1e-12, 25.0), trusted=["covariance"])
    assert trusting.summary["suspicions"] == [] and trusting.detections["cov_xx_m2"].to_pylist().count(1e-12) == 5


def test_claims_of_centimetres_that_scatter_as_all_others_do(tmp_path: Path) -> None:
    (suspicion,) = run(tmp_path, mixed(1e-4, 25.0, 30)).summary["suspicions"]
    assert suspicion["seen"].startswith("30 of 240 detections state a standard deviation of 0.01 m at most, but scatter as the")
    assert set(run(tmp_path, mixed(1e-4, 25.0, 30)).detections["cov_xx_m2"].to_pylist()) == {25.0}


@pytest.mark.parametrize("way", [STRAIGHT, CIRCLE, 20.0 * np.column_stack([np.sin(SECONDS), np.cos(SECONDS)])])
@pytest.mark.parametrize("num_few", [12, 100])
def test_claims_of_centimetres_that_hold(tmp_path: Path, way: np.ndarray, num_few: int) -> None:
    """Also in one stretch, and of what turns sharply."""
    is_few = np.isin(np.arange(240), np.arange(50, 50 + num_few) if num_few > 50 else np.arange(0, 240, 20))
    places = way + noise(5.0) * ~is_few[:, None]
    log = [
        detection(float(i), *place, agent_id="a", covariance=[each, 0.0, 0.0, each])
        for i, (place, each) in enumerate(zip(places.tolist(), np.where(is_few, 1e-4, 25.0).tolist(), strict=True))
    ]
    assert run(tmp_path, log).summary["suspicions"] == []


@pytest.mark.parametrize(
    ("few_m2", "many_m2", "num_few"), [(1e-4, 25.0, 20), (0.01, 25.0, 5), (1e-8, 1e-8, 5), (1e-8, 1e-6, 5)]
)
def test_detections_that_are_really_more_exact_are_left_as_they_are(
    tmp_path: Path, few_m2: float, many_m2: float, num_few: int
) -> None:
    """A receiver that gets a fix now and then, and a room with cameras."""
    exact = [
        detection(row, *place, agent_id="a", covariance=[each, 0.0, 0.0, each])
        for row, place, each in zip(
            SECONDS.tolist(), STRAIGHT.tolist(), [few_m2 if i % 12 == 0 and i < 12 * num_few else many_m2 for i in range(240)],
            strict=True,
        )
    ]  # fmt: skip
    assert not [s for s in run(tmp_path, exact).summary["suspicions"] if "as exact as the others" in s["done"]]
