"""Any estimator, and beside it the posterior of the bank for agents of whom bearings and ranges tell more than positions.

Drawing and weighing ends where measurements are sharp: no draw of a prior fits thirty bearings. There, and where an agent has
no position at all, joint samples come from the bank's steady models, given positions and measurements together.

Calibrated where the geometry tells the range: of 60 targets drawn from the sampler's own prior (steady models, 30 bearings of
1.5 degrees, no position) 53 are drawn where one observer turns once, and the 90 % region holds 85, 86 and 89 % of them at the
first, middle and last bearing; with two observers 53 and 85, 87 and 91 %. With one that stands still 46, and 72, 76 and 80 %:
believed too much (`python -m benchmarks.bearings`).
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Bools
from cadence.bank.bank import Bank
from cadence.bank.components import MotionModels
from cadence.bank.fitting import DIFFUSE_STEPS
from cadence.bank.rows import active_rows
from cadence.bank.smoother import Nodes
from cadence.bank.switching import SwitchingModels, continue_samples, durations_after
from cadence.bearings.cells import Prior
from cadence.bearings.draws import Cloud, Known, posterior
from cadence.bearings.linear import sights_of
from cadence.constraints.agility import Agility
from cadence.constraints.checker import segments_in_collision
from cadence.evidence.estimator import FEW_FIT, FEWEST
from cadence.evidence.measurements import Measurements
from cadence.evidence.weights import hear
from cadence.resampling import effective_number, systematic
from cadence.seeds import numpy_stream
from cadence.types import Context, Detections, Estimator, HypothesisSet, WindowBatch

MEASURED = "measured"
"""Status: no position is known, the tracks rest on bearings or ranges alone."""

_MOST_FORGOTTEN = 0.1
"""Per step: tracks that forget their velocity faster may be at too many ranges on every bearing."""
_LEAST_WEIGHT, _MOST_MODELS = 0.01, 24
_MOST_MEASUREMENTS = 400
_MOST_SUPPOSED = 12
"""Tracks of the estimator about which measurements are made linear where positions are known."""
LEAST_SHARE = 0.05
"""Of the samples that must count. Below it the 90 % region holds too little (`benchmarks.bearings`)."""
_NEAREST, _FARTHEST = 0.005, 3.0
_ENOUGH = 0.5
"""Of the weighed hypotheses: where fewer count the bank draws."""


@dataclass(frozen=True, eq=False)
class WithBearings:
    """An estimator, whose agents are drawn by the bank where its own draws do not reach what was measured of them.

    estimator  draws all else, weighed by evidence already (`cadence.evidence.estimator.WithEvidence`)
    bank       fitted to the log
    reach_m    the first place of an agent without positions is normal about the first observer with this deviation an axis;
               300 step lengths of the bank where None
    num_drawn  samples that are weighed
    limits     what these keep, beside the obstacles of the context and `margin_m` from them; None: they keep nothing
    """

    estimator: Estimator
    bank: Bank
    reach_m: float | None = None
    num_drawn: int = 2000
    limits: Agility | None = None
    margin_m: float = 0.0

    @property
    def name(self) -> str:
        """That of the estimator."""
        return self.estimator.name

    def fit(self, tracks: Detections) -> Self:
        """With estimator and bank fitted."""
        return dataclasses.replace(self, estimator=self.estimator.fit(tracks), bank=self.bank.fit(tracks))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint hypotheses; without measurements those of the estimator, untouched.

        The status of an agent is "measured" where it has no position, and "few_fit" where samples do not reach what was
        measured: then it keeps the tracks of the estimator, and without positions has none.
        """
        found = self.estimator.sample(windows, num_hypotheses)
        context = windows.context
        kinds = () if context is None else tuple(one for one in context.evidence if isinstance(one, Measurements))
        if context is None or not kinds or context.elapsed_s is None:
            return found
        sharp = self._sharp(windows, context, kinds, found, num_hypotheses)
        for row in sorted({row for row, _ in sharp}):
            found = self._redrawn(found, windows, row, {agent: sharp[row, agent] for at, agent in sharp if at == row})
        return found

    def _sharp(
        self, windows: WindowBatch, context: Context, kinds: tuple[Measurements, ...], found: HypothesisSet, num: int
    ) -> dict[tuple[int, int], Measurements]:
        """Windows and agents of whom measurements tell more than weighing reaches, and what they tell, as the window counts.

        Of an agent with positions that is where fewer hypotheses count than are to.
        """
        names = context.agent_ids or (None,) * windows.num_agents
        assert context.elapsed_s is not None
        sharp = {}
        for row, elapsed_s in enumerate(context.elapsed_s.double().tolist()):
            for agent, name in enumerate(names):
                is_seen = bool(windows.is_active[row, agent])
                if is_seen and (found.num_effective is None or not float(found.num_effective[row, agent]) < _ENOUGH * num):
                    continue
                for one in kinds:  # the first kind that speaks of it; logs have one
                    some = one[one.is_about(name, len(names) == 1)]
                    shifted = dataclasses.replace(
                        some, time_s=some.time_s - elapsed_s, observer_m=some.observer_m - context.datum_m[row].numpy()
                    )
                    is_in = (shifted.time_s >= float(windows.time_s[0])) & (shifted.time_s <= 0.0)
                    shifted = shifted[is_in & (np.isfinite(shifted.bearing_rad) | np.isfinite(shifted.range_m))]
                    if len(shifted):
                        sharp[row, agent] = shifted
                        break
        return sharp

    def _redrawn(self, found: HypothesisSet, windows: WindowBatch, row: int, told: dict[int, Measurements]) -> HypothesisSet:
        """The same with the agents of one window drawn by the bank; the others are weighed without what is told of these."""
        num = found.position_m.shape[1]
        part = windows[row : row + 1]
        drawn = {
            agent: self._drawn(part, agent, measurements, num, found.position_m[row, :, agent].double())
            for agent, measurements in told.items()
        }
        done = {agent: one for agent, one in drawn.items() if one is not None}
        position_m, weight = found.position_m.clone(), found.weight.clone()
        height_m = None if found.height_m is None else found.height_m.clone()
        num_effective = torch.full(windows.is_active.shape, torch.nan, dtype=torch.float64)
        num_effective = num_effective if found.num_effective is None else found.num_effective.clone()
        status = [list(words) for words in found.status]
        if done:
            others = self.estimator.sample(_without(part, tuple(done)), num)
            position_m[row], weight[row], status[row] = others.position_m[0], others.weight[0], list(others.status[0])
            num_effective[row] = torch.nan if others.num_effective is None else others.num_effective[0]
            if height_m is not None and others.height_m is not None:
                height_m[row] = others.height_m[0]
        for agent, one in drawn.items():
            is_seen = bool(windows.is_active[row, agent])
            is_few = one is None or one[1] < FEWEST * num
            status[row][agent] = FEW_FIT if is_few else ("ok" if is_seen else MEASURED)
            if one is not None:
                position_m[row, :, agent], num_effective[row, agent] = one[0].to(position_m.dtype), one[1]
        return dataclasses.replace(
            found, position_m=position_m, weight=weight, num_effective=num_effective, status=tuple(map(tuple, status)),
            height_m=height_m,
        )  # fmt: skip

    def _drawn(
        self, window: WindowBatch, agent: int, measurements: Measurements, num: int, known_m: Tensor
    ) -> tuple[Tensor, float] | None:
        """Tracks [K, T, 2] of one agent, all of the same weight, and how many count; None where too few do.

        `known_m` [K, T, 2] are those that positions alone make likely; NaN without any.
        """
        generator = numpy_stream(int(window.seeds[0]), "bearings", agent)
        cloud, track_m = self._posterior(window, agent, measurements, generator, known_m)
        weight = cloud.weight.numpy()
        rest = _without(window, (agent,))
        if rest.context is not None and rest.context.evidence:
            whole = torch.full((1, len(weight), window.num_agents, *track_m.shape[1:]), math.nan, dtype=torch.float64)
            whole[0, :, agent] = track_m
            said = hear(rest, whole).apart[0, :, agent].numpy()
            weight = weight * np.exp(said - said.max())
        weight = np.where(self._are_kept(track_m, window), weight, 0.0)
        if cloud.num_effective < LEAST_SHARE * self.num_drawn or not weight.any():
            return None
        num_effective = min(cloud.num_effective, effective_number(weight))
        index = generator.permutation(systematic(weight, num, float(generator.random())))
        return track_m[torch.from_numpy(index)], min(num_effective, float(num))

    def _are_kept(self, track_m: Tensor, window: WindowBatch) -> Bools:
        """Which tracks [D, T, 2] of one window keep all limits [D]; they are exact samples, so that none is moved."""
        if self.limits is None:
            return np.ones(len(track_m), dtype=np.bool_)
        context = window.required_context("bearings")
        are_kept = ~self.limits.exceeds(track_m)
        if context.obstacles.count:
            offset_m = context.datum_m[0]
            are_kept &= ~segments_in_collision(track_m, context.obstacles, offset_m=offset_m).any(-1)
            if self.margin_m:
                are_kept &= context.obstacles.signed_distance(track_m, offset_m=offset_m)[0].amin(-1) >= self.margin_m
        return are_kept.numpy()

    def _posterior(
        self, window: WindowBatch, agent: int, measurements: Measurements, generator: np.random.Generator, known_m: Tensor
    ) -> tuple[Cloud, Tensor]:
        """Weighted samples, and their positions at the steps [D, T, 2]."""
        if len(measurements) > _MOST_MEASUREMENTS:
            measurements = measurements[np.linspace(0, len(measurements) - 1, _MOST_MEASUREMENTS).round().astype(np.int64)]
        rows = _row_of(window, agent)
        prior, which = self._prior(window, rows, measurements)
        sights = sights_of(measurements)
        span_s = float(sights.time_s[-1] - sights.time_s[0])
        farthest_m = _FARTHEST * prior.reach_m + float(prior.models.initial_speed.max()) * span_s
        seen_s = rows.time_s[0][rows.is_observed[0]]
        last_s = torch.cat([seen_s, sights.time_s]).max()
        time_s = window.time_s.double()
        is_before = time_s <= last_s
        measured_s = torch.from_numpy(measurements.time_s.copy())
        asked_s = torch.cat([time_s[is_before], measured_s, last_s[None]])
        first = int(is_before.sum())

        def likelihood(state: Tensor) -> Tensor:
            at = state[:, first:-1].numpy()
            return torch.from_numpy(measurements.fits(at[..., :2], at[..., 2:4]).sum(axis=-1))

        supposed_m = _at_times(known_m[:_MOST_SUPPOSED], time_s, sights.time_s) if bool(known_m.isfinite().all()) else None
        known = Known(prior, rows, sights, _NEAREST * prior.reach_m, farthest_m, time_s[:1], likelihood, supposed_m)
        cloud = posterior(known, asked_s, self.num_drawn, generator)
        track_m = torch.empty(len(cloud.weight), len(time_s), 2, dtype=torch.float64)
        track_m[:, is_before] = cloud.state[:, :first, :2]
        if not bool(is_before.all()):
            model, state = torch.from_numpy(which)[cloud.model], cloud.state[:, -1]
            track_m[:, ~is_before] = self._continued(time_s[~is_before], last_s, model, state, window.step_s, generator)
        return cloud, track_m

    def _continued(
        self, time_s: Tensor, last_s: Tensor, model: Tensor, state: Tensor, step_s: float, generator: np.random.Generator
    ) -> Tensor:
        """Positions [D, T, 2] at the steps after all that is known: as the bank goes on, models may change."""
        models = self.bank.models.scaled(step_s, self.bank.length_m(step_s) / step_s)
        weight = self.bank.later_weight
        if weight is None:
            weight = torch.full((len(models),), 1.0 / len(models), dtype=torch.float64)
        switching = SwitchingModels(models, weight, self.bank.switch_rate / step_s)
        durations_s = durations_after(torch.cat([time_s[:1] - step_s, time_s]), last_s[None])[:, 1:]
        uniform = torch.from_numpy(generator.random((1, len(model), len(time_s), 2)))
        normal = torch.from_numpy(generator.standard_normal((1, len(model), len(time_s), state.shape[-1])))
        return continue_samples(switching, durations_s, model[None], state[None], uniform, normal)[0]

    def _prior(self, window: WindowBatch, rows: Nodes, measurements: Measurements) -> tuple[Prior, np.ndarray]:
        """The law of tracks by the likeliest steady models of the bank, and which those are."""
        length_m = self.bank.length_m(window.step_s)
        models, which, log_weight = steady(self.bank)
        seen = rows.is_observed[0].nonzero()[:, 0]
        begin_m = rows.position_m[0, seen[0]] if len(seen) else torch.from_numpy(measurements.observer_m[0].copy())
        reach_m = DIFFUSE_STEPS * length_m if len(seen) or self.reach_m is None else self.reach_m
        return Prior(models.scaled(window.step_s, length_m / window.step_s), log_weight, begin_m, reach_m), which


