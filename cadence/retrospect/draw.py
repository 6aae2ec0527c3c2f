"""Whole tracks of a mission given all detections: forward filter over all stretches, then a joint draw backwards.

Given which model moves the target in each stretch (`chains`), everything is linear and Gaussian, so that joint samples of the
whole track are exact and cost is linear in its length: one filter along each chain, then for each hypothesis the state at every
step given the state at the next one (Carter and Kohn, "On Gibbs sampling for state space models", Biometrika 81, 1994).
Position and velocity are the same on both sides of the border of two stretches, so that tracks are unbroken. Of the forward
pass only the moments at the borders are kept, and a stretch is filtered again when its turn comes: memory does not grow with
the filter's length.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.components import MotionModels
from cadence.bank.fitting import DIFFUSE_STEPS, FLOOR_STEPS, with_floor
from cadence.bank.mixture import merge_grid
from cadence.bank.pool import BankPool, shared_out
from cadence.bank.smoother import Backward, Nodes, backward_kernel, diffuse_start, filter_from
from cadence.retrospect.chains import drawn_chains, stretch_evidence
from cadence.retrospect.timeline import Timeline
from cadence.seeds import derived_seeds

NUM_CHAINS = 60
"""Chains of models a track: so many filters run; hypotheses share them."""
_TRIES = 6
"""So often a stretch is drawn until it keeps the limits; what hardly ever does is mended instead."""

Keeps = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(positions [N, L, 2], steps that are asked for [N, L], their times [L]) -> which of them keep the limits [N]."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """R tracks to be drawn.

    rows     detections [R, N] by time, padding last; one at least each
    begin_s  [R] from when on the track is asked for
    end_s    [R] up to when
    seeds    [R] of all random numbers of the track
    """

    rows: Nodes
    begin_s: Tensor
    end_s: Tensor
    seeds: Tensor

    def __getitem__(self, index: Tensor) -> "Tracks":
        """A selection of the tracks, no wider than it must be."""
        rows = self.rows[index]
        num = max(1, int(rows.is_observed.sum(1).max()))
        rows = Nodes(*(value[:, :num] for value in (rows.time_s, rows.position_m, rows.covariance_m2, rows.is_observed)))
        return Tracks(rows, self.begin_s[index], self.end_s[index], self.seeds[index])

    def __len__(self) -> int:
        return len(self.begin_s)


def draw_tracks(
    pool: BankPool | Bank, tracks: Tracks, timeline: Timeline, num_hypotheses: int, keeps: Keeps | None = None
) -> Tensor:
    """Joint samples [R, K, T, 2] of whole tracks; NaN before the step at their beginning and after the step at their end.

    A track depends on its own detections and seed alone. Stretches that do not keep limits (`keeps`) are drawn anew a few
    times; what does not help is left for `limits` to mend.
    """
    members, weight = (pool.members, pool.weight_past) if isinstance(pool, BankPool) else ((pool,), torch.ones(1).double())
    member = shared_out(weight, min(NUM_CHAINS, num_hypotheses))
    return draw_by_members(members, member, tracks, timeline, torch.arange(num_hypotheses) % len(member), keeps)


def draw_by_members(
    members: Sequence[Bank], member: Tensor, tracks: Tracks, timeline: Timeline, chain: Tensor, keeps: Keeps | None = None
) -> Tensor:
    """As `draw_tracks`: `member` [H] says which of the members draws each chain, `chain` [K] which chain a hypothesis has."""
    begin_s, end_s = timeline.step_before(tracks.begin_s), timeline.step_after(tracks.end_s)
    plan = _Plan.of(members, member, dataclasses.replace(tracks, begin_s=begin_s, end_s=end_s), timeline)
    return _drawn_backwards(plan, plan.borders(), chain, keeps)


@dataclass(frozen=True, eq=False)
class _Plan:
    """P pairs of a track and a chain, row by row, and what is filtered along them.

    models   of the bank in seconds and metres; model [P, J] that each chain has in each stretch
    nodes    detections of each pair [P, N], as exact as its member of the pool takes them for
    row      [P] the track; first, last [P] stretches between which it is drawn
    """

    models: MotionModels
    model: Tensor
    nodes: Nodes
    row: Tensor
    first: Tensor
    last: Tensor
    tracks: Tracks
    timeline: Timeline
    diffuse_m: float

    @staticmethod
    def of(members: Sequence[Bank], member: Tensor, tracks: Tracks, timeline: Timeline) -> "_Plan":
        num_rows, num_chains, bank = len(tracks), len(member), members[0]
        length_m = bank.length_m(timeline.step_s)
        model = torch.empty(num_rows, num_chains, timeline.num_stretches, dtype=torch.int64)
        uniform = _chain_numbers(tracks.seeds, num_chains, timeline.num_stretches)
        extra_m = torch.zeros(num_chains, dtype=torch.float64)
        evidence: dict[float, Tensor] = {}
        for index in sorted(set(member.tolist())):
            each, own = members[index], member == index
            if each.noise_steps not in evidence:
                evidence[each.noise_steps] = stretch_evidence(
                    each, with_floor(tracks.rows, each.noise_steps * length_m), timeline
                )
            model[:, own] = drawn_chains(each, evidence[each.noise_steps], timeline, uniform[:, own])
            extra_m[own] = (each.noise_steps**2 + FLOOR_STEPS**2) ** 0.5 * length_m
        row = torch.arange(num_rows).repeat_interleave(num_chains)
        rows = tracks.rows[row]
        floor = extra_m.repeat(num_rows)[:, None, None, None] ** 2 * torch.eye(2, dtype=torch.float64)
        nodes = dataclasses.replace(rows, covariance_m2=rows.covariance_m2 + floor)
        first, last = timeline.stretch_of(tracks.begin_s)[row], timeline.stretch_of(tracks.end_s)[row]
        models = bank.models.scaled(timeline.step_s, length_m / timeline.step_s)
        return _Plan(models, model.flatten(0, 1), nodes, row, first, last, tracks, timeline, DIFFUSE_STEPS * length_m)

    @property
    def num_chains(self) -> int:
        """Chains a track."""
        return len(self.row) // len(self.tracks)

    @property
    def is_asked(self) -> Tensor:
        """Steps [R, T] at which each track is asked for."""
        time_s, tracks = self.timeline.time_s, self.tracks
        return (time_s >= tracks.begin_s[:, None]) & (time_s <= tracks.end_s[:, None])

    @functools.cached_property
    def _stretch_of(self) -> Tensor:
        """The stretch of every detection [R, N]; padding lies behind the last one."""
        own = self.tracks.rows
        return torch.where(own.is_observed, self.timeline.stretch_of(own.time_s), self.timeline.num_stretches)

    def detections(self, stretch: int) -> Nodes:
        """Detections [P, N'] of a stretch, padded behind; at least one column."""
        number = self._stretch_of
        begin, end = (torch.searchsorted(number, torch.full((len(number), 1), at))[:, 0] for at in (stretch, stretch + 1))
        place = begin[:, None] + torch.arange(max(1, int((end - begin).max())))
        is_observed = place < end[:, None]
        pair = torch.arange(len(self.row))[:, None], place.clamp(max=number.shape[1] - 1)[self.row]
        nodes = self.nodes
        return Nodes(nodes.time_s[pair], nodes.position_m[pair], nodes.covariance_m2[pair], is_observed[self.row])

    def start(self, stretch: int, before: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """Moments at the beginning of a stretch: where it begins a track diffuse ones, else those `before` its border."""
        models = self.models[self.model[:, stretch]]
        sigma_m = torch.full((len(self.row),), self.diffuse_m, dtype=torch.float64)
        mean, covariance = diffuse_start(models, self.nodes.position_m[:, 0], sigma_m)  # about the track's first detection
        if before is None:
            return mean, covariance
        has_begun = self.first < stretch
        entered = _entered(models, self.model[:, stretch] == self.model[:, stretch - 1], *before)
        return (
            torch.where(has_begun[:, None], entered[0], mean),
            torch.where(has_begun[:, None, None], entered[1], covariance),
        )

    @property
    def stretches(self) -> range:
        """Those in which any track is drawn."""
        return range(int(self.first.min()), int(self.last.max()) + 1)

    def borders(self) -> dict[int, tuple[Tensor, Tensor]]:
        """Moments of every pair at the beginning of each stretch."""
        found: dict[int, tuple[Tensor, Tensor]] = {}
        before = None
        for stretch in self.stretches:
            found[stretch] = self.start(stretch, before)
            if stretch + 1 in self.stretches:
                ends = torch.stack([self.timeline.begin_s[stretch], self.timeline.begin_s[stretch + 1]])
                nodes, _ = merge_grid(self.detections(stretch), ends)
                filtered = filter_from(self.models[self.model[:, stretch]], nodes, *found[stretch])
                before = filtered.mean[:, -1], filtered.covariance[:, -1]
        return found


def _entered(models: MotionModels, is_kept: Tensor, mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Moments [P, S(, S)] after models took over at a border: a target that begins to stay about a place does so here."""
    size = models.num_states
    if size == 4:
        return mean, covariance
    home = models.has_home.double()
    matrix = torch.zeros(len(mean), size, size, dtype=torch.float64)
    matrix[:, range(4), range(4)] = 1.0
    noise = torch.zeros_like(matrix)
    for axis in (0, 1):
        matrix[:, axis + 4, axis] = home
        noise[:, axis + 4, axis + 4] = torch.where(models.has_home, models.home_range, 0.0) ** 2
    new_mean = (matrix @ mean[..., None])[..., 0]
    new_covariance = matrix @ covariance @ matrix.mT + noise
    return torch.where(is_kept[:, None], mean, new_mean), torch.where(is_kept[:, None, None], covariance, new_covariance)


def _drawn_backwards(plan: _Plan, borders: Mapping[int, tuple[Tensor, Tensor]], chain: Tensor, keeps: Keeps | None) -> Tensor:
    """Positions [R, K, T, 2] drawn from the last stretch to the first; `chain` [K] of each hypothesis."""
    timeline, num_rows, num_hypotheses = plan.timeline, len(plan.tracks), len(chain)
    out = torch.full((num_rows, num_hypotheses, len(timeline.time_s), 2), torch.nan, dtype=torch.float64)
    pair = (torch.arange(num_rows)[:, None] * plan.num_chains + chain).flatten()
    later: Tensor | None = None
    for number in reversed(plan.stretches):
        stretch = _Stretch.of(plan, number, borders[number])
        way_m, later = _drawn_stretch(stretch, pair, later, num_hypotheses, keeps)
        first, stop = timeline.steps(number)
        out[:, :, first:stop] = way_m[:, : stop - first].view(num_rows, num_hypotheses, stop - first, 2)
    out[~plan.is_asked[:, None].expand(out.shape[:3])] = torch.nan
    return out


def _drawn_stretch(
    stretch: "_Stretch", pair: Tensor, later: Tensor | None, num_hypotheses: int, keeps: Keeps | None
) -> tuple[Tensor, Tensor]:
    """Positions [R K, L, 2] at the steps of a stretch, and the states with which it begins.

    What does not keep the limits is drawn again, from where the next stretch begins, as often as helps a few times.
    """
    every = torch.arange(len(pair))
    way_m, state = stretch.draw(pair, later, stretch.numbers(num_hypotheses, 0))
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
        way_m[every], state[every] = stretch.draw(pair[every], None if later is None else later[every], normal[every])
    return way_m, state


@dataclass(frozen=True, eq=False)
class _Stretch:
    """One stretch, filtered for every pair, and how its states are drawn backwards.

    time_s is that of its steps [L], the beginning of the next one included, as it belongs to both.
    """

    plan: _Plan
    number: int
    time_s: Tensor
    step_index: Tensor
    num_own: Tensor
    backward: Backward
    covariance: Tensor

    @staticmethod
    def of(plan: _Plan, number: int, border: tuple[Tensor, Tensor]) -> "_Stretch":
        first, stop = plan.timeline.steps(number)
        is_last = number + 1 == plan.timeline.num_stretches
        time_s = plan.timeline.time_s[first : stop + (not is_last)]
        detections = plan.detections(number)
        nodes, step_index = merge_grid(detections, time_s)
        filtered = filter_from(plan.models[plan.model[:, number]], nodes, *border)
        num_own = len(time_s) + detections.is_observed[:: plan.num_chains].sum(1)
        return _Stretch(plan, number, time_s, step_index, num_own, backward_kernel(filtered), filtered.covariance[:, -1])

    @property
    def is_asked(self) -> Tensor:
        """Steps [R, L] at which each track is asked for."""
        first, _ = self.plan.timeline.steps(self.number)
        return self.plan.is_asked[:, first : first + len(self.time_s)]

    def draw(self, pair: Tensor, later: Tensor | None, normal: Tensor) -> tuple[Tensor, Tensor]:
        """Positions [N, L, 2] of N draws, and states [N, S] at the first step, given those with which the next one begins."""
        backward = self.backward
        state = self._end(pair, later, normal[:, -1])
        states = [state]
        for m in range(backward.gain.shape[1] - 1, -1, -1):
            kick = (backward.root[:, m][pair] @ normal[:, m, :, None])[..., 0] + backward.offset[:, m][pair]
            state = (backward.gain[:, m][pair] @ state[..., None])[..., 0] + kick
            states.append(state)
        way_m = torch.stack(states[::-1], 1)[..., :2]
        return way_m.gather(1, self.step_index[pair][..., None].expand(-1, -1, 2)), state

    def _end(self, pair: Tensor, later: Tensor | None, normal: Tensor) -> Tensor:
        """States [N, S] at the end: drawn where it is a track's last stretch, else what the next one begins with.

        Position and velocity are those with which the next stretch begins. The centre is as well where the model is kept; where
        another took over, it is drawn given position and velocity.
        """
        mean, plan = self.backward.mean, self.plan
        fresh = mean[pair] + (self.backward.last_root[pair] @ normal[..., None])[..., 0]
        if later is None or self.number + 1 == plan.timeline.num_stretches:
            return fresh
        state = later.clone()
        if later.shape[-1] > 4:
            changed = (plan.model[:, self.number] != plan.model[:, self.number + 1])[pair].nonzero()[:, 0]
            if len(changed):
                state[changed, 4:] = _centre(mean, self.covariance, pair[changed], later[changed, :4], normal[changed, 4:])
        return torch.where((plan.last <= self.number)[pair, None], fresh, state)

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
    scale = covariance[:, :4, :4].diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    known_m2 = covariance[:, :4, :4] + 1e-12 * scale * torch.eye(4, dtype=torch.float64)
    gain = torch.linalg.solve(known_m2, covariance[:, :4, 4:]).mT
    rest = covariance[:, 4:, 4:] - gain @ covariance[:, :4, 4:]
    value, vector = torch.linalg.eigh(0.5 * (rest + rest.mT))
    root = vector * value.clamp_min(0.0).sqrt()[:, None]
    at = mean[pair, 4:] + (gain[pair] @ (known - mean[pair, :4])[..., None])[..., 0]
    drawn: Tensor = at + (root[pair] @ normal[..., None])[..., 0]
    return drawn


def _chain_numbers(seeds: Tensor, num_chains: int, num_stretches: int) -> Tensor:
    """Uniform numbers [R, H, J], of each stretch evenly spread over the chains."""
    rows = []
    for seed in seeds.tolist():
        generator = torch.Generator().manual_seed(seed)
        order = torch.rand(num_chains, num_stretches, generator=generator, dtype=torch.float64).argsort(0)
        shift = torch.rand(1, num_stretches, generator=generator, dtype=torch.float64)
        rows.append((order.double() + shift) / num_chains)
    return torch.stack(rows)
