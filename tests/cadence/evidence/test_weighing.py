"""Hypotheses weighed by evidence: known posteriors, the own-prior check, what contradicts, several agents, nothing without."""

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest
import torch

from cadence.evidence.choosing import choose_apart, choose_together, evened
from cadence.evidence.estimator import CONTRADICTED, FEW_FIT, WithEvidence, weighed_as_drawn, with_past
from cadence.evidence.settings import WeighingConfig
from cadence.seeds import derived_seeds
from cadence.types import Context, Detections, HypothesisSet, Tracks, WindowBatch

STEP_S, NUM_STEPS, ORIGIN = 10.0, 7, 4


@dataclass(frozen=True, eq=False)
class Walk:
    """Random walks of unit steps from the last detection's place, which stands at the first step: a prior known exactly."""

    name: str = "walk"

    def fit(self, tracks: Detections) -> Self:
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        shape = (num_hypotheses, windows.num_agents, windows.num_steps, 2)
        drawn = [
            torch.randn(shape, generator=torch.Generator().manual_seed(int(seed)), dtype=torch.float64)
            for seed in windows.seeds
        ]
        position_m = torch.stack(drawn).cumsum(3)
        position_m = torch.where(windows.is_active[:, None, :, None, None], position_m, torch.nan)
        status = tuple(tuple("ok" if flag else "no_detections" for flag in row) for row in windows.is_active.tolist())
        weight = torch.full((windows.num_windows, num_hypotheses), 1.0 / num_hypotheses, dtype=torch.float64)
        return HypothesisSet(position_m, weight, status)


@dataclass(frozen=True)
class Near:
    """A measurement of x, in the mission's frame, of one agent or of all of them apart."""

    x_m: float
    sigma_m: float
    at_s: float
    agent: str | None = None
    is_joint: bool = False
    name: str = "near"

    def touches(self, time_s: torch.Tensor) -> torch.Tensor:
        return (time_s - self.at_s).abs() < 0.5 * STEP_S

    def log_likelihood(self, tracks: Tracks) -> torch.Tensor:
        is_at = self.touches(tracks.time_s)[:, None, None]
        value = -0.5 * (((tracks.position_m[..., 0] - self.x_m) / self.sigma_m) ** 2)
        apart = torch.where(is_at & value.isfinite(), value, 0.0).sum(-1)
        if self.agent is not None:
            apart = apart * torch.tensor([name == self.agent for name in tracks.agent_ids])
        return apart.sum(-1) if self.is_joint else apart

    def contradicts(self, tracks: Tracks, log_likelihood: torch.Tensor) -> torch.Tensor:
        return log_likelihood.amax(1) < -7.0


def windows(*evidence: object, num: int = 1, num_agents: int = 1, datum_m: float = 0.0) -> WindowBatch:
    seen = Detections(
        torch.zeros(num, num_agents, 1).double(),
        torch.zeros(num, num_agents, 1, 2).double(),
        torch.eye(2).double().expand(num, num_agents, 1, 2, 2),
        torch.ones(num, num_agents, 1, dtype=torch.bool),
    )
    names = tuple(f"T{agent}" for agent in range(num_agents))
    context = Context(
        torch.full((num, 2), datum_m).double(), torch.full((num,), 1000.0), evidence=tuple(evidence), agent_ids=names
    )
    time_s = (torch.arange(NUM_STEPS) - ORIGIN) * STEP_S
    return WindowBatch(time_s, seen, torch.from_numpy(derived_seeds(7, "test", np.arange(num))), ORIGIN, context)


def mean_and_deviation(found: HypothesisSet, step: int, agent: int = 0, row: int = 0) -> tuple[float, float]:
    x_m, weight = found.position_m[row, :, agent, step, 0], found.weight[row]
    mean = float(weight @ x_m)
    return mean, float((weight @ (x_m - mean) ** 2).sqrt())


def test_weights_give_the_known_posterior_of_a_linear_gaussian_case():
    # the walk has variance 4 at step 3 and 5 at step 4; a measurement 1.5 there with variance 1 (Kalman by hand)
    batch = windows(Near(101.5, 1.0, 990.0), datum_m=100.0)
    found = WithEvidence(Walk(), WeighingConfig(most_draws=1)).sample(batch, 20_000)
    assert mean_and_deviation(found, 3) == pytest.approx((1.5 * 4 / 5, np.sqrt(4 - 16 / 5)), abs=0.03)
    assert mean_and_deviation(found, 4) == pytest.approx((1.5 * 4 / 5, np.sqrt(5 - 16 / 5)), abs=0.04)
    assert found.num_effective is not None and 5_000 < float(found.num_effective[0, 0]) < 15_000
    assert float(found.num_effective[0, 0]) == pytest.approx(float(1 / (found.weight[0] ** 2).sum()))


