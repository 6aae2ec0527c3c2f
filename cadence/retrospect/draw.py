"""Whole tracks of a mission given all detections: filters forwards over all stretches, then a joint draw backwards.

Given which model moves the target in each stretch, everything is linear and Gaussian: for each hypothesis the state at every
step is drawn given the state at the next one, and at the border of two stretches the particle of `filtering`, and with it the
model, of the earlier one given the state and the model with which the later one begins (backward simulation: Godsill, Doucet,
West, "Monte Carlo smoothing for nonlinear time series", JASA 99, 2004; for models that change, Lindsten and Schoen, "Backward
simulation methods for Monte Carlo statistical inference", Foundations and Trends in Machine Learning 6, 2013, ch. 4).
Position and velocity are the same on both sides of a border, so that tracks are unbroken; cost is linear in the length.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.mixture import merge_grid
from cadence.bank.pool import BankPool, shared_out
from cadence.bank.smoother import Backward, backward_kernel, filter_from
from cadence.retrospect.filtering import Filtered, Plan, Tracks, spread_uniform
from cadence.retrospect.timeline import Timeline
from cadence.seeds import derived_seeds

NUM_PARTICLES = 60
"""Chains of models that are followed at once for each track: so many filters run."""
_LEAST_PARTICLES = 4
"""Of a member of the pool that draws any hypothesis."""
_BELIEVED = 0.3
"""A pool's likelihood counts to this power at most where chains are weighed: no model of the bank is how a target moves, and of
a whole mission the one that is least wrong would be thought certain."""
_TRIES = 6
"""So often a stretch is drawn until it keeps the limits; what hardly ever does is mended instead."""

Keeps = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(positions [N, L, 2], steps that are asked for [N, L], their times [L]) -> which of them keep the limits [N]."""


def draw_tracks(
    pool: BankPool | Bank, tracks: Tracks, timeline: Timeline, num_hypotheses: int, keeps: Keeps | None = None
) -> Tensor:
    """Joint samples [R, K, T, 2] of whole tracks; NaN before the step at their beginning and after the step at their end.

    A track depends on its own detections and seed alone. Stretches that do not keep limits (`keeps`) are drawn anew a few
    times; what does not help is left for `limits` to mend.
    """
    members, weight = _believed(pool) if isinstance(pool, BankPool) else ((pool,), torch.ones(1).double())
    drawing = shared_out(weight, num_hypotheses)
    used = torch.unique(drawing)
    count = (NUM_PARTICLES * weight[used]).round().long().clamp_min(_LEAST_PARTICLES)
    return draw_by_members(members, used.repeat_interleave(count), tracks, timeline, drawing, keeps)


def _believed(pool: BankPool) -> tuple[tuple[Bank, ...], Tensor]:
    """The members of a pool, none believing the likelihood more than it should, and their weights."""
    members = (dataclasses.replace(member, temper=min(member.temper, _BELIEVED)) for member in pool.members)
    return tuple(members), pool.weight_past


def draw_by_members(
    members: Sequence[Bank], member: Tensor, tracks: Tracks, timeline: Timeline, drawing: Tensor, keeps: Keeps | None = None
) -> Tensor:
    """As `draw_tracks`: `member` [H] is that of each particle, `drawing` [K] the one that draws each hypothesis."""
    begin_s, end_s = timeline.step_before(tracks.begin_s), timeline.step_after(tracks.end_s)
    plan = Plan.of(members, member, dataclasses.replace(tracks, begin_s=begin_s, end_s=end_s), timeline)
    return _drawn_backwards(plan, plan.filtered(), drawing, keeps)


def _drawn_backwards(plan: Plan, found: Mapping[int, Filtered], drawing: Tensor, keeps: Keeps | None) -> Tensor:
    """Positions [R, K, T, 2] drawn from the last stretch to the first."""
    timeline, num_rows, num_hypotheses = plan.timeline, len(plan.tracks), len(drawing)
    out = torch.full((num_rows, num_hypotheses, len(timeline.time_s), 2), torch.nan, dtype=torch.float64)
    later: _Later | None = None
    for number in reversed(plan.stretches):
        pair = _chosen(plan, number, found[number], drawing, later)
        stretch = _Stretch.of(plan, number, found[number], pair)
        way_m, state = _drawn_stretch(stretch, later, num_hypotheses, keeps)
        later = _Later(state, found[number].model[pair])
        first, stop = timeline.steps(number)
        out[:, :, first:stop] = way_m[:, : stop - first].view(num_rows, num_hypotheses, stop - first, 2)
    out[~plan.is_asked[:, None].expand(out.shape[:3])] = torch.nan
    return out


