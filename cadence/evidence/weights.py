"""What the evidence of a window says of drawn hypotheses; what contradicts all of them is told and set aside."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.types import Evidence, Tracks, WindowBatch

_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Said:
    """Log likelihood of hypotheses, less what contradicts them all.

    joint            [B, K] of all agents of a hypothesis together
    apart            [B, K, A] of each agent's track by itself
    is_touched       [B] windows of which any evidence speaks
    is_contradicted  [B, A] agents no track of which reaches what some evidence should find credible; that evidence is not in
                     `joint` or `apart` there
    """

    joint: Tensor
    apart: Tensor
    is_touched: Tensor
    is_contradicted: Tensor

    @property
    def is_apart(self) -> bool:
        """Whether nothing speaks of several agents together."""
        return not bool(self.joint.any())


def known_tracks(windows: WindowBatch, position_m: Tensor, height_m: Tensor | None = None) -> Tracks:
    """Hypotheses [B, K, A, T, 2] as evidence may see them: up to the window origin, in the mission's frame and time."""
    context = windows.required_context("evidence")
    if context.elapsed_s is None:
        raise ValueError("evidence: the context does not say when the windows are (elapsed_s)")
    num_known = windows.origin_index + 1
    place_m = position_m[..., :num_known, :].double() + context.datum_m[:, None, None, None]
    time_s = context.elapsed_s.double()[:, None] + windows.time_s[:num_known].double()
    return Tracks(place_m, time_s, context.agent_ids, None if height_m is None else height_m[..., :num_known])


def hear(windows: WindowBatch, position_m: Tensor, height_m: Tensor | None = None) -> Said:
    """What all evidence in the context of `windows` says of hypotheses [B, K, A, T, 2] that were drawn for them."""
    tracks = known_tracks(windows, position_m, height_m)
    b, k, a = position_m.shape[:3]
    joint, apart = torch.zeros(b, k, dtype=torch.float64), torch.zeros(b, k, a, dtype=torch.float64)
    is_touched, is_contradicted = torch.zeros(b, dtype=torch.bool), torch.zeros(b, a, dtype=torch.bool)
    for evidence in windows.required_context("evidence").evidence:
        speaks = evidence.touches(tracks.time_s).any(1)
        if not bool(speaks.any()):
            continue
        is_touched |= speaks
        value = _asked(evidence, tracks)
        is_odd = evidence.contradicts(tracks, value).reshape(b, -1).expand(b, a)
        if value.ndim == 2:
            joint += torch.where(is_odd.any(1, keepdim=True), 0.0, value)
        else:
            apart += torch.where(is_odd[:, None], 0.0, value)
        is_contradicted |= is_odd
    is_hopeless = (joint + apart.sum(-1)).amax(1) == -torch.inf  # each track ruled out by something else
    joint[is_hopeless], apart[is_hopeless] = 0.0, 0.0
    return Said(joint, apart, is_touched, (is_contradicted | is_hopeless[:, None]) & windows.is_active)


def _asked(evidence: Evidence, tracks: Tracks) -> Tensor:
    value = evidence.log_likelihood(tracks)
    shape = tuple(tracks.position_m.shape)
    if tuple(value.shape) not in (shape[:2], shape[:3]):
        raise ValueError(f"evidence {evidence.name}: log likelihood {tuple(value.shape)}, expected [B, K] or [B, K, A]")
    if not bool((value <= _ROUNDING).all()):  # false for NaN as well
        raise ValueError(f"evidence {evidence.name}: a log likelihood above zero, or none")
    return value.double()


def effective(weight: Tensor) -> Tensor:
    """Effective sample size of weights that sum to one along the last axis (Kong, Liu, Wong, 1994)."""
    return 1.0 / weight.square().sum(-1)