def steady(bank: Bank) -> tuple[MotionModels, np.ndarray, Tensor]:
    """The likeliest models of a bank that keep their velocity for ten steps or more, in steps and step lengths.

    Those that turn, stay about a place or wander have no say: samples do not reach all that they allow (measured).

    Returns:
        The models [C], which of the bank's they are, and their log weights.
    """
    models = bank.models
    is_steady = (models.turn_rate == 0) & ~models.has_home & (models.relaxation_rate <= _MOST_FORGOTTEN)
    log_weight = torch.zeros(len(models), dtype=torch.float64) if bank.log_weight is None else bank.log_weight
    log_weight = torch.where(is_steady, log_weight, -torch.inf)
    log_weight = torch.where(log_weight >= log_weight.max() + math.log(_LEAST_WEIGHT), log_weight, -torch.inf)
    which = log_weight.argsort(descending=True, stable=True)[:_MOST_MODELS]
    which = which[log_weight[which].isfinite()].sort().values
    return models[which], which.numpy(), log_weight[which].log_softmax(0)


def _at_times(track_m: Tensor, time_s: Tensor, asked_s: Tensor) -> Tensor:
    """Tracks [K, T, 2] at other times [M], straight between two steps [K, M, 2]."""
    right = torch.searchsorted(time_s, asked_s).clamp(1, len(time_s) - 1)
    share = ((asked_s - time_s[right - 1]) / (time_s[right] - time_s[right - 1]))[:, None]
    return track_m[:, right - 1] + share * (track_m[:, right] - track_m[:, right - 1])


def _row_of(window: WindowBatch, agent: int) -> Nodes:
    """The detections of one agent of one window as a row; a single unseen node where there are none."""
    if not bool(window.is_active[0, agent]):
        zero = torch.zeros(1, 1, dtype=torch.float64)
        return Nodes(zero, torch.zeros(1, 1, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)[None, None], zero > 0)
    rows, _ = active_rows(window)
    return rows[torch.tensor([int(window.is_active[0, :agent].sum())])]


def _without(window: WindowBatch, agents: tuple[int, ...]) -> WindowBatch:
    """The same window without what is measured of some agents."""
    context = window.required_context("bearings")
    names = context.agent_ids or (None,) * window.num_agents
    evidence = []
    for one in context.evidence:
        if isinstance(one, Measurements):
            about = np.logical_or.reduce([one.is_about(names[agent], len(names) == 1) for agent in agents])
            one = one[~about]
            if not len(one):
                continue
        evidence.append(one)
    return window.with_context(dataclasses.replace(context, evidence=tuple(evidence)))