@pytest.mark.parametrize("most_draws", [1, 8])
def test_own_prior_check(most_draws):
    """Targets drawn from the sampler's prior, evidence made from them: the 90 % region holds 88 to 92 % of them.

    So many hypotheses are drawn because the region of few holds less: that of 60 equal ones 87 %.
    """
    num, generator = 1500, np.random.default_rng(5)
    x_m = generator.normal(size=(num, NUM_STEPS)).cumsum(1)
    measured_m = x_m[:, 3] + 1.2 * generator.normal(size=num)
    ranks = np.empty(num)
    for row in range(num):
        batch = windows(Near(float(measured_m[row]), 1.2, 990.0))
        batch = dataclasses.replace(batch, seeds=torch.tensor([row + 1]))
        found = WithEvidence(Walk(), WeighingConfig(most_draws=most_draws)).sample(batch, 400)
        ranks[row] = float(found.weight[0] @ (found.position_m[0, :, 0, 5, 0] < x_m[row, 5]).double())
    assert 0.88 <= np.mean((ranks > 0.05) & (ranks < 0.95)) <= 0.92


def test_evidence_after_the_origin_says_nothing_and_without_evidence_nothing_is_touched():
    later = Near(3.0, 0.1, 1000.0 + STEP_S)
    plain = Walk().sample(windows(), 30)
    for batch, config in ((windows(later), WeighingConfig()), (windows(Near(1.0, 0.1, 990.0)), WeighingConfig(False))):
        found = WithEvidence(Walk(), config).sample(batch, 30)
        assert torch.equal(found.position_m, plain.position_m) and torch.equal(found.weight, plain.weight)
        assert found.num_effective is None and found.status == plain.status
    assert WithEvidence(Walk()).sample(windows(), 30).num_effective is None


def test_more_are_drawn_only_where_few_count_and_weights_still_tell():
    batch = windows(Near(3.0, 0.5, 990.0), num=2)
    elapsed_s = torch.tensor([1000.0, 5000.0])  # of the second window the evidence says nothing
    batch = batch.with_context(dataclasses.replace(batch.context, elapsed_s=elapsed_s))
    found, few = (WithEvidence(Walk(), WeighingConfig(most_draws=most)).sample(batch, 30) for most in (32, 1))
    assert found.num_effective is not None and few.num_effective is not None
    assert float(few.num_effective[0, 0]) < 8 and float(found.num_effective[0, 0]) >= 15
    assert torch.isnan(found.num_effective[1]).all() and torch.equal(found.position_m[1], few.position_m[1])
    assert len({tuple(track) for track in found.position_m[0, :, 0, :, 0].tolist()}) == 30
    assert float(found.weight[0].max()) > 1.2 * float(found.weight[0].min())
    assert found.weight.sum(1).tolist() == pytest.approx([1.0, 1.0])


def test_what_contradicts_all_tracks_is_told_and_set_aside():
    batch = windows(Near(1e4, 1.0, 990.0), Near(1.0, 1.0, 990.0))
    found = WithEvidence(Walk()).sample(batch, 30)
    alone = WithEvidence(Walk()).sample(windows(Near(1.0, 1.0, 990.0)), 30)
    assert found.status == ((CONTRADICTED,),) and alone.status == (("ok",),)
    assert torch.equal(found.weight, alone.weight)
    # each of two says no to what the other says yes to: both are set aside together
    both = WithEvidence(Walk()).sample(windows(_Halves(True), _Halves(False)), 30)
    assert both.status == ((CONTRADICTED,),) and len(set(both.weight[0].tolist())) == 1


class _Halves(Near):
    """Tracks on one side of zero cannot be."""

    def __init__(self, is_left: bool) -> None:
        super().__init__(0.0, 1.0, 990.0)
        object.__setattr__(self, "is_left", is_left)

    def log_likelihood(self, tracks: Tracks) -> torch.Tensor:
        is_left = tracks.position_m[..., 3, 0] < 0
        return torch.where(is_left == self.is_left, -torch.inf, 0.0).double()


def test_few_that_fit_are_told():
    found = WithEvidence(Walk(), WeighingConfig(most_draws=1)).sample(windows(Near(0.3, 0.01, 990.0)), 30)
    assert found.status == ((FEW_FIT,),) and found.num_effective is not None and float(found.num_effective) < 3


def test_agents_drawn_apart_are_joined_anew_and_each_has_its_posterior():
    near = [Near(1.5 - agent, 1.0, 990.0, f"T{agent}") for agent in range(4)]
    batch = windows(*near, num_agents=4)
    apart = WithEvidence(Walk(), is_apart=True).sample(batch, 4000)
    for agent in range(4):
        assert mean_and_deviation(apart, 3, agent) == pytest.approx((0.8 * (1.5 - agent), np.sqrt(0.8)), abs=0.12)
    # evidence on all together keeps them together, and says the same on average
    joint = WithEvidence(Walk(), WeighingConfig(most_draws=16), is_apart=True).sample(
        windows(*(dataclasses.replace(one, is_joint=True) for one in near[:2]), num_agents=2), 4000
    )
    assert mean_and_deviation(joint, 3, 1) == pytest.approx((0.4, np.sqrt(0.8)), abs=0.12)
    assert joint.num_effective is not None and float(joint.num_effective[0, 0]) == float(joint.num_effective[0, 1])


