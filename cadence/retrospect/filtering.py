"""The forward half of drawing whole tracks: Kalman filters along many chains of models, each weighed by what it foresaw.

A Rao-Blackwellised particle filter (Doucet, Godsill, Andrieu, "On sequential Monte Carlo sampling methods for Bayesian
filtering", Statistics and Computing 10, 2000): a particle is a chain of models, one a stretch, along which everything is linear
and Gaussian. A gap between two detections often spans the border of stretches, and which models could have led across it only
the filter along the chain knows. Of the forward pass only the moments at the borders are kept, and a stretch is filtered again
when its turn comes: memory does not grow with the filter's length.
"""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank
from cadence.bank.components import MotionModels
from cadence.bank.fitting import DIFFUSE_STEPS, FLOOR_STEPS, with_floor
from cadence.bank.mixture import merge_grid
from cadence.bank.rows import spaced
from cadence.bank.smoother import Nodes, diffuse_start, filter_from
from cadence.resampling import effective_number, systematic
from cadence.retrospect.chains import Chains, stretch_evidence
from cadence.retrospect.timeline import Timeline
from cadence.seeds import derived_seeds

_LEAST_SHARE = 0.5
"""Particles are drawn anew where fewer than this share of them count."""

Moments = tuple[Tensor, Tensor]
"""Mean [P, S] and covariance [P, S, S]."""


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


@dataclass(frozen=True, eq=False)
class Filtered:
    """One stretch of P particles.

    model       [P] that is at work
    begin, end  moments at its first step and at that of the next stretch, what was detected before it known
    log_weight  [P] of the particles at its end, as far as the likelihood is believed
    """

    model: Tensor
    begin: Moments
    end: Moments
    log_weight: Tensor


