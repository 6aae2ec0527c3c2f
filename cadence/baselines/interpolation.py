"""Linear interpolation and hold, as rivals that draw joint samples: a straight line with a spread fitted to the log.

The variance per axis around the line, or around the held position, is c g^(2H) / (1 + (g / L)^(2H)) in the length g of the gap
(the time since the detection that is held): a power law, bounded where the agent stays in one place. c, H and L are fitted by
likelihood to detections left out: at one, two, four, ... places apart, every octave of g with the same weight, because
bursts give hundreds of short gaps and the long ones are what matters.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from cadence.arrays import Float64s
from cadence.types import Detections, HypothesisSet, WindowBatch

_MAX_RESIDUALS = 2000
"""Residuals of one spacing that enter a fit; more tell nothing new."""


@dataclass(frozen=True)
class GapLaw:
    """Spread per axis: scale_m g^exponent at gaps g well below limit_s seconds, constant well above.

    A scale of zero (not fitted) has no spread.
    """

    scale_m: float = 0.0
    exponent: float = 0.5
    limit_s: float = math.inf

    def variance(self, gap_s: Tensor) -> Tensor:
        """Variance per axis in m^2 at gaps of `gap_s` seconds (any shape; not negative)."""
        gap_s = gap_s.clamp_min(0.0)
        power = 2.0 * self.exponent
        return self.scale_m**2 * gap_s.pow(power) / (1.0 + (gap_s / self.limit_s).pow(power))


@dataclass
class Hold:
    """The last detection, held until the next one, with a spread that grows with its age (a random walk in warped time).

    Steps before the first detection hold the first one backwards.
    """

    name: str = "hold"
    law: GapLaw = GapLaw()

    def fit(self, tracks: Detections) -> Self:
        """The law of how far later detections lie from earlier ones."""
        return replace(self, law=_fit_law(_held_residuals(tracks), self.law))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples; deterministic in `windows.seeds`, window by window."""
        draws = _draw(windows, num_hypotheses)
        return _as_set(windows, _hold(draws, self.law))


