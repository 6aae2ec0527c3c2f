"""Joint samples of height at every node, backwards through the filter and forwards after the last detection."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.height.filtering import Filtered, Fresh, Nodes, State, Switching, Ways, blocks, new_modes, predicted
from cadence.height.modes import Steps

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
    num_nodes, last, modes = nodes.time_s.shape[1], nodes.last, switching.modes
    first_last = int(last.amin())
    at = [_at_last(filtered.states[-1], numbers.normal[:, :, -1], numbers.uniform[:, :, -1, 0])]
    pieces = blocks(num_nodes, len(last) * len(modes))
    for begin, end in reversed(pieces):
        back = _Back.of(switching, filtered, Ways.of(modes, nodes.time_s[:, begin : end + 1]), begin)
        for m in range(end - 1, begin - 1, -1):
            normal, uniform = numbers.normal[:, :, m], numbers.uniform[:, :, m]
            drawn, is_last = at[-1], last == m
            if bool((m < last).any()):
                drawn = back.earlier(m, drawn, normal, uniform, nodes.is_observed[:, m])
            if m >= first_last and bool(is_last.any()):
                drawn = _at_last(filtered.states[m], normal, uniform[..., 0]).where(is_last, drawn)
            at.append(drawn)
    at.reverse()
    for begin, end in pieces:
        if end <= first_last:
            continue
        ways = Ways.of(modes, nodes.time_s[:, begin : end + 1])
        for m in range(max(begin, first_last), end):
            at[m + 1] = _later(switching, ways[m - begin], at[m], numbers, m + 1).where(m + 1 > last, at[m + 1])
    return torch.stack([drawn.z for drawn in at], 2), torch.stack([drawn.mode for drawn in at], 2)


def _at_last(state: State, normal: Tensor, uniform: Tensor) -> Drawn:
    mode = _chosen(state.log_weight, uniform)
    own = state.of_mode(mode)
    law = _Pair.of(own)
    return Drawn(own.z + law.deviation * normal[..., 0], law.rate(own.v, normal), mode)


@dataclass(frozen=True, eq=False)
class _Back:
    """What led over each of W ways: all that does not depend on the samples, computed for all ways and modes at once.

    begin  node of the first way
    kept   [Q, W, R, C] of states whose mode goes on, and log probabilities of that
    new    [Q, W, R, C] where a mode may end
    end    [W, R, C] log probabilities that it does
    """

    filtered: Filtered
    begin: int
    kept: Tensor
    new: Tensor
    end: Tensor

    @staticmethod
    def of(switching: Switching, filtered: Filtered, ways: Ways, begin: int) -> "_Back":
        """Over the ways from node `begin` on."""
        stop = begin + len(ways.end)
        kept = _stacked(filtered.states[begin:stop])
        none = Fresh(*(torch.zeros(ways.end.shape[1], 1, dtype=torch.float64),) * 3)
        left = [new_modes(switching, each or none) for each in filtered.fresh[begin:stop]]
        return _Back(
            filtered,
            begin,
            torch.stack([*_law(kept, ways.to), ways.stay]),
            torch.stack(_law(_stacked(left), ways.to)),
            ways.end,
        )

    def earlier(self, m: int, later: Drawn, normal: Tensor, uniform: Tensor, observed: Tensor) -> Drawn:
        """What led to the samples at the node after m."""
        way, mode = m - self.begin, later.mode
        kept = _of_mode(self.kept[:, way], mode)
        z, v = _given_later(kept, later, normal)
        if self.filtered.fresh[m] is None:
            return Drawn(z, v, mode)
        new = _of_mode(self.new[:, way], mode)
        advantage = _log_density(new, later) - _log_density(kept, later) - kept[-1]
        is_new = (uniform[..., 0] < torch.sigmoid(advantage)) & observed[:, None]
        row, number = is_new.nonzero(as_tuple=True)
        if not len(row):
            return Drawn(z, v, mode)
        new_z, _ = _given_later(new, later, normal)
        new_z = new_z[row, number]
        # under a new mode only the height carries over: which mode led there, and with which rate, the filter knows
        state = self.filtered.states[m]
        before = _log_of_height(state, row, new_z) + self.end[way][row]
        new_mode = _chosen(before, uniform[row, number, 1])
        zz, zv, vv, own_z, own_v = (value[row, new_mode] for value in (state.zz, state.zv, state.vv, state.z, state.v))
        slope = zv / zz.clamp_min(1e-30)
        left = (vv - slope * zv).clamp_min(0.0).sqrt()
        new_v = own_v + slope * (new_z - own_z) + left * normal[row, number, 2]
        where, mode = (row, number), mode.clone()
        z[where], v[where], mode[where] = new_z, new_v, new_mode
        return Drawn(z, v, mode)


def _stacked(states: list[State]) -> State:
    """Moments and weights of states in a row [W, R, C]."""
    return State(*(torch.stack(values) for values in zip(*(vars(state).values() for state in states), strict=True)))


def _of_mode(values: Tensor, mode: Tensor) -> Tensor:
    """Of values [Q, R, C] those of the modes [R, K]."""
    return values.gather(2, mode.expand(len(values), -1, -1))


def _later(switching: Switching, way: Ways, before: Drawn, numbers: Numbers, m: int) -> Drawn:
    """The samples at a node after the last detection, of which the mode may change at every step."""
    normal, uniform = numbers.normal[:, :, m], numbers.uniform[:, :, m]
    is_new = uniform[..., 0] > way.stay.gather(1, before.mode).exp()
    mode = torch.where(is_new, _chosen(switching.log_weight.expand(len(way.stay), -1), uniform[..., 1]), before.mode)
    v = torch.where(is_new, switching.modes.initial_rate[mode] * normal[..., 3], before.v)
    zero = torch.zeros_like(v)
    after = predicted(State(before.z, v, zero, zero, zero, zero), way.to.of_mode(mode))
    law = _Pair.of(after)
    return Drawn(after.z + law.deviation * normal[..., 0], law.rate(after.v, normal), mode)


def _chosen(log_weight: Tensor, uniform: Tensor) -> Tensor:
    """Numbers [R, K] drawn by log weights [R, C], or [N] by [N, C]."""
    share = torch.softmax(log_weight, -1).cumsum(-1)
    share = share[:, None].expand(*uniform.shape, -1) if uniform.ndim == 2 else share
    return (share < uniform[..., None]).sum(-1).clamp(max=share.shape[-1] - 1)


@dataclass(frozen=True, eq=False)
class _Pair:
    """How height and rate are drawn by two standard normal numbers: z + deviation a, v + slope a + left b."""

    deviation: Tensor
    slope: Tensor
    left: Tensor

    @staticmethod
    def of(state: State) -> "_Pair":
        deviation = state.zz.clamp_min(0.0).sqrt()
        slope = state.zv / deviation.clamp_min(1e-15)
        return _Pair(deviation, slope, (state.vv - slope**2).clamp_min(0.0).sqrt())

    def rate(self, v: Tensor, normal: Tensor) -> Tensor:
        return v + self.slope * normal[..., 0] + self.left * normal[..., 1]


def _law(source: State, to: Steps) -> list[Tensor]:
    """What `_log_density` and `_given_later` need of Gaussians before steps, in their order."""
    p = _floored(predicted(source, to))
    determinant = p.zz * p.vv - p.zv**2
    # covariance of the state before with the one after
    cross_zz, cross_zv = source.zz + to.gain * source.zv, to.keep * source.zv
    cross_vz, cross_vv = source.zv + to.gain * source.vv, to.keep * source.vv
    gain_zz, gain_zv = (cross_zz * p.vv - cross_zv * p.zv) / determinant, (cross_zv * p.zz - cross_zz * p.zv) / determinant
    gain_vz, gain_vv = (cross_vz * p.vv - cross_vv * p.zv) / determinant, (cross_vv * p.zz - cross_vz * p.zv) / determinant
    given = State(
        source.z, source.v,
        source.zz - gain_zz * cross_zz - gain_zv * cross_zv,
        source.zv - gain_zz * cross_vz - gain_zv * cross_vv,
        source.vv - gain_vz * cross_vz - gain_vv * cross_vv,
        source.log_weight,
    )  # fmt: skip
    density = [p.z, p.v, p.vv, 2.0 * p.zv, p.zz, determinant, determinant.log(), source.log_weight]
    return [*density, source.z, source.v, gain_zz, gain_zv, gain_vz, gain_vv, *vars(_Pair.of(given)).values()]


def _log_density(law: Tensor, later: Drawn) -> Tensor:
    """Log weight and density of the later samples under Gaussians before a step."""
    z, v, vv, twice_zv, zz, determinant, log_determinant, log_weight = law[:8].unbind()
    dz, dv = later.z - z, later.v - v
    distance = (vv * dz**2 - twice_zv * dz * dv + zz * dv**2) / determinant
    found: Tensor = log_weight - 0.5 * (distance + log_determinant)
    return found


def _given_later(law: Tensor, later: Drawn, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Height and rate [R, K] before a step drawn given the samples after it."""
    dz, dv = later.z - law[0], later.v - law[1]
    z, v, gain_zz, gain_zv, gain_vz, gain_vv, *pair = law[8:17].unbind()
    draws = _Pair(*pair)
    z = z + gain_zz * dz + gain_zv * dv
    return z + draws.deviation * normal[..., 0], draws.rate(v + gain_vz * dz + gain_vv * dv, normal)


def _floored(state: State) -> State:
    """Covariances with a floor, relative to what there is: modes without noise have singular ones."""
    zz, vv = state.zz * (1.0 + _JITTER) + _JITTER, state.vv * (1.0 + _JITTER) + _JITTER
    return State(state.z, state.v, zz, state.zv, vv, state.log_weight)


def _log_of_height(state: State, row: Tensor, z: Tensor) -> Tensor:
    """Log weight of every mode [N, C] of rows [N] by the height alone."""
    variance = state.zz + _JITTER
    return state.log_weight[row] - 0.5 * ((z[:, None] - state.z[row]) ** 2 / variance[row] + variance.log()[row])
