"""Measures of forecasts: cases whose answers are known, against the plain formulas, and sums that add up."""

import dataclasses

import numpy as np
import pytest
import torch

from cadence import metrics
from cadence.constraints.obstacles import Obstacles
from cadence.types import HypothesisSet
from pipeline.forecast.scores import HORIZONS, MEASURES, EpisodeScores, score_forecasts, step_quantiles
from pipeline.forecast.tables import (
    STEP_LEVELS,
    ForecastFacts,
    as_csv,
    as_markdown,
    comparison,
    mean_interval,
    motion_rows,
    number,
    pool,
)

FACTS = ForecastFacts(3, 0, (), 6, 4, 0.2, 60.0, 1000.0, True, False, 0)
NONE = Obstacles.none()


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def hypotheses(position: torch.Tensor, weight: torch.Tensor | None = None) -> HypothesisSet:
    b, k = position.shape[:2]
    weight = torch.full((b, k), 1.0 / k, dtype=torch.float64) if weight is None else weight
    return HypothesisSet(position, weight, tuple(("ok",) for _ in range(b)))


def scored(position: torch.Tensor, truth: torch.Tensor, episode: list[int] | None = None, **more) -> EpisodeScores:
    episodes = torch.tensor(episode or [0] * len(truth))
    datum = more.pop("datum", torch.zeros(len(truth), 2, dtype=torch.float64))
    obstacles = more.pop("obstacles", NONE)
    return score_forecasts(hypotheses(position, more.pop("weight", None)), truth, episodes, datum, obstacles, **more)


def test_a_perfect_estimator_scores_zero() -> None:
    truth = randn(6, 1, 120, 2).cumsum(dim=2)
    found = scored(truth[:, None].expand(-1, 5, -1, -1, -1), truth, [0, 0, 1, 1, 2, 2])
    for measure in MEASURES[:7]:
        assert np.allclose(found.mean(measure), 0.0, atol=1e-12), measure
    assert found.count.tolist() == [2, 2, 2]


def test_a_shifted_estimator_scores_its_shift() -> None:
    truth = randn(6, 1, 120, 2).cumsum(dim=2)
    position = (truth + torch.tensor([30.0, 40.0]))[:, None].expand(-1, 5, -1, -1, -1)
    found = scored(position, truth)
    for measure in ("displacement_error", "paper_error", "ade", "min_ade_at", "min_ade", "mean_error", "energy_score"):
        assert np.allclose(found.mean(measure), 50.0), measure
    assert (found.mean("coverage_90") < 0.91).all()


def test_what_differs_between_the_measures() -> None:
    """The error grows by one a step in one hypothesis and is three at every step in another one, to the other side."""
    steps = torch.arange(120, dtype=torch.float64)
    truth = torch.zeros(1, 1, 120, 2, dtype=torch.float64)
    position = torch.zeros(1, 2, 1, 120, 2, dtype=torch.float64)
    position[0, 0, 0, :, 0], position[0, 1, 0, :, 0] = steps, -3.0
    found = scored(position, truth)
    at = np.array(HORIZONS)
    assert np.allclose(found.mean("displacement_error"), (at + 3.0) / 2)
    assert np.allclose(found.mean("ade"), (at / 2 + 3.0) / 2)
    assert np.allclose(found.mean("min_ade_at"), 3.0) and np.allclose(found.mean("min_ade"), 3.0)
    assert np.allclose(found.mean("mean_error"), np.abs(at - 3.0) / 2)
    assert np.allclose(found.mean("energy_score"), (at + 3.0) / 2 - (at + 3.0) / 4)
    # the best over the window is chosen, and not the best at the step
    position[0, 0, 0, :, 0] = torch.where(steps < 60, 0.0, 10.0)
    assert np.allclose(scored(position, truth).mean("min_ade_at"), 3.0)