@dataclass
class LinearInterpolation:
    """A straight line between detections with a Brownian bridge around it; hold after the last and before the first one.

    At the middle of a gap of length g the bridge has the variance that the law gives for g, at its ends none.
    """

    name: str = "linear"
    law: GapLaw = GapLaw()
    hold_law: GapLaw = GapLaw()

    def fit(self, tracks: Detections) -> Self:
        """The laws of how far detections lie from the line between their neighbours, and from earlier ones."""
        return replace(
            self,
            law=_fit_law(_line_residuals(tracks), self.law),
            hold_law=_fit_law(_held_residuals(tracks), self.hold_law),
        )

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples; deterministic in `windows.seeds`, window by window."""
        draws = _draw(windows, num_hypotheses)
        outside = _hold(draws, self.hold_law)
        return _as_set(windows, torch.where(draws.is_between[:, None, ..., None], _bridge(draws, self.law), outside))


@dataclass(frozen=True, eq=False)
class _Draws:
    """Detections brought to the steps of the grid, and the noise that is used up there.

    before, after: index [B, A, T] of the last detection at or before the step and of the first one after it
    point_m [B, K, A, N, 2] detections drawn from their covariances; noise [B, K, A, T, 2] standard normal
    """

    time_s: Tensor  # [T]
    detection_s: Tensor  # [B, A, N]
    before: Tensor
    after: Tensor
    has_before: Tensor
    has_after: Tensor
    point_m: Tensor
    noise: Tensor

    @property
    def is_between(self) -> Tensor:
        return self.has_before & self.has_after

    def time_at(self, index: Tensor) -> Tensor:
        return self.detection_s.gather(2, index)

    def point_at(self, index: Tensor) -> Tensor:
        k = self.point_m.shape[1]
        return self.point_m.gather(3, index[:, None, :, :, None].expand(-1, k, -1, -1, 2))


def _draw(windows: WindowBatch, num_hypotheses: int) -> _Draws:
    detections, steps = windows.detections, windows.time_s.double()
    time_s = detections.time_s.double().masked_fill(~detections.is_observed, torch.inf)
    num_before = torch.searchsorted(time_s.contiguous(), steps.expand(*time_s.shape[:2], -1).contiguous(), right=True)
    last = (detections.count - 1).clamp_min(0)[..., None]
    noise, detection_noise = _noise(windows, num_hypotheses)
    # Exact detections have no covariance: a micrometre leaves them exact and the factor defined.
    factor = torch.linalg.cholesky(detections.covariance_m2.double() + 1e-12 * torch.eye(2, dtype=torch.float64))
    point_m = detections.position_m.double()[:, None] + torch.einsum("bansu,bkanu->bkans", factor, detection_noise)
    return _Draws(
        time_s=steps,
        detection_s=detections.time_s.double(),
        before=torch.minimum((num_before - 1).clamp_min(0), last),
        after=torch.minimum(num_before, last),
        has_before=num_before > 0,
        has_after=num_before < detections.count[..., None],
        point_m=point_m,
        noise=noise,
    )


def _noise(windows: WindowBatch, num_hypotheses: int) -> tuple[Tensor, Tensor]:
    """Standard normal [B, K, A, T, 2] and [B, K, A, N, 2] from each window's seed.

    Detections come last and first axis first, so that a window's numbers do not depend on the padding of its batch.
    """
    a, t, n = windows.num_agents, windows.num_steps, windows.detections.time_s.shape[2]
    steps, points = [], []
    for seed in windows.seeds.tolist():
        rng = np.random.default_rng(seed & (2**63 - 1))
        steps.append(rng.standard_normal((num_hypotheses, a, t, 2)))
        points.append(rng.standard_normal((n, num_hypotheses, a, 2)).transpose(1, 2, 0, 3))
    if not steps:
        return torch.zeros(0, num_hypotheses, a, t, 2).double(), torch.zeros(0, num_hypotheses, a, n, 2).double()
    return torch.from_numpy(np.stack(steps)), torch.from_numpy(np.stack(points))


def _hold(draws: _Draws, law: GapLaw) -> Tensor:
    """Held positions plus a random walk whose variance at age g is law.variance(g), [B, K, A, T, 2]."""
    forward = _walk(draws.time_s - draws.time_at(draws.before), draws.before, draws.noise, law)
    age_back = draws.time_at(draws.after) - draws.time_s
    backward = _walk(age_back.flip(-1), draws.after.flip(-1), draws.noise.flip(3), law).flip(3)
    held = draws.has_before[:, None, ..., None]
    return torch.where(held, draws.point_at(draws.before) + forward, draws.point_at(draws.after) + backward)


def _walk(age_s: Tensor, anchor: Tensor, noise: Tensor, law: GapLaw) -> Tensor:
    """Random walk of variance law.variance(age) which starts at zero at every new anchor: [B, K, A, T, 2]."""
    variance = law.variance(age_s)  # [B, A, T]
    walk = torch.zeros_like(noise)
    for t in range(noise.shape[3]):
        step = variance[..., t]
        if t:
            goes_on = anchor[..., t] == anchor[..., t - 1]
            step = step - torch.where(goes_on, variance[..., t - 1], 0.0)
            walk[:, :, :, t] = torch.where(goes_on[:, None, :, None], walk[:, :, :, t - 1], 0.0)
        walk[:, :, :, t] += step.clamp_min(0.0).sqrt()[:, None, :, None] * noise[:, :, :, t]
    return walk


def _bridge(draws: _Draws, law: GapLaw) -> Tensor:
    """Straight lines plus Brownian bridges, [B, K, A, T, 2]; meaningless outside the detections."""
    start_s, end_s = draws.time_at(draws.before), draws.time_at(draws.after)
    gap_s = (end_s - start_s).clamp_min(1e-9)
    part = ((draws.time_s - start_s) / gap_s).clamp(0.0, 1.0)
    ratio = part[:, None, ..., None]
    line_m = (1.0 - ratio) * draws.point_at(draws.before) + ratio * draws.point_at(draws.after)
    # The standard bridge has variance 1/4 in its middle.
    scale = 2.0 * law.variance(gap_s).sqrt()[:, None, ..., None]
    return line_m + scale * _standard_bridge(part, draws.before, draws.noise)


def _standard_bridge(part: Tensor, anchor: Tensor, noise: Tensor) -> Tensor:
    """Brownian bridges on [0, 1] at `part` [B, A, T], a new one at every new anchor: [B, K, A, T, 2].

    Step by step: given the bridge at p, at q it is normal with mean b (1 - q) / (1 - p), variance (q - p)(1 - q) / (1 - p).
    """
    bridge = torch.zeros_like(noise)
    for t in range(noise.shape[3]):
        now, earlier = part[..., t], torch.zeros_like(part[..., t])
        value = torch.zeros_like(bridge[:, :, :, t])
        if t:
            goes_on = anchor[..., t] == anchor[..., t - 1]
            earlier = torch.where(goes_on, part[..., t - 1], 0.0)
            value = torch.where(goes_on[:, None, :, None], bridge[:, :, :, t - 1], 0.0)
        left = (1.0 - now) / (1.0 - earlier).clamp_min(1e-12)
        sigma = ((now - earlier) * left).clamp_min(0.0).sqrt()
        bridge[:, :, :, t] = left[:, None, :, None] * value + sigma[:, None, :, None] * noise[:, :, :, t]
    return bridge


def _as_set(windows: WindowBatch, position_m: Tensor) -> HypothesisSet:
    is_active = windows.is_active
    position_m = position_m.masked_fill(~is_active[:, None, :, None, None], torch.nan)
    b, k = position_m.shape[:2]
    status = tuple(tuple("ok" if active else "no_detections" for active in row) for row in is_active.tolist())
    dtype = windows.detections.position_m.dtype
    return HypothesisSet(position_m.to(dtype), torch.full((b, k), 1.0 / k, dtype=dtype), status)


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Squared residual per axis [M], the gap that a law is asked for, what part of its variance applies, noise variance."""

    squared_m2: Tensor
    gap_s: Tensor
    part: Tensor
    noise_m2: Tensor


