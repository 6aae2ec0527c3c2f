"""A particle filter with a target that keeps its speed and heading, and now and then changes one of them.

Sequential importance resampling (Gordon, Salmond and Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation", IEE Proceedings F 140, 1993). Detections are far more exact than particles are dense, so that the likelihood is
smoothed by a kernel and the particles are moved within it (regularised particle filter: Musso, Oudjane and Le Gland in
"Sequential Monte Carlo Methods in Practice", 2001). Headings are roughened as in the first paper.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import ndtri

from cadence.arrays import Float64s, Int64s
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.recordings import Recordings
from cadence.resampling import systematic
from cadence.types import Detections, HypothesisSet, WindowBatch

_BLOCK = 8
"""Steps over which speed and heading are measured: paths on a grid waver from step to step."""
_LAGS = (1, 2, 4, 8, 16, 32)
_NUM_SPEEDS = 64
_NUM_SPEED_RATES = 60


@dataclass(frozen=True, eq=False)
class RandomTurn:
    """How a target moves: straight, with a drift of the heading, sudden turns, sudden changes of speed, and an end.

    step_s         seconds of a step
    speed_m        [Q] equally likely speeds, metres a step, rising; stops are among them
    speed_rate     probability a step that a new speed is drawn
    turn_rate      probability a step of a turn
    turn_sigma     standard deviation of a turn, radians
    drift_sigma    standard deviation of the heading's change in a step without a turn, radians
    end_rate       probability a step that the target arrives, and stays
    """

    step_s: float
    speed_m: Float64s
    speed_rate: float
    turn_rate: float
    turn_sigma: float
    drift_sigma: float
    end_rate: float

    def __post_init__(self) -> None:
        rates = (self.speed_rate, self.turn_rate, self.end_rate)
        if self.speed_m.ndim != 1 or not len(self.speed_m) or min(rates) < 0 or self.speed_rate + self.turn_rate > 1:
            raise ValueError("RandomTurn: speeds [Q], and rates that are probabilities, are needed")

    @staticmethod
    def fitted(recordings: Recordings) -> "RandomTurn":
        """The motion whose moments over blocks of steps are those of the recorded tracks.

        Speeds are the quantiles of the blocks' speeds, their rate of change comes from their autocorrelation, and turns and
        drift from the mean cosines of the heading's change and of its double at growing lags. With a Poisson process of
        normal turns and white drift these fall exponentially, times a constant for the waver of the blocks.
        """
        velocity, episode = _blocks(recordings)
        speed = np.abs(velocity)
        if not (speed > 0).any():
            raise ValueError("RandomTurn: nothing moves in the recordings, or no episode has two blocks of steps")
        middle = (np.arange(_NUM_SPEEDS) + 0.5) / _NUM_SPEEDS
        turn_rate, turn_sigma, drift_sigma = _fit_turns(velocity, episode)
        return RandomTurn(
            step_s=recordings.step_s,
            speed_m=np.quantile(speed, middle),
            speed_rate=_fit_speed_rate(speed, episode),
            turn_rate=turn_rate,
            turn_sigma=turn_sigma,
            drift_sigma=drift_sigma,
            end_rate=len(recordings) / len(recordings.position_m),
        )

    @property
    def length_m(self) -> float:
        """Root mean square way of a step, metres."""
        return float(np.sqrt(np.square(self.speed_m).mean()))

    def run(self, state: "_Particles", num_steps: int, rng: np.random.Generator) -> tuple[Float64s, "_Particles"]:
        """Places [T, P, 2] of P particles after 1 ... `num_steps` steps, and their states after the last."""
        number = len(state.heading)
        chance = rng.random((num_steps, number))
        is_turn, is_change = chance < self.turn_rate, chance >= 1.0 - self.speed_rate
        turn = np.zeros_like(chance)
        # what is left of the number that decided is uniform again, so that one number a step will do
        turn[is_turn] = self.turn_sigma * ndtri(chance[is_turn] / self.turn_rate)
        heading = state.heading + np.cumsum(turn + self.drift_sigma * rng.standard_normal(chance.shape), axis=0)
        speed = np.concatenate([state.speed_m[None], np.zeros_like(chance)])
        share = (chance[is_change] - (1.0 - self.speed_rate)) / max(self.speed_rate, 1e-12)
        speed[1:][is_change] = self.speed_m[np.minimum((share * len(self.speed_m)).astype(int), len(self.speed_m) - 1)]
        last = np.concatenate([np.zeros((1, number), dtype=np.int64), is_change * np.arange(1, num_steps + 1)[:, None]])
        speed = np.take_along_axis(speed, np.maximum.accumulate(last, axis=0), axis=0)[1:]
        move = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        place = state.place_m + np.cumsum(move, axis=0)
        return place, _Particles(place[-1], heading[-1], speed[-1])


@dataclass(frozen=True, eq=False)
class _Particles:
    """P particles: place_m [P, 2], heading [P] radians from the x axis, speed_m [P] metres a step."""

    place_m: Float64s
    heading: Float64s
    speed_m: Float64s

    def __getitem__(self, index: Int64s) -> "_Particles":
        return _Particles(self.place_m[index], self.heading[index], self.speed_m[index])


@dataclass(frozen=True, eq=False)
class ParticleFilter:
    """The filter as an `Estimator`; forecasts run on from the particles, without any detection after the origin.

    motion            how the target moves
    num_particles     particles while filtering
    num_detections    of a window, the last so many are filtered ...
    memory            ... if they lie at most so many steps before the last one
    kernel            standard deviation of the kernel around particles, in step lengths
    kernel_per_step   its growth for every step since the detection before: rare detections meet few particles
    roughening        standard deviation of the noise on headings after resampling, radians
    """

    motion: RandomTurn
    num_particles: int = 500
    num_detections: int = 32
    memory: int = 120
    kernel: float = 1.0
    kernel_per_step: float = 0.1
    roughening: float = 0.05
    name: str = "particle"

    def __post_init__(self) -> None:
        if min(self.num_particles, self.num_detections) < 1 or self.kernel <= 0 or self.kernel_per_step < 0:
            raise ValueError("ParticleFilter: particles, detections and kernel must be positive")

    @staticmethod
    def from_recordings(recordings: Recordings, name: str = "particle") -> "ParticleFilter":
        """The filter with the motion of the recordings (`RandomTurn.fitted`)."""
        return ParticleFilter(RandomTurn.fitted(recordings), name=name)

    def fit(self, tracks: Detections) -> Self:
        """The filter itself: its motion comes from recordings."""
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Forecasts [B, K, A, T, 2] of equal weight; deterministic in the windows' seeds, agent by agent.

        Raises ValueError for grids that begin before the origin or have another step than the recordings.
        """
        step_s = self.motion.step_s
        if windows.origin_index or abs(windows.step_s / step_s - 1.0) > 1e-6:
            raise ValueError(f"ParticleFilter: it forecasts in steps of {step_s:g} s from the origin on")
        nodes, seeds = active_rows(windows)
        sample_m = np.empty((len(seeds), num_hypotheses, windows.num_steps, 2))
        for row in range(len(seeds)):
            count = int(nodes.is_observed[row].sum())
            age = np.rint(-nodes.time_s[row, :count].numpy() / step_s).astype(np.int64)
            is_kept = (age - age[-1] <= self.memory) & (np.arange(count) >= count - self.num_detections)
            place_m, noise_m2 = nodes.position_m[row, :count].numpy(), nodes.covariance_m2[row, :count].numpy()
            rng = np.random.default_rng(int(seeds[row]))
            particles = self._filtered(age[is_kept], place_m[is_kept], noise_m2[is_kept], rng)
            chosen = particles[systematic(np.ones(self.num_particles), num_hypotheses, rng.random())]
            sample_m[row] = self._forecast(chosen, int(age[-1]), windows.num_steps, rng)
        return scatter_hypotheses(torch.from_numpy(sample_m), windows)

    def _filtered(self, age: Int64s, place_m: Float64s, noise_m2: Float64s, rng: np.random.Generator) -> _Particles:
        """Equally weighted particles at the last of the detections [N], oldest first."""
        number, motion = self.num_particles, self.motion
        root = np.linalg.cholesky(noise_m2)
        particles = _Particles(
            place_m[0] + rng.standard_normal((number, 2)) @ root[0].T,
            rng.uniform(-math.pi, math.pi, number),
            motion.speed_m[rng.integers(len(motion.speed_m), size=number)],
        )
        for i in range(1, len(age)):
            gap = int(age[i - 1] - age[i])
            if gap:
                _, particles = motion.run(particles, gap, rng)
            kernel_m = motion.length_m * (self.kernel + self.kernel_per_step * gap)
            particles = self._updated(particles, place_m[i], noise_m2[i], kernel_m, rng)
        return particles

    def _updated(
        self, particles: _Particles, place_m: Float64s, noise_m2: Float64s, kernel_m: float, rng: np.random.Generator
    ) -> _Particles:
        """Particles after a detection at place_m [2]: weighted, resampled, and moved within their kernels."""
        kernel_m2 = kernel_m**2 * np.eye(2)
        inverse = np.linalg.inv(kernel_m2 + noise_m2)
        offset = place_m - particles.place_m
        log_weight = -0.5 * np.einsum("pi,ij,pj->p", offset, inverse, offset)
        chosen = systematic(np.exp(log_weight - log_weight.max()), len(offset), rng.random())
        gain = kernel_m2 @ inverse
        root = np.linalg.cholesky(gain @ noise_m2 + 1e-12 * np.eye(2))
        moved = particles.place_m[chosen] + offset[chosen] @ gain.T + rng.standard_normal(offset.shape) @ root.T
        heading = particles.heading[chosen] + self.roughening * rng.standard_normal(len(chosen))
        return _Particles(moved, heading, particles.speed_m[chosen])

    def _forecast(self, particles: _Particles, age: int, num_steps: int, rng: np.random.Generator) -> Float64s:
        """Places [K, T, 2] from `age` steps after the particles on. The target has not arrived before the origin."""
        place, _ = self.motion.run(particles, age + num_steps - 1, rng)
        place = np.concatenate([particles.place_m[None], place])[age:]
        end = rng.geometric(self.motion.end_rate, len(particles.heading)) if self.motion.end_rate > 0 else num_steps
        index = np.minimum(np.arange(num_steps)[:, None], end)
        return np.take_along_axis(place, index[..., None], axis=0).transpose(1, 0, 2)


