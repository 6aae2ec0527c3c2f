"""Joint samples of height at every node, backwards through the filter and forwards after the last detection."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.height.filtering import Filtered, Nodes, State, Switching, fresh, predicted, staying
from cadence.height.modes import Steps, steps

_JITTER = 1e-9


@dataclass(frozen=True, eq=False)
class Numbers:
    """Random numbers of each row's own seed: normal [R, K, M, 4] and uniform [R, K, M, 2]."""

    normal: Tensor
    uniform: Tensor


@dataclass(frozen=True, eq=False)
class Drawn:
    """Samples at one node: height and rate, and the mode that led there [R, K]."""

    z: Tensor
    v: Tensor
    mode: Tensor

    def where(self, chosen: Tensor, other: "Drawn") -> "Drawn":
        """These for the chosen rows [R], the others for the rest."""
        is_own = chosen[:, None]
        return Drawn(*(torch.where(is_own, a, b) for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))


def random_numbers(seeds: Tensor, num_used: Tensor, num_hypotheses: int, num_nodes: int) -> Numbers:
    """Each row draws for its own nodes only (`num_used` [R]), so that its neighbours in the batch do not matter."""
    shape = (len(seeds), num_hypotheses, num_nodes)
    normal, uniform = torch.zeros(*shape, 4, dtype=torch.float64), torch.zeros(*shape, 2, dtype=torch.float64)
    for row, (seed, used) in enumerate(zip(seeds.tolist(), num_used.tolist(), strict=True)):
        generator = torch.Generator().manual_seed(seed)
        normal[row, :, :used] = torch.randn(num_hypotheses, used, 4, generator=generator, dtype=torch.float64)
        uniform[row, :, :used] = torch.rand(num_hypotheses, used, 2, generator=generator, dtype=torch.float64)
    return Numbers(normal, uniform)


def draw(switching: Switching, nodes: Nodes, filtered: Filtered, numbers: Numbers) -> tuple[Tensor, Tensor]:
    """Heights at every node, and the modes on the ways to them [R, K, M]."""
    num_nodes, last = nodes.time_s.shape[1], nodes.last
    at = [_at_last(filtered.states[-1], numbers.normal[:, :, -1], numbers.uniform[:, :, -1, 0])]
    for m in range(num_nodes - 2, -1, -1):
        normal, uniform = numbers.normal[:, :, m], numbers.uniform[:, :, m]
        drawn, is_last = at[-1], last == m
        if bool((m < last).any()):
            drawn = _earlier(switching, nodes, filtered.states[m], m, drawn, normal, uniform)
        if bool(is_last.any()):
            drawn = _at_last(filtered.states[m], normal, uniform[..., 0]).where(is_last, drawn)
        at.append(drawn)
    at.reverse()
    for m in range(int(last.amin()) + 1, num_nodes):
        at[m] = _later(switching, nodes, m, at[m - 1], numbers).where(m > last, at[m])
    return torch.stack([drawn.z for drawn in at], 2), torch.stack([drawn.mode for drawn in at], 2)


def _at_last(state: State, normal: Tensor, uniform: Tensor) -> Drawn:
    mode = _chosen(state.log_weight, uniform)
    z, v = _pair(state.of_mode(mode), normal)
    return Drawn(z, v, mode)


def _earlier(switching: Switching, nodes: Nodes, state: State, m: int, later: Drawn, normal: Tensor, uniform: Tensor) -> Drawn:
    """What led to the samples at the next node."""
    duration = nodes.time_s[:, m + 1] - nodes.time_s[:, m]
    to = steps(switching.modes, duration).of_mode(later.mode)
    stay, end = staying(switching, duration)
    kept, new = state.of_mode(later.mode), fresh(switching, state, duration).of_mode(later.mode)
    advantage = _log_density(new, to, later) - _log_density(kept, to, later) - stay.gather(1, later.mode)
    is_new = (uniform[..., 0] < torch.sigmoid(advantage)) & nodes.is_observed[:, m][:, None]
    z, v = _pair(_given_later(new.where(is_new, kept), to, later), normal)
    # under a new mode only the height carries over: which mode led there, and with which rate, the filter knows
    before = _log_of_height(state, z) + end[:, None]
    mode = torch.where(is_new, _chosen(before, uniform[..., 1]), later.mode)
    own = state.of_mode(mode)
    slope = own.zv / own.zz.clamp_min(1e-30)
    left = (own.vv - slope * own.zv).clamp_min(0.0).sqrt()
    v = torch.where(is_new, own.v + slope * (z - own.z) + left * normal[..., 2], v)
    return Drawn(z, v, mode)