def test_measures_are_those_of_the_metrics() -> None:
    position, truth = randn(4, 7, 1, 120, 2, seed=1), randn(4, 1, 120, 2, seed=2)
    weight = torch.rand(4, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weight = weight / weight.sum(dim=1, keepdim=True)
    found = scored(position, truth, weight=weight)
    at = list(HORIZONS)
    energy = metrics.energy_score(position, weight, truth)[:, 0, at].mean(dim=0)
    covered = metrics.coverage(position, weight, truth, (0.5, 0.9))[:, :, 0, at].mean(dim=1)
    assert np.allclose(found.mean("energy_score"), energy)
    assert np.allclose(np.stack([found.mean("coverage_50"), found.mean("coverage_90")]), covered)
    for index, step in enumerate(at):
        part = torch.ones(4, 1, step + 1, dtype=torch.bool)
        ade = metrics.ade(position[..., : step + 1, :], weight, truth[:, :, : step + 1], part)
        assert found.mean("ade")[index] == pytest.approx(float(ade.mean()))
    whole = metrics.min_ade(position, weight, truth, torch.ones(4, 1, 120, dtype=torch.bool))
    assert found.mean("min_ade")[-1] == pytest.approx(float(whole.mean()))


def test_the_papers_measure_of_mixtures_is_taken_where_it_is_given() -> None:
    truth = randn(3, 1, 120, 2)
    given = torch.arange(15, dtype=torch.float64).reshape(3, 5)
    found = scored(truth[:, None], truth, paper_error_m=given)
    assert np.allclose(found.mean("paper_error"), given.mean(dim=0)) and np.allclose(found.mean("displacement_error"), 0.0)


def test_shares_in_obstacles_are_of_states_and_of_the_ways_between() -> None:
    track = torch.zeros(1, 1, 1, 120, 2, dtype=torch.float64)
    track[..., 0] = 10.0 * torch.arange(120)
    wall = Obstacles(torch.tensor([[1000.0 + 305.0, 0.0, 3.0]], dtype=torch.float64))  # between two states, on none
    datum = torch.tensor([[1000.0, 0.0]], dtype=torch.float64)
    found = scored(track, track[:, 0], datum=datum, obstacles=wall)
    assert found.share("states_in_obstacles").tolist() == [0.0]
    assert found.share("segments_in_obstacles").tolist() == [pytest.approx(1 / 119)]
    disc = Obstacles(torch.tensor([[1000.0 + 300.0, 0.0, 10.5]], dtype=torch.float64))
    hit = scored(track, track[:, 0], datum=datum, obstacles=disc)
    assert hit.share("states_in_obstacles").tolist() == [pytest.approx(3 / 120)]
    assert hit.share("segments_in_obstacles").tolist() == [pytest.approx(4 / 119)]


def test_quantiles_of_step_lengths_are_right_to_one_per_cent() -> None:
    length = np.random.default_rng(0).lognormal(4.0, 1.0, (3, 2, 119))
    track = torch.zeros(3, 2, 1, 120, 2, dtype=torch.float64)
    track[:, :, 0, 1:, 1] = torch.from_numpy(length).cumsum(dim=-1)
    found = scored(track, track[:, 0], [4, 4, 9])
    assert found.steps.sum(axis=1) == pytest.approx([2.0, 1.0])
    quantiles = step_quantiles(found.steps.sum(axis=0), STEP_LEVELS)
    assert np.allclose(quantiles, np.quantile(length, STEP_LEVELS, method="inverted_cdf"), rtol=0.011)
    assert found.share("step_length").sum() / 3 == pytest.approx(length.mean())
    parked = scored(torch.zeros_like(track), track[:, 0])
    assert step_quantiles(parked.steps, [0.5, 1.0]).tolist() == [[0.0, 0.0]]


def test_parts_add_up_and_survive_as_json() -> None:
    position, truth = randn(6, 3, 1, 120, 2, seed=1), randn(6, 1, 120, 2, seed=2)
    episode = [0, 0, 1, 1, 1, 5]
    whole = scored(position, truth, episode, seconds=3.0)
    first = scored(position[:4], truth[:4], episode[:4], seconds=1.0)
    rest = scored(position[4:], truth[4:], episode[4:], seconds=2.0)
    for again in (EpisodeScores.add([first, rest]), EpisodeScores.from_json(whole.as_json())):
        for field in dataclasses.fields(EpisodeScores):
            assert np.allclose(getattr(again, field.name), getattr(whole, field.name), rtol=1e-12), field.name
    with pytest.raises(ValueError, match="other measures"):
        EpisodeScores.from_json(whole.as_json().replace("min_ade_at", "something"))


def test_intervals_come_from_the_episodes() -> None:
    """Many windows of two episodes: the interval spans both, however many windows there are."""
    truth = torch.zeros(40, 1, 120, 2, dtype=torch.float64)
    position = torch.zeros(40, 1, 1, 120, 2, dtype=torch.float64)
    position[20:, ..., 0] = 8.0
    found = scored(position, truth, [0] * 20 + [1] * 20)
    interval = mean_interval(found.measure("ade")[:, 0], found, 0, 500)
    assert (interval.value, interval.low, interval.high, interval.num_groups) == (4.0, 0.0, 8.0, 2)
    many = scored(position, truth, list(range(40)))
    wide = mean_interval(many.measure("ade")[:, 0], many, 0, 500)
    assert 0.0 < wide.low < 4.0 < wide.high < 8.0


def test_comparisons_are_paired() -> None:
    """Episodes differ by far, both estimators err in the same way, one of them always by two metres less."""
    truth = torch.zeros(30, 1, 120, 2, dtype=torch.float64)
    position = torch.zeros(30, 1, 1, 120, 2, dtype=torch.float64)
    position[..., 0] = 10.0 + 100.0 * torch.arange(30).reshape(-1, 1, 1, 1)
    episode = [index // 3 for index in range(30)]
    scores = {"rival": scored(position, truth, episode), "own": scored(position - torch.tensor([2.0, 0.0]), truth, episode)}
    for step in (*HORIZONS, None):
        found = comparison("own", "rival", step, scores, 0, 300)
        assert (found.difference_m, found.difference_low_m, found.difference_high_m) == pytest.approx((-2.0, -2.0, -2.0))
        assert 0.99 < found.ratio_low <= found.ratio <= found.ratio_high < 1.0
    other = scored(position, truth, list(range(30)))
    with pytest.raises(ValueError, match="same windows"):
        comparison("own", "rival", 0, {**scores, "rival": other}, 0, 10)


def test_the_report_shows_metres_and_shares_of_the_side() -> None:
    truth = randn(6, 1, 120, 2).cumsum(dim=2)
    episode = [0, 0, 1, 1, 2, 2]
    shift = torch.tensor([30.0, 40.0])
    own = scored((truth + shift)[:, None], truth, episode)
    rival = scored((truth + 2 * shift)[:, None], truth, episode)
    report = pool({"mine": own, "theirs": rival}, scored(truth[:, None], truth, episode), FACTS, 100)
    rows = {(row.estimator, row.measure, row.step): row for row in report.rows}
    row = rows["mine", "displacement_error", 59]
    assert row.value == pytest.approx(50.0) and row.value_of_side == pytest.approx(0.05) and row.num_windows == 6
    assert row.low_of_side == pytest.approx(0.05) and rows["mine", "coverage_90", 0].value_of_side is None
    assert rows["truth", "step_length_mean", None].value == rows["mine", "step_length_mean", None].value
    assert [item.ratio for item in report.comparisons] == pytest.approx([0.5] * 6)
    page = as_markdown(report)
    assert "the true start counts as a detection" in page and "| mine | 0.05 [0.05, 0.05] |" in page
    assert "| theirs | 100 [100, 100] |" in page and "| theirs | 0.5 [0.5, 0.5] |" in page
    assert len(as_csv(report).splitlines()) == 1 + len(report.rows)
    bare = as_markdown(pool({"mine": own}, own, dataclasses.replace(FACTS, scale_m=None, known_start=False), 10))
    assert "over the map side" not in bare and "the start is not known" in bare


def test_bounds_of_quantiles_span_the_episodes() -> None:
    track = torch.zeros(3, 1, 1, 120, 2, dtype=torch.float64)
    track[..., 0] = torch.arange(120) * torch.tensor([10.0, 20.0, 30.0]).reshape(3, 1, 1, 1)
    rows = {row.measure: row for row in motion_rows("x", scored(track, track[:, 0], [0, 1, 2]), FACTS, 200)}
    median = rows["step_length_50"]
    assert median.value == pytest.approx(20.0, rel=0.01)
    assert median.low == pytest.approx(10.0, rel=0.01) and median.high == pytest.approx(30.0, rel=0.01)


def test_numbers_are_plain() -> None:
    assert [number(value) for value in (None, float("nan"), 0.01234, 68_812.0, 7.0)] == ["–", "–", "0.0123", "68800", "7"]