def _held_residuals(tracks: Detections) -> _Residuals:
    """Detections against earlier ones, one, two, four, ... places apart."""
    found = []
    for lag in _spacings(tracks, reach=1):
        first, later = _sliced(tracks, 0, lag), _sliced(tracks, lag, 0)
        squared = (later.position_m - first.position_m).double().square().mean(dim=-1)
        noise = _variance(first) + _variance(later)
        gap = (later.time_s - first.time_s).double()
        found.append(_chosen(later.is_observed, squared, gap, torch.ones_like(gap), noise))
    return _joined(found)


def _line_residuals(tracks: Detections) -> _Residuals:
    """Detections against the line between those one, two, four, ... places before and after."""
    found = []
    for lag in _spacings(tracks, reach=2):
        first, middle, later = _sliced(tracks, 0, 2 * lag), _sliced(tracks, lag, lag), _sliced(tracks, 2 * lag, 0)
        gap = (later.time_s - first.time_s).double()
        part = (middle.time_s - first.time_s).double() / gap.clamp_min(1e-9)
        line_m = (1.0 - part)[..., None] * first.position_m.double() + part[..., None] * later.position_m.double()
        squared = (middle.position_m.double() - line_m).square().mean(dim=-1)
        noise = _variance(middle) + (1.0 - part).square() * _variance(first) + part.square() * _variance(later)
        found.append(_chosen(later.is_observed, squared, gap, 4.0 * part * (1.0 - part), noise))
    return _joined(found)


def _spacings(tracks: Detections, reach: int) -> list[int]:
    longest = int(tracks.count.max()) if tracks.count.numel() else 0
    return [2**i for i in range(20) if reach * 2**i < longest]


def _sliced(tracks: Detections, skip: int, drop: int) -> Detections:
    columns = (tracks.time_s, tracks.position_m, tracks.covariance_m2, tracks.is_observed)
    return Detections(*(column[:, :, skip : tracks.time_s.shape[2] - drop] for column in columns))


def _variance(detections: Detections) -> Tensor:
    return detections.covariance_m2.double().diagonal(dim1=-2, dim2=-1).mean(dim=-1)


def _chosen(is_observed: Tensor, squared: Tensor, gap: Tensor, part: Tensor, noise: Tensor) -> _Residuals:
    """At most `_MAX_RESIDUALS` of one spacing, evenly taken; simultaneous detections say nothing about motion."""
    index = (is_observed & (gap > 0.0)).flatten().nonzero().squeeze(1)
    index = index[:: max(1, math.ceil(len(index) / _MAX_RESIDUALS))]
    return _Residuals(*(value.flatten()[index] for value in (squared, gap, part, noise)))


def _joined(found: list[_Residuals]) -> _Residuals:
    if not found:
        return _Residuals(*(torch.zeros(0, dtype=torch.float64) for _ in range(4)))
    return _Residuals(
        torch.cat([item.squared_m2 for item in found]), torch.cat([item.gap_s for item in found]),
        torch.cat([item.part for item in found]), torch.cat([item.noise_m2 for item in found]),
    )  # fmt: skip


def _fit_law(residuals: _Residuals, fallback: GapLaw) -> GapLaw:
    """The law of greatest likelihood; the fallback where there is nothing to fit."""
    if not len(residuals.gap_s):
        return fallback
    _, member, size = torch.unique(residuals.gap_s.log2().round().long(), return_inverse=True, return_counts=True)
    weight = (1.0 / size.double())[member] / len(size)
    typical_s, longest_s = float(residuals.gap_s.log().mean().exp()), float(residuals.gap_s.max())
    level = 0.5 * math.log(float((weight * residuals.squared_m2).sum()) + 1e-12)

    def law(parameters: Float64s) -> GapLaw:
        # The level at the typical gap, not at one second: there it hardly depends on the exponent.
        exponent = float(np.clip(parameters[1], 0.05, 2.0))
        scale_m = math.exp(float(np.clip(parameters[0], -30.0, 30.0))) / typical_s**exponent
        return GapLaw(scale_m, exponent, math.exp(float(np.clip(parameters[2], -30.0, 30.0))))

    def cost(parameters: Float64s) -> float:
        variance = law(parameters).variance(residuals.gap_s) * residuals.part + residuals.noise_m2 + 1e-12
        return float((weight * (variance.log() + residuals.squared_m2 / variance)).sum())

    starts = [(level, 0.8, math.log(longest_s * factor)) for factor in (0.1, 10.0)]
    found = [minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6}) for start in starts]
    return law(min(found, key=lambda result: float(result.fun)).x)