def _later(switching: Switching, nodes: Nodes, m: int, before: Drawn, numbers: Numbers) -> Drawn:
    """The samples at a node after the last detection, of which the mode may change at every step."""
    duration = nodes.time_s[:, m] - nodes.time_s[:, m - 1]
    normal, uniform = numbers.normal[:, :, m], numbers.uniform[:, :, m]
    stay = staying(switching, duration)[0].gather(1, before.mode)
    is_new = uniform[..., 0] > stay.exp()
    mode = torch.where(is_new, _chosen(switching.log_weight.expand(len(duration), -1), uniform[..., 1]), before.mode)
    v = torch.where(is_new, switching.modes.initial_rate[mode] * normal[..., 3], before.v)
    to = steps(switching.modes, duration).of_mode(mode)
    zero = torch.zeros_like(v)
    z, v = _pair(predicted(State(before.z, v, zero, zero, zero, zero), to), normal)
    return Drawn(z, v, mode)


def _chosen(log_weight: Tensor, uniform: Tensor) -> Tensor:
    """Numbers [R, K] drawn by log weights [R, C] or [R, K, C]."""
    share = torch.softmax(log_weight, -1).cumsum(-1)
    share = share[:, None].expand(*uniform.shape, -1) if share.ndim == 2 else share
    return (share < uniform[..., None]).sum(-1).clamp(max=share.shape[-1] - 1)


def _pair(state: State, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Height and rate [R, K] of Gaussians by two standard normal numbers."""
    deviation = state.zz.clamp_min(0.0).sqrt()
    slope = state.zv / deviation.clamp_min(1e-15)
    left = (state.vv - slope**2).clamp_min(0.0).sqrt()
    return state.z + deviation * normal[..., 0], state.v + slope * normal[..., 0] + left * normal[..., 1]


def _log_density(source: State, to: Steps, later: Drawn) -> Tensor:
    """Log weight and density of the later samples under Gaussians before a step."""
    p = _floored(predicted(source, to))
    determinant = p.zz * p.vv - p.zv**2
    dz, dv = later.z - p.z, later.v - p.v
    distance = (p.vv * dz**2 - 2.0 * p.zv * dz * dv + p.zz * dv**2) / determinant
    return source.log_weight - 0.5 * (distance + determinant.log())


def _given_later(source: State, to: Steps, later: Drawn) -> State:
    """Gaussians before a step, given the samples after it."""
    p = _floored(predicted(source, to))
    determinant = p.zz * p.vv - p.zv**2
    # covariance of the state before with the one after
    cross_zz, cross_zv = source.zz + to.gain * source.zv, to.keep * source.zv
    cross_vz, cross_vv = source.zv + to.gain * source.vv, to.keep * source.vv
    gain_zz, gain_zv = (cross_zz * p.vv - cross_zv * p.zv) / determinant, (cross_zv * p.zz - cross_zz * p.zv) / determinant
    gain_vz, gain_vv = (cross_vz * p.vv - cross_vv * p.zv) / determinant, (cross_vv * p.zz - cross_vz * p.zv) / determinant
    dz, dv = later.z - p.z, later.v - p.v
    return State(
        source.z + gain_zz * dz + gain_zv * dv,
        source.v + gain_vz * dz + gain_vv * dv,
        source.zz - gain_zz * cross_zz - gain_zv * cross_zv,
        source.zv - gain_zz * cross_vz - gain_zv * cross_vv,
        source.vv - gain_vz * cross_vz - gain_vv * cross_vv,
        source.log_weight,
    )


def _floored(state: State) -> State:
    """Covariances with a floor, relative to what there is: modes without noise have singular ones."""
    zz, vv = state.zz * (1.0 + _JITTER) + _JITTER, state.vv * (1.0 + _JITTER) + _JITTER
    return State(state.z, state.v, zz, state.zv, vv, state.log_weight)


def _log_of_height(state: State, z: Tensor) -> Tensor:
    """Log weight of every mode [R, K, C] by the height alone."""
    variance = (state.zz + _JITTER)[:, None]
    return state.log_weight[:, None] - 0.5 * ((z[..., None] - state.z[:, None]) ** 2 / variance + variance.log())
