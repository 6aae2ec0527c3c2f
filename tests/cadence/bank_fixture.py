"""Windows and tracks of plain numbers, and the dense Gaussian that filters and smoothers must agree with."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cadence.bank.components import MotionModels, transition
from cadence.bank.smoother import Nodes
from cadence.types import Detections, WindowBatch


def turn_matrix(angle: float) -> Tensor:
    """Rotation by `angle` to the left."""
    return torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)


def random_windows(
    num_windows: int = 4,
    num_agents: int = 2,
    num_detections: int = 7,
    sigma_m: float = 0.2,
    seed: int = 0,
    history: int = 24,
    horizon: int = 12,
) -> WindowBatch:
    """Windows with step 1 s of agents that wander at about 1 m/s, the number of detections differing from row to row."""
    g = torch.Generator().manual_seed(seed)
    shape = (num_windows, num_agents, num_detections)
    time_s = -history * torch.rand(shape, generator=g, dtype=torch.float64).sort(descending=True).values
    way = torch.diff(time_s, dim=-1, prepend=time_s[..., :1])[..., None]
    position_m = (way * (0.7 * torch.randn(*shape, 2, generator=g, dtype=torch.float64) + torch.tensor([0.6, 0.2]))).cumsum(-2)
    count = torch.randint(1, num_detections + 1, shape[:2], generator=g)
    count[0, 0] = num_detections
    factor = torch.eye(2, dtype=torch.float64) + 0.4 * torch.rand(*shape, 2, 2, generator=g, dtype=torch.float64)
    observed = torch.arange(num_detections) < count[..., None]
    detections = Detections(time_s, position_m, sigma_m**2 * factor @ factor.mT, observed)
    grid = torch.arange(history + horizon, dtype=torch.float64) - (history - 1)
    return WindowBatch(grid, detections, torch.arange(num_windows) + 11, history - 1)


def as_tracks(detections: Detections) -> Detections:
    """Every agent's detections as a stretch of its own: what estimators are fitted to."""
    columns = (detections.time_s, detections.position_m, detections.covariance_m2, detections.is_observed)
    return Detections(*(value.flatten(0, 1)[:, None] for value in columns))


class Moved(NamedTuple):
    """How detections are changed: position -> scale * (matrix @ position + shift), time -> time_scale * (time + time_shift)."""

    matrix: Tensor
    shift: Tensor
    scale: float = 1.0
    time_scale: float = 1.0
    time_shift: float = 0.0

    def detections(self, d: Detections) -> Detections:
        return Detections(
            self.time_scale * (d.time_s + self.time_shift),
            self.positions(d.position_m),
            self.scale**2 * self.matrix @ d.covariance_m2 @ self.matrix.mT,
            d.is_observed,
        )

    def windows(self, w: WindowBatch) -> WindowBatch:
        return WindowBatch(self.time_scale * w.time_s, self.detections(w.detections), w.seeds, w.origin_index)

    def positions(self, position_m: Tensor) -> Tensor:
        return self.scale * (position_m @ self.matrix.mT + self.shift)


class Dense(NamedTuple):
    """The joint Gaussian of the states at all nodes of one row, before and after its detections are known."""

    log_likelihood: float
    mean: Tensor  # [M, 4]
    covariance: Tensor  # [M, 4, M, 4]


def dense_posterior(model: MotionModels, nodes: Nodes, position_sigma_m: float) -> Dense:
    """Condition the joint prior of all states of one row (model [1], nodes [1, M]) on its detections, without any recursion."""
    time_s, observed = nodes.time_s[0], nodes.is_observed[0]
    num_nodes = len(time_s)
    start = torch.diag(torch.tensor([position_sigma_m, position_sigma_m, 0.0, 0.0], dtype=torch.float64) ** 2)
    start[2, 2] = start[3, 3] = float(model.initial_speed) ** 2
    prior = torch.zeros(num_nodes, 4, num_nodes, 4, dtype=torch.float64)
    for i in range(num_nodes):
        matrix, noise = transition(model, (time_s[i] - time_s[0])[None])
        own = matrix[0] @ start @ matrix[0].mT + noise[0]
        for j in range(i, num_nodes):
            onward, _ = transition(model, (time_s[j] - time_s[i])[None])
            prior[j, :, i] = onward[0] @ own
            prior[i, :, j] = prior[j, :, i].mT
    flat = prior.reshape(4 * num_nodes, 4 * num_nodes)
    seen = observed.nonzero()[:, 0]
    read = torch.zeros(len(seen), 2, num_nodes, 4, dtype=torch.float64)
    for k, m in enumerate(seen.tolist()):
        read[k, 0, m, 0] = read[k, 1, m, 1] = 1.0
    read = read.reshape(2 * len(seen), -1)
    prior_mean = torch.zeros(num_nodes, 4, dtype=torch.float64)
    prior_mean[:, :2] = nodes.position_m[0, seen[0]]
    innovation = nodes.position_m[0, seen].flatten() - read @ prior_mean.flatten()
    total = read @ flat @ read.mT + torch.block_diag(*nodes.covariance_m2[0, seen])
    gain = torch.linalg.solve(total, read @ flat).mT
    mean = prior_mean.flatten() + gain @ innovation
    log_likelihood = -0.5 * (
        innovation @ torch.linalg.solve(total, innovation) + torch.logdet(total) + len(innovation) * math.log(2 * math.pi)
    )
    covariance = flat - gain @ read @ flat
    return Dense(float(log_likelihood), mean.view(num_nodes, 4), covariance.view(num_nodes, 4, num_nodes, 4))


def simulate(model: MotionModels, time_s: Tensor, sigma_m: float, num_tracks: int, seed: int) -> Detections:
    """Tracks of one model [1] seen at `time_s` [N] with noise `sigma_m`, as stretches [num_tracks, 1, N]."""
    g = torch.Generator().manual_seed(seed)
    state = torch.randn(num_tracks, 4, generator=g, dtype=torch.float64) * float(model.initial_speed)
    state[:, :2] = 0.0
    positions = [state[:, :2]]
    for duration in torch.diff(time_s):
        matrix, noise = transition(model, duration[None])
        kick = torch.randn(num_tracks, 4, generator=g, dtype=torch.float64) @ torch.linalg.cholesky(noise[0]).mT
        state = state @ matrix[0].mT + kick
        positions.append(state[:, :2])
    clean = torch.stack(positions, 1)
    noisy = clean + sigma_m * torch.randn(clean.shape, generator=g, dtype=torch.float64)
    shape = (num_tracks, 1, len(time_s))
    covariance = (sigma_m**2 * torch.eye(2, dtype=torch.float64)).expand(*shape, 2, 2)
    return Detections(time_s.expand(shape), noisy[:, None], covariance, torch.ones(shape, dtype=torch.bool))
