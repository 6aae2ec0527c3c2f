"""What each association hypothesis knows of its agents: a Kalman filter an agent and mode, as of the agent's last detection.

Hypotheses differ in a few agents and agree on most. So a track, which is what the detections of one agent make of it, is kept
once, whoever believes in it, and is carried on once for all who give it the next detection.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from cadence.arrays import Float64s, Int64s
from cadence.association.motion import Modes, motion


@dataclass(frozen=True, eq=False)
class Tracks:
    """The agents of P particles with room for A each, as rows of R tracks in C modes, of which the first is nobody's.

    row         [P, A] track of each agent; 0 behind `num_agents`
    num_agents  [P] agents met so far
    mean        [R, C, 4] x, y, vx, vy after the last detection
    covariance  [R, C, 4, 4]
    log_share   [R, C] log probability of the modes
    last_s      [R] time of the last detection
    repeats     [R] detections after the first, of which old ones count less
    watched_s   [R] time in which they came, counted alike
    """

    row: Int64s
    num_agents: Int64s
    mean: Float64s
    covariance: Float64s
    log_share: Float64s
    last_s: Float64s
    repeats: Float64s
    watched_s: Float64s

    @classmethod
    def none(cls, num_modes: int) -> "Tracks":
        """One particle that has met nobody."""
        return cls(
            np.zeros((1, 0), dtype=np.int64),
            np.zeros(1, dtype=np.int64),
            np.zeros((1, num_modes, 4)),
            np.zeros((1, num_modes, 4, 4)),
            np.zeros((1, num_modes)),
            np.zeros(1),
            np.zeros(1),
            np.zeros(1),
        )

    def __getitem__(self, particles: Int64s) -> "Tracks":
        """A selection of particles; repeats are allowed."""
        return replace(self, row=self.row[particles], num_agents=self.num_agents[particles])


@dataclass(frozen=True, eq=False)
class Detection:
    """One detection: seconds, metres [2], covariance [2, 2]."""

    time_s: float
    position_m: Float64s
    covariance_m2: Float64s


def log_densities(tracks: Tracks, modes: Modes, seen: Detection) -> Float64s:
    """Log density of the detection under every track [R], per square metre; that of nobody has no meaning."""
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
    num_before = len(tracks.last_s)
    num_more = int(agent.max(initial=-1)) + 1 - tracks.row.shape[1]
    row = tracks.row.copy() if num_more <= 0 else np.pad(tracks.row, [(0, 0), (0, num_more)])
    is_new = agent == tracks.num_agents
    again, first = np.flatnonzero((agent >= 0) & ~is_new), np.flatnonzero(is_new)
    before, which = np.unique(row[again, agent[again]], return_inverse=True)
    row[again, agent[again]] = num_before + which
    row[first, agent[first]] = num_before + len(before)
    is_used = np.zeros(num_before, dtype=np.bool_)
    is_used[row[row < num_before]] = is_used[0] = True
    kept = np.flatnonzero(is_used)
    number = np.concatenate([np.cumsum(is_used) - 1, len(kept) + np.arange(len(before) + 1)])
    num_first = min(len(first), 1)
    states = [_kalman(tracks, modes, seen, before), tuple(value[None][:num_first] for value in _first(modes, seen))]
    repeats = 1.0 + memory * tracks.repeats[before]
    watched_s = seen.time_s - tracks.last_s[before] + memory * tracks.watched_s[before]
    mean, covariance, log_share = (
        np.concatenate([old[kept], *new])
        for old, new in zip((tracks.mean, tracks.covariance, tracks.log_share), zip(*states, strict=True), strict=True)
    )
    return Tracks(
        number[row],
        tracks.num_agents + is_new,
        mean,
        covariance,
        log_share,
        np.concatenate([tracks.last_s[kept], np.full(len(before) + num_first, seen.time_s)]),
        np.concatenate([tracks.repeats[kept], repeats, np.zeros(num_first)]),
        np.concatenate([tracks.watched_s[kept], watched_s, np.zeros(num_first)]),
    )


def _first(modes: Modes, seen: Detection) -> tuple[Float64s, Float64s, Float64s]:
    """State of an agent that was met just now: [C, 4], [C, 4, 4], [C]."""
    mean = np.zeros((len(modes), 4))
    mean[:, :2] = seen.position_m
    covariance = np.zeros((len(modes), 4, 4))
    covariance[:, :2, :2] = seen.covariance_m2
    covariance[:, [2, 3], [2, 3]] = modes.speed_mps[:, None] ** 2
    return mean, covariance, np.log(modes.share)


def _kalman(tracks: Tracks, modes: Modes, seen: Detection, rows: Int64s) -> tuple[Float64s, Float64s, Float64s]:
    """Predicted and updated state of some of the tracks, modes mixed afterwards."""
    way = motion(modes, seen.time_s - tracks.last_s[rows])
    before, spread = tracks.mean[rows], tracks.covariance[rows]
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
    offset = seen.position_m - mean[..., :2]
    x, y = offset[..., 0], offset[..., 1]
    distance = (d * x * x - 2.0 * b * x * y + a * y * y) / determinant
    log_share = tracks.log_share[rows] - 0.5 * (distance + np.log(determinant))
    share = np.exp(log_share - log_share.max(-1, keepdims=True))
    # the gain's two columns; written out, as products of small matrices take longer to begin than to compute
    by_x = (cross[..., 0] * d[..., None] - cross[..., 1] * b[..., None]) / determinant[..., None]
    by_y = (cross[..., 1] * a[..., None] - cross[..., 0] * b[..., None]) / determinant[..., None]
    mean = mean + by_x * x[..., None] + by_y * y[..., None]
    covariance = covariance - by_x[..., None] * cross[..., None, :, 0] - by_y[..., None] * cross[..., None, :, 1]
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
