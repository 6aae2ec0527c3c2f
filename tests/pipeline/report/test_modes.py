"""Hypotheses that keep together or part: by hand, and what must hold for any of them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cadence.constraints.checker import segments_in_collision
from cadence.constraints.obstacles import Obstacles
from pipeline.report.fans import Detail, encode_fan
from pipeline.report.mission import Fan
from pipeline.report.modes import LEAST_SHARE, MAX_WAYS, strands_of
from pipeline.report.shapes import shape_of

SECOND = 1_000_000_000
NUM_STEPS = 41
ISLAND = Obstacles(torch.tensor([[200.0, 0.0, 60.0]], dtype=torch.float64), ())


def fan_of(offset_m: np.ndarray, weight: np.ndarray | None = None) -> Fan:
    share = np.full(len(offset_m), 1 / len(offset_m)) if weight is None else weight
    return Fan(0, 0, 100 * SECOND, SECOND, 20, share, np.zeros(2), offset_m.astype(np.float32))


def round_the_island(num_north: int, num_south: int, width_m: float = 100.0, noise_m: float = 5.0) -> np.ndarray:
    """Tracks [K, T, 2] from (0, 0) to (400, 0), north or south of an island in the middle."""
    along = np.linspace(0, 400, NUM_STEPS)
    side = np.concatenate([np.ones(num_north), -np.ones(num_south)])
    rng = np.random.default_rng(3)
    away = side[:, None] * width_m * np.sin(np.pi * along / 400)
    away = away + noise_m * np.sin(np.pi * along / 400) * rng.normal(size=(len(side), 1))
    return np.stack([np.broadcast_to(along, away.shape), away], axis=-1)


def test_two_ways_round_an_island_are_told_with_their_shares() -> None:
    fan = fan_of(round_the_island(14, 16))
    shape = shape_of(fan)
    before, south, north, after = strands_of(fan, shape, ISLAND)
    assert abs(shape.mean_m[20] - (200, -100 / 15)).max() < 5  # the mean of all lies on the island
    assert (before.share, after.share) == (1.0, 1.0) and before.hypothesis is None and after.last == NUM_STEPS - 1
    assert (south.share, south.direction) == (pytest.approx(16 / 30), "south")
    assert (north.share, north.direction) == (pytest.approx(14 / 30), "north")
    assert before.last == south.first == north.first and after.first == south.last == north.last
    for way in (south, north):
        # One of the hypotheses is drawn, as it is.
        steps = slice(way.first, way.last + 1)
        assert np.array_equal(way.line_m, fan.offset_m[way.hypothesis, steps])
        assert abs(way.shape.mean_m[way.apart - way.first, 1]) > 60


@pytest.mark.parametrize("width_m", [62.0, 100.0, 300.0])
def test_nothing_is_drawn_through_an_obstacle_that_no_hypothesis_touches(width_m: float) -> None:
    fan = fan_of(round_the_island(14, 16, width_m, 0.2))
    assert not segments_in_collision(torch.from_numpy(fan.offset_m), ISLAND).any()
    assert segments_in_collision(torch.from_numpy(shape_of(fan).mean_m), ISLAND).any()
    for strand in strands_of(fan, shape_of(fan), ISLAND):
        assert not segments_in_collision(torch.from_numpy(strand.line_m.astype(np.float64)), ISLAND).any()


def test_a_mean_on_a_small_island_is_replaced_though_the_hypotheses_are_one_cloud() -> None:
    cloud = np.random.default_rng(0).normal(0, 100, (40, 1, 2)) + np.zeros((1, NUM_STEPS, 1))
    rock = Obstacles(torch.tensor([[*cloud[:, 0].mean(axis=0).tolist(), 5.0]], dtype=torch.float64), ())
    fan = fan_of(cloud)
    assert all(strand.hypothesis is not None for strand in strands_of(fan, shape_of(fan), rock))
    (whole,) = strands_of(fan, shape_of(fan), None)
    assert whole.hypothesis is None and np.array_equal(whole.line_m, whole.shape.mean_m)


@pytest.mark.parametrize("count", [12, 30, 100])
def test_a_cloud_is_one_way(count: int) -> None:
    rng = np.random.default_rng(5)
    fans = [fan_of(rng.normal(0, 50, (count, 1, 2)) + np.zeros((1, NUM_STEPS, 1))) for _ in range(100)]
    parted = sum(len(strands_of(fan, shape_of(fan), None)) > 1 for fan in fans)
    assert parted <= 5


def test_three_ways_and_strays() -> None:
    place_m = np.repeat([[0.0, 500], [430, -250], [-430, -250]], [12, 10, 8], axis=0)
    offset_m = place_m[:, None] + np.random.default_rng(1).normal(0, 10, (30, NUM_STEPS, 2))
    fan = fan_of(offset_m)
    assert [round(30 * way.share) for way in strands_of(fan, shape_of(fan), None)] == [12, 10, 8]
    # Two of thirty are strays: the rest is one way.
    stray = np.concatenate([np.zeros((28, NUM_STEPS, 2)), np.full((2, NUM_STEPS, 2), 900.0)])
    stray += np.random.default_rng(2).normal(0, 10, stray.shape)
    assert len(strands_of(fan_of(stray), shape_of(fan_of(stray)), None)) == 1


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 25), st.integers(1, 30), st.integers(0, 10_000))
def test_strands_cover_every_step_and_share_all_of_the_weight(count: int, num_steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0, 5, (count, num_steps, 2)) * rng.choice([1, 20], (count, 1, 1)), axis=1)
    fan = fan_of(walk, rng.dirichlet(np.ones(count)))
    strands = strands_of(fan, shape_of(fan), None)
    spans = {(strand.first, strand.last) for strand in strands}
    assert {step for first, last in spans for step in range(first, last + 1)} == set(range(num_steps))
    for span in spans:
        ways = [strand for strand in strands if (strand.first, strand.last) == span]
        assert sum(way.share for way in ways) == pytest.approx(1.0) and len(ways) <= MAX_WAYS
        assert len(ways) == 1 or min(way.share for way in ways) >= LEAST_SHARE - 1e-9


def test_the_page_holds_the_ways_as_they_are() -> None:
    fan = fan_of(round_the_island(5, 25))
    strands = strands_of(fan, shape_of(fan), ISLAND)
    code = encode_fan(fan, strands, Detail(1, 1, 8, 12))
    begin = 0
    for strand, (first, last, drawn, share, apart, _) in zip(strands, code.strand.tolist(), strict=True):
        assert (code.step[first], code.step[last]) == (strand.first, strand.last)
        assert share == round(1000 * strand.share) and (apart < 0 or code.step[apart] == strand.apart)
        at = code.step[first : last + 1]
        told = code.summary[begin : begin + len(at), :2] if drawn < 0 else code.hypothesis[drawn, first : last + 1]
        assert np.abs(told * code.scale_m + code.centre_m - strand.line_m[at - strand.first]).max() <= code.scale_m
        begin += len(at)
    assert begin == len(code.summary)