@dataclass(frozen=True, eq=False)
class _Later:
    """With which states [R K, S] and models [R K] the next stretch begins."""

    state: Tensor
    model: Tensor


def _chosen(plan: Plan, number: int, found: Filtered, drawing: Tensor, later: _Later | None) -> Tensor:
    """The particle [R K] of each hypothesis in a stretch, drawn given what it does in the next one."""
    num_rows, h, k = len(plan.tracks), plan.num_particles, len(drawing)
    pair = torch.empty(num_rows, k, dtype=torch.int64)
    uniform = spread_uniform(plan.tracks.seeds, "choice", k, number)
    is_last = (plan.last.view(num_rows, h)[:, 0] <= number)[:, None, None]
    log_density = None if later is None else _Density.of(plan, found)
    for index, chains in plan.chains.items():
        own, drawn = (plan.member == index).nonzero()[:, 0], (drawing == index).nonzero()[:, 0]
        if not len(drawn):
            continue
        score = found.log_weight.view(num_rows, h)[:, None, own].expand(-1, len(drawn), -1)
        if later is not None and log_density is not None:
            state, model = later.state.view(num_rows, k, -1)[:, drawn], later.model.view(num_rows, k)[:, drawn]
            earlier = found.model.view(num_rows, h)[:, own]
            passes = chains.passes(number + 1, earlier)[:, None].expand(-1, len(drawn), -1, -1)
            passed = passes.gather(3, model[:, :, None, None].expand(-1, -1, len(own), 1))[..., 0].log()
            # where the next stretch begins is drawn, not estimated: it counts in full, whatever the likelihood does
            density = log_density.at(own, state, model)
            score = score + torch.where(is_last, 0.0, passed + density)
        edges = torch.softmax(score, dim=-1).cumsum(-1)
        at = torch.searchsorted(edges, uniform[:, drawn, None] * edges[..., -1:], right=True)[..., 0]
        pair[:, drawn] = own[at.clamp(max=len(own) - 1)] + h * torch.arange(num_rows)[:, None]
    return pair.flatten()


@dataclass(frozen=True, eq=False)
class _Density:
    """How likely states are at the end of a stretch by each of its particles [R, H, ...], and at the beginning of the next.

    model             [R, H] of the particles
    mean, whiten      [R, H, 4] of position and velocity, and inverse Cholesky factors [R, H, 4, 4] of their covariance
    log_scale         [R, H] log densities at the mean
    centre            the same of the centre given these, with its gain [R, H, 2, 4] on them; None in a bank without homes
    """

    plan: Plan
    model: Tensor
    mean: Tensor
    whiten: Tensor
    log_scale: Tensor
    centre: tuple[Tensor, Tensor, Tensor, Tensor] | None

    @staticmethod
    def of(plan: Plan, found: Filtered) -> "_Density":
        shape = len(plan.tracks), plan.num_particles
        mean, covariance = found.end
        whiten, log_scale = _whitener(covariance[:, :4, :4])
        centre = None
        if mean.shape[-1] > 4:
            at, gain, rest = _centre_law(mean, covariance)
            of_centre, centre_scale = _whitener(rest)
            centre = at.view(*shape, 2), gain.view(*shape, 2, 4), of_centre.view(*shape, 2, 2), centre_scale.view(shape)
        state, whiten = mean[:, :4].view(*shape, 4), whiten.view(*shape, 4, 4)
        return _Density(plan, found.model.view(shape), state, whiten, log_scale.view(shape), centre)

    def at(self, own: Tensor, state: Tensor, model: Tensor) -> Tensor:
        """Log densities [R, K', H'] of states [R, K', S], with which `model` [R, K'] begins, by the particles `own` [H']."""
        away = state[:, :, None, :4] - self.mean[:, None, own]
        found = self.log_scale[:, None, own] - 0.5 * ((self.whiten[:, None, own] @ away[..., None])[..., 0] ** 2).sum(-1)
        if self.centre is None:
            return found
        at, gain, whiten, log_scale = (value[:, None, own] for value in self.centre)
        off = state[:, :, None, 4:] - at - (gain @ away[..., None])[..., 0]
        kept = log_scale - 0.5 * ((whiten @ off[..., None])[..., 0] ** 2).sum(-1)
        range_m = self.plan.models.home_range[model]
        begun = -((state[..., 4:] - state[..., :2]) ** 2).sum(-1) / (2.0 * range_m**2) - 2.0 * range_m.log()
        begun = (begun - math.log(2.0 * math.pi))[:, :, None]
        has_home = self.plan.models.has_home[model][:, :, None]
        is_kept = self.model[:, None, own] == model[:, :, None]
        return found + torch.where(has_home, torch.where(is_kept, kept, begun), 0.0)