def _blocks(recordings: Recordings) -> tuple[NDArray[np.complex128], Int64s]:
    """Mean velocities of all whole blocks of steps as complex numbers [N], metres a step, and their episodes [N]."""
    num_blocks = (recordings.length - 1) // _BLOCK
    episode = np.repeat(np.arange(len(num_blocks)), num_blocks)
    first = np.concatenate([[0], np.cumsum(num_blocks)])[:-1]
    begin = recordings.offset[episode] + _BLOCK * (np.arange(len(episode)) - first[episode])
    move = (recordings.position_m[begin + _BLOCK].astype(np.float64) - recordings.position_m[begin]) / _BLOCK
    return move[:, 0] + 1j * move[:, 1], episode


def _fit_speed_rate(speed: Float64s, episode: Int64s) -> float:
    """Rate of a new speed a step: least squares of the autocorrelation with waver exp(-rate lag)."""
    variance = speed.var()
    lags = [lag for lag in _LAGS if (episode[lag:] == episode[:-lag]).any()]
    if variance < 1e-12 * np.square(speed).mean() or not lags:
        return 0.0
    found = []
    for lag in lags:
        is_pair = episode[lag:] == episode[:-lag]
        centred = (speed[lag:] - speed.mean()) * (speed[:-lag] - speed.mean())
        found.append(centred[is_pair].mean() / variance)
    correlation = np.array(found)
    rates = np.geomspace(1e-4, 0.5, _NUM_SPEED_RATES)
    shape = np.exp(-rates[:, None] * _BLOCK * np.array(lags))
    share = np.clip((shape * correlation).sum(axis=1) / np.square(shape).sum(axis=1), 0.0, 1.0)
    return float(rates[np.square(share[:, None] * shape - correlation).sum(axis=1).argmin()])