@dataclass(frozen=True, eq=False)
class Plan:
    """P = R H particles, H a track, row by row.

    members  of the pool; member [H] says which of them each particle of a track belongs to, chains those of each used one
    models   of the bank in seconds and metres
    nodes    detections of each particle [P, N], as exact as its member takes them for
    telling  those of them that weigh particles
    row      [P] the track; first, last [P] stretches between which it is drawn
    """

    members: Sequence[Bank]
    member: Tensor
    chains: dict[int, Chains]
    models: MotionModels
    nodes: Nodes
    telling: Nodes
    row: Tensor
    first: Tensor
    last: Tensor
    tracks: Tracks
    timeline: Timeline
    diffuse_m: float

    @staticmethod
    def of(members: Sequence[Bank], member: Tensor, tracks: Tracks, timeline: Timeline) -> "Plan":
        """The plan of some tracks; their ends lie on steps."""
        num_rows, bank = len(tracks), members[0]
        length_m = bank.length_m(timeline.step_s)
        extra_m = torch.zeros(len(member), dtype=torch.float64)
        evidence: dict[tuple[float, float], Tensor] = {}
        chains = {}
        for index in sorted(set(member.tolist())):
            each = members[index]
            key = each.noise_steps, each.spacing_steps
            if key not in evidence:
                floored = with_floor(tracks.rows, each.noise_steps * length_m)
                evidence[key] = stretch_evidence(each, floored, timeline)
            chains[index] = Chains.of(each, each.temper * evidence[key], timeline)
            extra_m[member == index] = (each.noise_steps**2 + FLOOR_STEPS**2) ** 0.5 * length_m
        row = torch.arange(num_rows).repeat_interleave(len(member))
        floor = extra_m.repeat(num_rows)[:, None, None, None] ** 2 * torch.eye(2, dtype=torch.float64)
        nodes, telling = (
            dataclasses.replace(rows[row], covariance_m2=rows.covariance_m2[row] + floor)
            for rows in (tracks.rows, spaced(tracks.rows, bank.spacing_steps * timeline.step_s))
        )
        first, last = timeline.stretch_of(tracks.begin_s)[row], timeline.stretch_of(tracks.end_s)[row]
        models = bank.models.scaled(timeline.step_s, length_m / timeline.step_s)
        diffuse_m = DIFFUSE_STEPS * length_m
        return Plan(members, member, chains, models, nodes, telling, row, first, last, tracks, timeline, diffuse_m)

    @property
    def num_particles(self) -> int:
        """Particles a track."""
        return len(self.member)

    @property
    def is_asked(self) -> Tensor:
        """Steps [R, T] at which each track is asked for."""
        time_s, tracks = self.timeline.time_s, self.tracks
        return (time_s >= tracks.begin_s[:, None]) & (time_s <= tracks.end_s[:, None])

    @property
    def stretches(self) -> range:
        """Those in which any track is drawn."""
        return range(int(self.first.min()), int(self.last.max()) + 1)

    @functools.cached_property
    def temper(self) -> Tensor:
        """How much the likelihood of each particle is believed [P]."""
        of_member = torch.tensor([self.members[index].temper for index in self.member.tolist()], dtype=torch.float64)
        return of_member.repeat(len(self.tracks))

    def detections(self, stretch: int) -> Nodes:
        """Detections [P, N'] of a stretch, padded behind; at least one column."""
        return _within(self.nodes, self._stretch_of[0], self.row, stretch)

    def filtered(self) -> dict[int, Filtered]:
        """Every stretch, filtered forwards."""
        found: dict[int, Filtered] = {}
        before, known = None, None
        for stretch in self.stretches:
            model, log_weight = self._proposed(stretch, before)
            begin = self._begin(stretch, model, before, None if before is None else before.end)
            told = self._begin(stretch, model, before, known)
            end, known = begin, told
            if stretch + 1 in self.stretches:
                end, _ = self._passed(self.detections(stretch), stretch, model, begin)
            telling = _within(self.telling, self._stretch_of[1], self.row, stretch)
            known, gained = self._passed(telling, stretch, model, told)
            log_weight = log_weight + self.temper * gained
            before = Filtered(model, begin, end, log_weight)
            found[stretch] = before
            index, log_weight = self._drawn_anew(stretch, before)
            known = known[0][index], known[1][index]
            before = Filtered(model[index], begin, (end[0][index], end[1][index]), log_weight)
        return found

    def _proposed(self, stretch: int, before: Filtered | None) -> tuple[Tensor, Tensor]:
        """Models [P] of a stretch, and log weights [P] with which they begin."""
        num_rows, h = len(self.tracks), self.num_particles
        model = torch.zeros(num_rows, h, dtype=torch.int64)
        log_weight = torch.zeros(num_rows, h, dtype=torch.float64)
        uniform = spread_uniform(self.tracks.seeds, "chains", h, stretch)
        has_begun = (self.first.view(num_rows, h)[:, 0] < stretch)[:, None]
        for index, chains in self.chains.items():
            own = self.member == index
            fresh = chains.proposed(stretch, None, uniform[:, own])
            if before is not None:
                earlier = before.model.view(num_rows, h)[:, own]
                model_on, weight_on = chains.proposed(stretch, earlier, uniform[:, own])
                fresh = torch.where(has_begun, model_on, fresh[0]), torch.where(has_begun, weight_on, fresh[1])
            model[:, own], log_weight[:, own] = fresh
        if before is not None:
            log_weight = log_weight + torch.where(has_begun, before.log_weight.view(num_rows, h), 0.0)
        return model.flatten(), log_weight.flatten()

    def _begin(self, stretch: int, model: Tensor, before: Filtered | None, moments: Moments | None) -> Moments:
        """Moments at the beginning of a stretch: where it begins a track diffuse ones, else those at the end of the last."""
        models = self.models[model]
        sigma_m = torch.full((len(self.row),), self.diffuse_m, dtype=torch.float64)
        mean, covariance = diffuse_start(models, self.nodes.position_m[:, 0], sigma_m)  # about the track's first detection
        if before is None or moments is None:
            return mean, covariance
        has_begun = self.first < stretch
        entered = _entered(models, model == before.model, *moments)
        return (
            torch.where(has_begun[:, None], entered[0], mean),
            torch.where(has_begun[:, None, None], entered[1], covariance),
        )

    def _passed(self, held: Nodes, stretch: int, model: Tensor, begin: Moments) -> tuple[Moments, Tensor]:
        """Moments at the end of a stretch, and log likelihood [P] of what was detected in it."""
        steps = self.timeline.begin_s[stretch : stretch + 2]
        if len(steps) < 2:
            steps = torch.stack([steps[0], torch.maximum(self.timeline.time_s[-1], steps[0])])
        nodes, _ = merge_grid(held, steps)
        filtered = filter_from(self.models[model], nodes, *begin)
        return (filtered.mean[:, -1], filtered.covariance[:, -1]), filtered.log_likelihood

    def _drawn_anew(self, stretch: int, found: Filtered) -> tuple[Tensor, Tensor]:
        """Particles [P] that go on, and their log weights: drawn by weight where few of a member's count."""
        h = self.num_particles
        index, log_weight = torch.arange(len(self.row)), found.log_weight.clone()
        seeds = derived_seeds(self.tracks.seeds.numpy(), "particles", stretch)
        for row, seed in enumerate(seeds.tolist()):
            shifts = torch.rand(len(self.members), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            for each in self.chains:
                own = row * h + (self.member == each).nonzero()[:, 0]
                log_weight[own] -= found.log_weight[own].max()
                weight = log_weight[own].exp().numpy()
                if effective_number(weight) < _LEAST_SHARE * len(own):
                    index[own] = own[torch.from_numpy(systematic(weight, len(own), float(shifts[each])))]
                    log_weight[own] = 0.0
        return index, log_weight

    @functools.cached_property
    def _stretch_of(self) -> tuple[Tensor, Tensor]:
        """The stretch of every detection [R, N], and of every telling one; padding lies behind the last stretch."""
        own = [Nodes(*(v[:: self.num_particles] for v in vars(rows).values())) for rows in (self.nodes, self.telling)]
        nodes, telling = (
            torch.where(rows.is_observed, self.timeline.stretch_of(rows.time_s), self.timeline.num_stretches) for rows in own
        )
        return nodes.contiguous(), telling.contiguous()


def _within(rows: Nodes, number: Tensor, row: Tensor, stretch: int) -> Nodes:
    """Detections [P, N'] that lie in a stretch, by the stretches `number` [R, N] of each row's."""
    begin, end = (torch.searchsorted(number, torch.full((len(number), 1), at))[:, 0] for at in (stretch, stretch + 1))
    place = begin[:, None] + torch.arange(max(1, int((end - begin).max())))
    is_observed = place < end[:, None]
    pair = torch.arange(len(row))[:, None], place.clamp(max=number.shape[1] - 1)[row]
    return Nodes(rows.time_s[pair], rows.position_m[pair], rows.covariance_m2[pair], is_observed[row])


def _entered(models: MotionModels, is_kept: Tensor, mean: Tensor, covariance: Tensor) -> Moments:
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


def spread_uniform(seeds: Tensor, purpose: str, num: int, stretch: int) -> Tensor:
    """Uniform numbers [R, N] of a stretch for a purpose, each row's own, evenly spread in random order; seeds are [R]."""
    rows = []
    for seed in derived_seeds(seeds.numpy(), purpose, stretch).tolist():
        generator = torch.Generator().manual_seed(seed)
        order = torch.rand(num, generator=generator, dtype=torch.float64).argsort()
        rows.append((order.double() + torch.rand(1, generator=generator, dtype=torch.float64)) / num)
    return torch.stack(rows)
