"""Which model of motion moves a target in each stretch of a mission: chains of models, proposed given all detections.

A model is kept from one stretch to the next with the chance that the bank gives a track after its last detection, else drawn
anew from the log's prior weights: a hidden Markov chain. What is proposed rests on an estimate of its evidence in a stretch,
the likelihood of its detections given those shortly before it under one model; what a chain really makes of them comes to
count in `filtering`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.fitting import log_likelihood
from cadence.bank.rows import spaced
from cadence.bank.smoother import Nodes
from cadence.retrospect.timeline import Timeline

_NUM_BEFORE = 3
"""Detections before a stretch that say how the target came into it."""
_INFORMED = 0.5
"""Share of what is proposed that rests on evidence. Where a gap began in an earlier stretch this is wrong by much: it takes one
model for what led across the whole gap. What is proposed from the prior bounds the weights."""


def stretch_evidence(bank: Bank, rows: Nodes, timeline: Timeline) -> Tensor:
    """Log likelihood [R, J, C] of the detections of each stretch given the last ones before it, under every model.

    Args:
        bank: fitted; what it says of spacing holds.
        rows: detections [R, N] by time, padding last.
        timeline: J stretches.
    """
    telling = spaced(rows, bank.spacing_steps * timeline.step_s)
    r = len(telling.time_s)
    out = torch.zeros(r, timeline.num_stretches, len(bank.models), dtype=torch.float64)
    stretch = torch.where(telling.is_observed, timeline.stretch_of(telling.time_s), timeline.num_stretches)
    row, number = _occupied(stretch, timeline.num_stretches)
    if not len(row):
        return out
    begin = torch.searchsorted(stretch.contiguous(), torch.arange(timeline.num_stretches).expand(r, -1).contiguous())
    end = torch.searchsorted(stretch.contiguous(), torch.arange(1, timeline.num_stretches + 1).expand(r, -1).contiguous())
    begin, end = begin[row, number], end[row, number]
    before = (begin - _NUM_BEFORE).clamp_min(0)
    length_m = bank.length_m(timeline.step_s)
    speed_mps = length_m / timeline.step_s
    whole = log_likelihood(bank.models, _cut(telling, row, before, end), timeline.step_s, speed_mps)
    has_before = before < begin
    known = torch.zeros_like(whole)
    if bool(has_before.any()):
        part = _cut(telling, row[has_before], before[has_before], begin[has_before])
        known[has_before] = log_likelihood(bank.models, part, timeline.step_s, speed_mps)
    out[row, number] = whole - known
    return out


def _occupied(stretch: Tensor, num_stretches: int) -> tuple[Tensor, Tensor]:
    """Rows and numbers of the stretches [R, N] that hold a detection."""
    is_held = torch.zeros(len(stretch), num_stretches + 1, dtype=torch.bool)
    is_held.scatter_(1, stretch, True)
    row, number = is_held[:, :-1].nonzero(as_tuple=True)
    return row, number


def _cut(rows: Nodes, row: Tensor, begin: Tensor, end: Tensor) -> Nodes:
    """Detections `begin` to `end` (excluded) of some rows, padded behind."""
    place = begin[:, None] + torch.arange(int((end - begin).max()))
    is_observed = place < end[:, None]
    place = torch.minimum(place, end[:, None] - 1)
    index = row[:, None], place
    return Nodes(rows.time_s[index], rows.position_m[index], rows.covariance_m2[index], is_observed)


@dataclass(frozen=True, eq=False)
class Chains:
    """The hidden Markov chain of one bank's models over the stretches of R rows.

    prior       [C] weights of the models
    stay        [J - 1] chance that a model is kept from a stretch to the next
    log_local   [R, J, C] estimated evidence of each stretch
    log_ahead   [R, J, C] that of all later stretches, given the model in this one
    """

    prior: Tensor
    stay: Tensor
    log_local: Tensor
    log_ahead: Tensor

    @staticmethod
    def of(bank: Bank, local: Tensor, timeline: Timeline) -> "Chains":
        """The chain of a bank by its weights and rate of change; `local` [R, J, C] is the evidence of stretches."""
        num_models = local.shape[-1]
        prior = torch.full((num_models,), 1.0 / num_models).double() if bank.log_weight is None else bank.log_weight.exp()
        stay = torch.exp(-bank.switch_rate / timeline.step_s * _apart_s(timeline))
        ahead = torch.zeros_like(local)
        for j in range(local.shape[1] - 2, -1, -1):
            later = local[:, j + 1] + ahead[:, j + 1]
            top = later.amax(1, keepdim=True)
            value = (later - top).exp()
            anew = (value * prior).sum(1, keepdim=True)
            ahead[:, j] = (stay[j] * value + (1.0 - stay[j]) * anew).log() + top
        return Chains(prior, stay, local, ahead)

    def passes(self, stretch: int, before: Tensor) -> Tensor:
        """Chances [..., C] of the models in a stretch given those `before` it [...]."""
        kept = torch.nn.functional.one_hot(before, len(self.prior)).double()
        stay = self.stay[stretch - 1]
        return stay * kept + (1.0 - stay) * self.prior

    def proposed(self, stretch: int, before: Tensor | None, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Models [R, H] of a stretch drawn given those before it [R, H] (None: it is the first), and log prior over proposal.

        Args:
            stretch: its number.
            before: models in the stretch before.
            uniform: [R, H] uniform numbers.
        """
        prior = self.prior.expand(*uniform.shape, -1) if before is None else self.passes(stretch, before)
        score = prior.log() + (self.log_local[:, stretch] + self.log_ahead[:, stretch])[:, None]
        chance = _INFORMED * torch.softmax(score, dim=-1) + (1.0 - _INFORMED) * prior
        edges = chance.cumsum(-1)
        model = torch.searchsorted(edges, uniform[..., None] * edges[..., -1:], right=True)[..., 0]
        model = model.clamp(max=len(self.prior) - 1)[..., None]
        return model[..., 0], (prior.gather(-1, model) / chance.gather(-1, model)).log()[..., 0]


def _apart_s(timeline: Timeline) -> Tensor:
    """Seconds between the middles of successive stretches [J - 1]."""
    ends = torch.cat([timeline.begin_s, timeline.time_s[-1:]])
    middle = 0.5 * (ends[:-1] + ends[1:])
    return middle.diff()
