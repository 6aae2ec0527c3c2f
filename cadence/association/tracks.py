"""What each association hypothesis knows of its agents: a Kalman filter an agent and mode, as of the agent's last detection."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.motion import Modes, motion


@dataclass(frozen=True, eq=False)
class Tracks:
    """P particles with room for A agents in C modes; what lies behind `num_agents` is empty.

    mean        [P, A, C, 4] x, y, vx, vy after the agent's last detection
    covariance  [P, A, C, 4, 4]
    log_share   [P, A, C] log probability of the modes
    last_s      [P, A] time of the last detection
    repeats     [P, A] detections after the first, of which old ones count less
    watched_s   [P, A] time in which they came, counted alike
    num_agents  [P] agents met so far
    """

    mean: Float64s
    covariance: Float64s
    log_share: Float64s
    last_s: Float64s
    repeats: Float64s
    watched_s: Float64s
    num_agents: Int64s

    @classmethod
    def none(cls, num_modes: int) -> "Tracks":
        """One particle that has met nobody."""
        return cls(
            np.zeros((1, 0, num_modes, 4)),
            np.zeros((1, 0, num_modes, 4, 4)),
            np.zeros((1, 0, num_modes)),
            np.zeros((1, 0)),
            np.zeros((1, 0)),
            np.zeros((1, 0)),
            np.zeros(1, dtype=np.int64),
        )

    def __getitem__(self, particles: Int64s) -> "Tracks":
        """A selection of particles; repeats are allowed."""
        return Tracks(**{field.name: getattr(self, field.name)[particles] for field in dataclasses.fields(self)})

    def with_room(self, num_slots: int) -> "Tracks":
        """The same with room for so many agents at least."""
        more = num_slots - self.last_s.shape[1]
        if more <= 0:
            return self
        columns = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            columns[field.name] = value if value.ndim == 1 else np.pad(value, [(0, 0), (0, more), *[(0, 0)] * (value.ndim - 2)])
        return Tracks(**columns)


@dataclass(frozen=True, eq=False)
class Detection:
    """One detection: seconds, metres [2], covariance [2, 2]."""

    time_s: float
    position_m: Float64s
    covariance_m2: Float64s


def log_densities(tracks: Tracks, modes: Modes, seen: Detection) -> Float64s:
    """Log density of the detection under every agent [P, A], per square metre; only agents that were met have a meaning."""
    way = motion(modes, seen.time_s - tracks.last_s)
    gain = way.gain[..., None]
    offset = seen.position_m - tracks.mean[..., :2] - gain * tracks.mean[..., 2:]
    covariance = tracks.covariance
    # entries xx, xy, yy of the position's covariance at the detection's time, its own noise added
    a, b, d = (
        covariance[..., i, j]
        + way.gain * (covariance[..., i, j + 2] + covariance[..., j, i + 2])
        + way.gain**2 * covariance[..., i + 2, j + 2]
        + (way.noise_pp if i == j else 0.0)
        + seen.covariance_m2[i, j]
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    determinant = a * d - b * b
    x, y = offset[..., 0], offset[..., 1]
    distance = (d * x * x - 2.0 * b * x * y + a * y * y) / determinant
    density = tracks.log_share - 0.5 * (distance + np.log(determinant)) - math.log(2.0 * math.pi)
    peak = density.max(-1, keepdims=True)
    return np.asarray((peak + np.log(np.exp(density - peak).sum(-1, keepdims=True)))[..., 0])


def updated(tracks: Tracks, modes: Modes, seen: Detection, agent: Int64s, memory: float = 1.0) -> Tracks:
    """The particles after the detection was given to `agent` [P]: one that was met, the next new one, or -1, nobody.

    With each detection of an agent the earlier ones count `memory` times as much for how often it is detected.
    """
    tracks = tracks.with_room(int(agent.max(initial=-1)) + 1)
    out = tracks[np.arange(len(agent))]  # a copy
    is_new = agent == tracks.num_agents
    again, first = np.flatnonzero((agent >= 0) & ~is_new), np.flatnonzero(is_new)
    for rows, state in (
        (again, _kalman(tracks, modes, seen, again, agent[again])),
        (first, _first(modes, seen)),
    ):
        out.mean[rows, agent[rows]], out.covariance[rows, agent[rows]], out.log_share[rows, agent[rows]] = state
        out.last_s[rows, agent[rows]] = seen.time_s
    column = agent[again]
    out.repeats[again, column] = 1.0 + memory * tracks.repeats[again, column]
    out.watched_s[again, column] = seen.time_s - tracks.last_s[again, column] + memory * tracks.watched_s[again, column]
    out.num_agents[first] += 1
    return out


def _first(modes: Modes, seen: Detection) -> tuple[Float64s, Float64s, Float64s]:
    """State of an agent that was met just now: [C, 4], [C, 4, 4], [C]."""
    mean = np.zeros((len(modes), 4))
    mean[:, :2] = seen.position_m
    covariance = np.zeros((len(modes), 4, 4))
    covariance[:, :2, :2] = seen.covariance_m2
    covariance[:, [2, 3], [2, 3]] = modes.speed_mps[:, None] ** 2
    return mean, covariance, np.log(modes.share)


def _kalman(
    tracks: Tracks, modes: Modes, seen: Detection, rows: Int64s, columns: Int64s
) -> tuple[Float64s, Float64s, Float64s]:
    """Predicted and updated state of one known agent in each of R particles, modes mixed afterwards."""
    way = motion(modes, seen.time_s - tracks.last_s[rows, columns])
    before, spread = tracks.mean[rows, columns], tracks.covariance[rows, columns]
    gain, decay = way.gain[..., None], way.decay[..., None]
    mean = np.concatenate([before[..., :2] + gain * before[..., 2:], decay * before[..., 2:]], -1)
    pp, pv, vv = spread[..., :2, :2], spread[..., :2, 2:], spread[..., 2:, 2:]
    gain, decay = gain[..., None], decay[..., None]
    eye = np.eye(2)
    covariance = np.empty_like(spread)
    covariance[..., :2, :2] = pp + gain * (pv + pv.swapaxes(-1, -2)) + gain**2 * vv + way.noise_pp[..., None, None] * eye
    covariance[..., :2, 2:] = decay * (pv + gain * vv) + way.noise_pv[..., None, None] * eye
    covariance[..., 2:, :2] = covariance[..., :2, 2:].swapaxes(-1, -2)
    covariance[..., 2:, 2:] = decay**2 * vv + way.noise_vv[..., None, None] * eye
    cross = covariance[..., :, :2]
    innovation = cross[..., :2, :] + seen.covariance_m2
    a, b, d = innovation[..., 0, 0], innovation[..., 0, 1], innovation[..., 1, 1]
    determinant = a * d - b * b
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2) / determinant[..., None, None]
    offset = seen.position_m - mean[..., :2]
    weighed = (inverse @ offset[..., None])[..., 0]
    log_share = tracks.log_share[rows, columns] - 0.5 * ((offset * weighed).sum(-1) + np.log(determinant))
    share = np.exp(log_share - log_share.max(-1, keepdims=True))
    mean = mean + (cross @ weighed[..., None])[..., 0]
    covariance = covariance - cross @ inverse @ cross.swapaxes(-1, -2)
    return _mixed(mean, 0.5 * (covariance + covariance.swapaxes(-1, -2)), share / share.sum(-1, keepdims=True), modes)


def _mixed(mean: Float64s, covariance: Float64s, share: Float64s, modes: Modes) -> tuple[Float64s, Float64s, Float64s]:
    """States after the agent may have taken up another mode (interacting multiple models, Blom and Bar-Shalom 1988)."""
    overall = (share[..., None] * mean).sum(-2, keepdims=True)
    apart = mean - overall
    total = (share[..., None, None] * (covariance + _outer(apart))).sum(-3, keepdims=True)
    mixed_share = (1.0 - modes.switch_share) * share + modes.switch_share * modes.share
    comes = modes.switch_share * modes.share / mixed_share
    stays = 1.0 - comes
    mixed = stays[..., None] * mean + comes[..., None] * overall
    spread = covariance + _outer(mean - mixed)
    other = total + _outer(overall - mixed)
    return mixed, stays[..., None, None] * spread + comes[..., None, None] * other, np.log(mixed_share)


def _outer(vector: Float64s) -> Float64s:
    return vector[..., :, None] * vector[..., None, :]