def _whitener(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse Cholesky factors [P, S, S] of covariances, and the logs of the densities [P] at their middle."""
    scale = covariance.diagonal(dim1=-2, dim2=-1)
    jitter = torch.diag_embed(1e-9 * (scale + 1e-6 * scale.amax(-1, keepdim=True)) + 1e-18)
    root = torch.linalg.cholesky(covariance + jitter)
    eye = torch.eye(covariance.shape[-1], dtype=torch.float64).expand_as(root)
    log_scale = -root.diagonal(dim1=-2, dim2=-1).log().sum(-1) - 0.5 * covariance.shape[-1] * math.log(2.0 * math.pi)
    return torch.linalg.solve_triangular(root, eye, upper=False), log_scale


def _drawn_stretch(
    stretch: "_Stretch", later: _Later | None, num_hypotheses: int, keeps: Keeps | None
) -> tuple[Tensor, Tensor]:
    """Positions [R K, L, 2] at the steps of a stretch, and the states with which it begins.

    What does not keep the limits is drawn again, from where the next stretch begins, as often as helps a few times.
    """
    every = torch.arange(len(stretch.pair))
    way_m, state = stretch.draw(every, later, stretch.numbers(num_hypotheses, 0))
    if keeps is None:
        return way_m, state
    is_asked = stretch.is_asked
    for attempt in range(1, _TRIES + 1):
        row = every // num_hypotheses
        is_wrong = ~keeps(way_m[every], is_asked[row], stretch.time_s)
        every = every[is_wrong]
        if not len(every) or attempt == _TRIES:
            break
        normal = stretch.numbers(num_hypotheses, attempt, sorted(set((every // num_hypotheses).tolist())))
        way_m[every], state[every] = stretch.draw(every, later, normal[every])
    return way_m, state


@dataclass(frozen=True, eq=False)
class _Stretch:
    """One stretch, filtered for each particle that a hypothesis has, and how its states are drawn backwards.

    particle is that of each hypothesis [R K], pair its number among those that are filtered; time_s that of the stretch's steps
    [L], the beginning of the next one included, as it belongs to both.
    """

    plan: Plan
    number: int
    particle: Tensor
    pair: Tensor
    model: Tensor
    time_s: Tensor
    step_index: Tensor
    num_own: Tensor
    backward: Backward
    covariance: Tensor

    @staticmethod
    def of(plan: Plan, number: int, found: Filtered, particle: Tensor) -> "_Stretch":
        first, stop = plan.timeline.steps(number)
        is_last = number + 1 == plan.timeline.num_stretches
        time_s = plan.timeline.time_s[first : stop + (not is_last)]
        used, pair = torch.unique(particle, return_inverse=True)
        detections = plan.detections(number)
        nodes, step_index = merge_grid(detections[used], time_s)
        filtered = filter_from(plan.models[found.model[used]], nodes, found.begin[0][used], found.begin[1][used])
        num_own = len(time_s) + detections.is_observed[:: plan.num_particles].sum(1)
        return _Stretch(
            plan, number, particle, pair, found.model[particle], time_s, step_index, num_own,
            backward_kernel(filtered), filtered.covariance[:, -1],
        )  # fmt: skip

    @property
    def is_asked(self) -> Tensor:
        """Steps [R, L] at which each track is asked for."""
        first, _ = self.plan.timeline.steps(self.number)
        return self.plan.is_asked[:, first : first + len(self.time_s)]

    def draw(self, which: Tensor, later: _Later | None, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [N, L, 2] of the hypotheses `which` [N], and states [N, S] at the first step, given how the next begins."""
        backward, pair = self.backward, self.pair[which]
        state = self._end(which, later, normal[:, -1])
        states = [state]
        for m in range(backward.gain.shape[1] - 1, -1, -1):
            kick = (backward.root[:, m][pair] @ normal[:, m, :, None])[..., 0] + backward.offset[:, m][pair]
            state = (backward.gain[:, m][pair] @ state[..., None])[..., 0] + kick
            states.append(state)
        way_m = torch.stack(states[::-1], 1)[..., :2]
        return way_m.gather(1, self.step_index[pair][..., None].expand(-1, -1, 2)), state

    def _end(self, which: Tensor, later: _Later | None, normal: Tensor) -> Tensor:
        """States [N, S] at the end: drawn where it is a track's last stretch, else what the next one begins with.

        Position and velocity are those with which the next stretch begins. The centre is as well where the model is kept; where
        another took over, it is drawn given position and velocity.
        """
        mean, plan, pair = self.backward.mean, self.plan, self.pair[which]
        fresh = mean[pair] + (self.backward.last_root[pair] @ normal[..., None])[..., 0]
        if later is None:
            return fresh
        state = later.state[which].clone()
        if state.shape[-1] > 4:
            changed = (self.model[which] != later.model[which]).nonzero()[:, 0]
            if len(changed):
                state[changed, 4:] = _centre(mean, self.covariance, pair[changed], state[changed, :4], normal[changed, 4:])
        return torch.where((plan.last[self.particle[which]] <= self.number)[:, None], fresh, state)

    def numbers(self, num_hypotheses: int, attempt: int, rows: Sequence[int] | None = None) -> Tensor:
        """Standard normal numbers [R K, M, S], of each row's own seed and for its own nodes; of `rows` only where given."""
        size, num_nodes = self.plan.models.num_states, self.backward.gain.shape[1] + 1
        num_rows = len(self.num_own)
        normal = torch.zeros(num_rows, num_hypotheses, num_nodes, size, dtype=torch.float64)
        seeds = derived_seeds(self.plan.tracks.seeds.numpy(), "stretch", self.number, attempt)
        for row in range(num_rows) if rows is None else rows:
            generator = torch.Generator().manual_seed(int(seeds[row]))
            used = int(self.num_own[row])
            drawn = torch.randn(num_hypotheses, used, size, generator=generator, dtype=torch.float64)
            normal[row, :, : used - 1] = drawn[:, :-1]
            # tracks are drawn backwards from the last node, which may be padding
            normal[row, :, -1] = drawn[:, -1]
        return normal.flatten(0, 1)


def _centre(mean: Tensor, covariance: Tensor, pair: Tensor, known: Tensor, normal: Tensor) -> Tensor:
    """Centres [N, 2] drawn given position and velocity [N, 4]; where a model has none, anything."""
    at, gain, rest = _centre_law(mean, covariance)
    value, vector = torch.linalg.eigh(rest)
    root = vector * value.clamp_min(0.0).sqrt()[:, None]
    at = at[pair] + (gain[pair] @ (known - mean[pair, :4])[..., None])[..., 0]
    drawn: Tensor = at + (root[pair] @ normal[..., None])[..., 0]
    return drawn


def _centre_law(mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean [P, 2] of the centre, its gain [P, 2, 4] on what position and velocity are off theirs, and its covariance then."""
    scale = covariance[:, :4, :4].diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    known_m2 = covariance[:, :4, :4] + 1e-12 * scale * torch.eye(4, dtype=torch.float64)
    gain = torch.linalg.solve(known_m2, covariance[:, :4, 4:]).mT
    rest = covariance[:, 4:, 4:] - gain @ covariance[:, :4, 4:]
    return mean[:, 4:], gain, 0.5 * (rest + rest.mT)
