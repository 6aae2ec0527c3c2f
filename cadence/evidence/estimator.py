"""Any estimator with evidence: draw, weigh, look at the effective sample size, draw more where it is small.

The cheapest way that holds is taken, window by window: what weak evidence says is told by the weights of the hypotheses that
are drawn anyway; more are drawn only where few of these count. Without evidence nothing is touched.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Self

import torch
from torch import Tensor

from cadence.evidence.choosing import ENOUGH, Choice, choose_apart, choose_together, evened
from cadence.evidence.settings import WeighingConfig
from cadence.evidence.weights import Said, effective, hear
from cadence.seeds import numpy_stream
from cadence.types import Detections, Estimator, HypothesisSet, WindowBatch

CONTRADICTED, FEW_FIT = "contradicted", "few_fit"
"""Statuses: evidence that speaks against every track was set aside; hardly any track fits what the evidence says."""

FEWEST = 0.1
"""Of the hypotheses that count; below it the status says so."""
_MOST_NUMBERS = 8_000_000
"""Coordinates drawn at once where more hypotheses are drawn: 64 MB."""


@dataclass(frozen=True, eq=False)
class WithEvidence:
    """An estimator whose hypotheses are weighed by the evidence in the windows' context.

    estimator  what draws
    is_apart   it draws every agent by itself, so that tracks of agents may be joined anew
    num_past   so many steps before its windows' first one it can draw as well: evidence is heard there, too
    """

    estimator: Estimator
    config: WeighingConfig = field(default_factory=WeighingConfig)
    is_apart: bool = False
    num_past: int = 0

    @property
    def name(self) -> str:
        """That of the estimator."""
        return self.estimator.name

    def fit(self, tracks: Detections) -> Self:
        """With the estimator fitted."""
        return dataclasses.replace(self, estimator=self.estimator.fit(tracks))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Weighted hypotheses; without evidence those of the estimator, untouched.

        The status of an agent is "contradicted" where some evidence spoke against all of its tracks and was set aside, and
        "few_fit" where, after all that was drawn, less than a tenth of the hypotheses count.
        """
        if not self.config.is_used or windows.context is None or not windows.context.evidence:
            return self.estimator.sample(windows, num_hypotheses)
        asked = with_past(windows, self.num_past)
        found = self.estimator.sample(asked, num_hypotheses)
        said = hear(asked, found.position_m, found.height_m)
        if not bool(said.is_touched.any()):
            return self._cut(found)
        weighed = self._chosen(found, said, asked, num_hypotheses)
        missing = ENOUGH * num_hypotheses / _least_effective(found, said, asked, self.is_apart)
        is_short = said.is_touched & (missing > 1.0)
        if bool(is_short.any()) and self.config.most_draws > 1:
            # as many times as many as are missing, in halves, so that windows can be drawn together
            times = torch.where(is_short, (2.0 * missing).ceil().mul(0.5).clamp_max(self.config.most_draws), 0.0)
            for each in sorted(set(times.tolist())):
                if each > 0.0:
                    weighed = self._drawn_more(weighed, asked, times == each, num_hypotheses, math.ceil(each * num_hypotheses))
        return self._cut(_with_few(weighed, num_hypotheses))

    def _drawn_more(
        self, weighed: HypothesisSet, windows: WindowBatch, is_short: Tensor, num: int, num_drawn: int
    ) -> HypothesisSet:
        """The windows that are short of hypotheses, chosen from more draws."""
        at_once = max(1, _MOST_NUMBERS // (2 * num_drawn * windows.num_agents * windows.num_steps))
        for some in torch.split(is_short.nonzero()[:, 0], at_once):
            part = windows[some]
            found = self.estimator.sample(part, num_drawn)
            weighed = _put(weighed, some, self._chosen(found, hear(part, found.position_m, found.height_m), part, num))
        return weighed

    def _chosen(self, found: HypothesisSet, said: Said, windows: WindowBatch, num: int) -> HypothesisSet:
        """`num` weighted hypotheses of those that were drawn; windows that nothing speaks of keep their first ones."""
        position_m, weight = found.position_m[:, :num].clone(), found.weight[:, :num].clone()
        height_m = None if found.height_m is None else found.height_m[:, :num].clone()
        num_effective = torch.full(said.is_contradicted.shape, torch.nan, dtype=torch.float64)
        for row in said.is_touched.nonzero()[:, 0].tolist():
            choice = self._choice(found, said, row, int(windows.seeds[row]), num)
            index = torch.from_numpy(choice.index).expand(num, position_m.shape[2])
            agents = torch.arange(position_m.shape[2]).expand_as(index)
            position_m[row] = found.position_m[row][index, agents]
            if height_m is not None and found.height_m is not None:
                height_m[row] = found.height_m[row][index, agents]
            weight[row] = torch.from_numpy(choice.weight).to(weight.dtype)
            num_effective[row] = torch.from_numpy(choice.num_effective)
        status = tuple(
            tuple(CONTRADICTED if odd and word == "ok" else word for odd, word in zip(odds, words, strict=True))
            for odds, words in zip(said.is_contradicted.tolist(), found.status, strict=True)
        )
        return HypothesisSet(position_m, weight, status, torch.where(windows.is_active, num_effective, torch.nan), height_m)

    def _choice(self, found: HypothesisSet, said: Said, row: int, seed: int, num: int) -> Choice:
        generator = numpy_stream(seed, "evidence")
        apart, joint = said.apart[row].numpy(), said.joint[row].numpy()
        if self.is_apart and found.position_m.shape[2] > 1 and said.is_apart:
            choice = choose_apart(apart, num, generator)
        else:
            prior = found.weight[row].double().log().numpy()
            choice = choose_together(joint + apart.sum(axis=1) + prior, num, float(generator.random()))
        return evened(choice, float(generator.random())) if self.config.is_equal else choice

    def _cut(self, found: HypothesisSet) -> HypothesisSet:
        """Hypotheses on the grid that was asked for."""
        if not self.num_past:
            return found
        height_m = None if found.height_m is None else found.height_m[..., self.num_past :]
        return dataclasses.replace(found, position_m=found.position_m[..., self.num_past :, :], height_m=height_m)


def weighed_as_drawn(found: HypothesisSet, windows: WindowBatch, config: WeighingConfig) -> HypothesisSet:
    """Joint hypotheses that cannot be drawn again, weighed by what the evidence in the context of `windows` says of them."""
    weigh = WithEvidence(_Drawn(found), dataclasses.replace(config, most_draws=1))
    return weigh.sample(windows, found.weight.shape[1])


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Stands for an estimator that has drawn."""

    found: HypothesisSet
    name: str = "drawn"

    def fit(self, tracks: Detections) -> Self:
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        return self.found


def with_past(windows: WindowBatch, num_steps: int) -> WindowBatch:
    """The same windows on a grid that begins so many steps earlier."""
    if num_steps == 0:
        return windows
    before = windows.time_s[0] - windows.step_s * torch.arange(num_steps, 0, -1).to(windows.time_s.dtype)
    return dataclasses.replace(
        windows, time_s=torch.cat([before, windows.time_s]), origin_index=windows.origin_index + num_steps
    )


def _least_effective(found: HypothesisSet, said: Said, windows: WindowBatch, is_apart: bool) -> Tensor:
    """How many of the hypotheses of each window count [B], of agents that are drawn apart of the one of which fewest do."""
    log_weight = said.apart + said.joint[..., None]
    if not (is_apart and said.is_apart):
        log_weight = (said.apart.sum(-1) + said.joint + found.weight.double().log())[..., None]
    by_agent = effective(torch.softmax(log_weight, 1).transpose(1, 2))
    is_asked = windows.is_active if by_agent.shape[1] > 1 else torch.ones_like(by_agent, dtype=torch.bool)
    return torch.where(is_asked, by_agent, torch.inf).amin(1)


def _put(whole: HypothesisSet, rows: Tensor, part: HypothesisSet) -> HypothesisSet:
    """`whole` with the windows of `part` at `rows`."""
    position_m, weight = whole.position_m.clone(), whole.weight.clone()
    position_m[rows], weight[rows] = part.position_m, part.weight
    assert whole.num_effective is not None and part.num_effective is not None
    num_effective = whole.num_effective.clone()
    num_effective[rows] = part.num_effective
    status = list(whole.status)
    for row, words in zip(rows.tolist(), part.status, strict=True):
        status[row] = words
    height_m = whole.height_m
    if height_m is not None and part.height_m is not None:
        height_m = height_m.clone()
        height_m[rows] = part.height_m
    return HypothesisSet(position_m, weight, tuple(status), num_effective, height_m)


def _with_few(found: HypothesisSet, num_hypotheses: int) -> HypothesisSet:
    """The same; where hardly any hypothesis counts the status says so."""
    assert found.num_effective is not None
    is_few = found.num_effective < FEWEST * num_hypotheses  # false where nothing speaks
    status = tuple(
        tuple(FEW_FIT if few and word == "ok" else word for few, word in zip(row, words, strict=True))
        for row, words in zip(is_few.tolist(), found.status, strict=True)
    )
    return dataclasses.replace(found, status=status)