def test_an_agent_that_is_not_there_changes_nothing_for_the_others():
    batch = windows(Near(1.5, 1.0, 990.0), num_agents=2)
    is_observed = batch.detections.is_observed.clone()
    is_observed[:, 1] = False
    batch = dataclasses.replace(batch, detections=dataclasses.replace(batch.detections, is_observed=is_observed))
    found = WithEvidence(Walk()).sample(batch, 4000)
    assert mean_and_deviation(found, 3) == pytest.approx((1.2, np.sqrt(0.8)), abs=0.1)
    assert found.num_effective is not None and torch.isnan(found.num_effective[0, 1])
    assert torch.isnan(found.position_m[0, :, 1]).all()


def test_evidence_before_the_grid_is_heard_where_the_estimator_can_draw_there():
    batch = windows(Near(1.5, 1.0, 940.0))  # two steps before the first one
    assert WithEvidence(Walk()).sample(batch, 2000).num_effective is None
    found = WithEvidence(Walk(), num_past=4).sample(batch, 2000)
    assert found.position_m.shape[-2] == NUM_STEPS and found.num_effective is not None
    assert with_past(batch, 0) is batch and with_past(batch, 4).time_s.tolist() == [-80.0 + 10.0 * i for i in range(11)]


def test_joint_hypotheses_that_cannot_be_drawn_again_are_weighed():
    batch = windows(Near(1.5, 1.0, 990.0))
    drawn = Walk().sample(batch, 2000)
    found = weighed_as_drawn(drawn, batch, WeighingConfig())
    assert torch.equal(found.position_m, drawn.position_m)
    assert mean_and_deviation(found, 3) == pytest.approx((1.2, np.sqrt(0.8)), abs=0.1)


def test_equal_weights_when_asked():
    found = WithEvidence(Walk(), WeighingConfig(is_equal=True)).sample(windows(Near(1.5, 1.0, 990.0)), 4000)
    assert set(found.weight[0].tolist()) == {1 / 4000}
    assert mean_and_deviation(found, 3) == pytest.approx((1.2, np.sqrt(0.8)), abs=0.1)
    assert found.num_effective is not None and float(found.num_effective[0, 0]) < 3900


def test_choices_are_right_on_average_and_keep_few_when_few_count():
    generator = np.random.default_rng(1)
    value, log_weight = generator.normal(size=400), 2.0 * generator.normal(size=400)
    weight = np.exp(log_weight) / np.exp(log_weight).sum()
    rows = [choose_together(log_weight, 20, u) for u in (np.arange(500) + 0.5) / 500]
    assert np.mean([row.weight @ value[row.index[:, 0]] for row in rows]) == pytest.approx(weight @ value, abs=0.03)
    assert all(row.num_effective >= 10 and len(set(row.index[:, 0])) == 20 for row in rows)
    one = np.where(np.arange(100) == 40, 0.0, -np.inf)
    assert set(choose_together(one, 10, 0.3).index[:, 0].tolist()) == {40}
    assert choose_together(one, 10, 0.3).num_effective == pytest.approx([1.0])
    pair = choose_apart(np.stack([one, one[::-1]], 1), 10, generator)
    assert {tuple(row) for row in pair.index.tolist()} == {(40, 59)} and pair.num_effective == pytest.approx([1.0, 1.0])
    assert evened(rows[0], 0.5).num_effective <= 20


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"log_likelihood": lambda self, tracks: torch.ones(1, 3)}, "above zero"),
        ({"log_likelihood": lambda self, tracks: torch.full((1, 3, 1), torch.nan)}, "or none"),
        ({"log_likelihood": lambda self, tracks: torch.zeros(3)}, r"expected \[B, K\]"),
    ],
)
def test_what_is_no_likelihood_is_a_defect(change, words):
    broken = type("Broken", (Near,), change)(1.0, 1.0, 990.0)
    with pytest.raises(ValueError, match=words):
        WithEvidence(Walk()).sample(windows(broken), 3)


def test_what_does_not_fit_together_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        WeighingConfig(most_draws=0)
    with pytest.raises(ValueError, match="elapsed_s"):
        batch = windows(Near(1.0, 1.0, 990.0))
        WithEvidence(Walk()).sample(batch.with_context(dataclasses.replace(batch.context, elapsed_s=None)), 3)
    with pytest.raises(ValueError, match="num_effective"):
        HypothesisSet(torch.zeros(1, 2, 1, 3, 2), torch.ones(1, 2), (("ok",),), torch.zeros(2, 2))
    for wrong in ({"time_s": torch.zeros(2, 4)}, {"agent_ids": ("a", "b")}, {"height_m": torch.zeros(1, 2)}):
        with pytest.raises(ValueError, match="Tracks"):
            Tracks(**({"position_m": torch.zeros(1, 2, 1, 3, 2), "time_s": torch.zeros(1, 3)} | wrong))