def _fit_turns(velocity: NDArray[np.complex128], episode: Int64s) -> tuple[float, float, float]:
    """Rate of turns a step, their standard deviation and that of the drift in a step."""
    speed = np.abs(velocity)
    # the heading of a target that hardly moves is noise
    is_moving = speed > 0.5 * np.median(speed[speed > 0])
    direction = velocity / np.maximum(speed, 1e-12)
    lags, cosines = [], []
    for lag in _LAGS:
        is_pair = (episode[lag:] == episode[:-lag]) & is_moving[lag:] & is_moving[:-lag]
        if is_pair.any():
            change = (direction[lag:] * direction[:-lag].conj())[is_pair]
            lags.append(lag * _BLOCK)
            cosines.append([change.real.mean(), np.square(change).real.mean()])
    if not lags:
        return 0.0, 1.0, 0.0
    lag_steps, order = np.array(lags)[:, None], np.array([1.0, 4.0])

    def cost(parameters: Float64s) -> float:
        rate, turn, drift, waver = np.exp(np.clip(parameters, -12.0, [-1.0, 1.2, 0.0, 0.0]))
        decay = rate * (1.0 - np.exp(-0.5 * order * turn**2)) + 0.5 * order * drift**2
        return float(np.square(np.exp(-lag_steps * decay - order * waver**2) - np.array(cosines)).sum())

    starts = [np.log([rate, 0.8, drift, 0.2]) for rate in (0.003, 0.03) for drift in (0.003, 0.03)]
    found = [minimize(cost, start, method="Nelder-Mead", options={"maxiter": 2000, "fatol": 1e-10}) for start in starts]
    best = np.exp(np.clip(min(found, key=lambda result: float(result.fun)).x, -12.0, [-1.0, 1.2, 0.0, 0.0]))
    return float(best[0]), float(best[1]), float(best[2])
