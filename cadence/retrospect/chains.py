"""Which model of motion moves a target in each stretch of a mission: chains of models drawn given all detections.

A model is kept from one stretch to the next with the chance that the bank gives a track after its last detection, else drawn
anew from the log's prior weights: a hidden Markov chain, whose evidence in a stretch is the likelihood of its detections
given those shortly before it. Whole chains are drawn by forward filter and backward sampling (Scott, "Bayesian methods for
hidden Markov models", JASA 97, 2002).
"""

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.fitting import log_likelihood
from cadence.bank.rows import spaced
from cadence.bank.smoother import Nodes
from cadence.retrospect.timeline import Timeline

_NUM_BEFORE = 3
"""Detections before a stretch that say how the target came into it."""


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


def drawn_chains(bank: Bank, evidence: Tensor, timeline: Timeline, uniform: Tensor) -> Tensor:
    """Models [R, H, J] of H chains a row, drawn given the evidence of all stretches.

    Args:
        bank: its weights, the rate at which models change, and how much the likelihood is believed (temper).
        evidence: [R, J, C], see `stretch_evidence`.
        timeline: J stretches.
        uniform: [R, H, J] uniform numbers.
    """
    r, num_stretches, num_models = evidence.shape
    prior = torch.full((num_models,), 1.0 / num_models).double() if bank.log_weight is None else bank.log_weight.exp()
    stay = torch.exp(-bank.switch_rate / timeline.step_s * _apart_s(timeline))
    likelihood = bank.temper * evidence
    forward = torch.empty(r, num_stretches, num_models, dtype=torch.float64)
    for j in range(num_stretches):
        before = prior.expand(r, -1) if j == 0 else stay[j - 1] * forward[:, j - 1] + (1.0 - stay[j - 1]) * prior
        forward[:, j] = torch.softmax(before.log() + likelihood[:, j], dim=1)
    model = torch.empty(uniform.shape, dtype=torch.int64)
    for j in range(num_stretches - 1, -1, -1):
        weight = forward[:, j, None].expand(-1, uniform.shape[1], -1)
        if j + 1 < num_stretches:
            later = model[:, :, j + 1, None]
            # what is not kept may also be drawn anew as the same model
            kept = torch.zeros_like(weight).scatter_(2, later, stay[j].expand(later.shape))
            weight = weight * (kept + (1.0 - stay[j]) * prior[later])
        edges = weight.cumsum(2)
        model[:, :, j] = torch.searchsorted(edges, uniform[:, :, j, None] * edges[..., -1:], right=True)[..., 0].clamp(
            max=num_models - 1
        )
    return model


def _apart_s(timeline: Timeline) -> Tensor:
    """Seconds between the middles of successive stretches [J - 1]."""
    ends = torch.cat([timeline.begin_s, timeline.time_s[-1:]])
    middle = 0.5 * (ends[:-1] + ends[1:])
    return middle.diff()
