"""Single motion models fitted to a log by the likelihood of its detections: the classical rivals, and members of the bank."""

import torch
from torch import Tensor

from cadence.bank.components import MotionModels, constant_velocity, ornstein_uhlenbeck
from cadence.bank.smoother import Nodes, filter_forward

DIFFUSE_STEPS = 300.0
"""Standard deviation, in step lengths, of the position where a track starts, before its first detection is seen."""
FLOOR_STEPS = 1e-3
"""No detection counts as more exact than this share of a step length."""

_MAX_PAIRS = 4096


def log_likelihood(models: MotionModels, rows: Nodes, step_s: float, speed_mps: float) -> Tensor:
    """Log likelihood [R, C] of each row's detections under each model (models in units of steps and step lengths)."""
    num_rows, num_models = len(rows.time_s), len(models)
    length_m = speed_mps * step_s
    scaled = models.scaled(step_s, speed_mps)
    nodes = with_floor(rows, FLOOR_STEPS * length_m)
    out = torch.empty(num_rows, num_models, dtype=torch.float64)
    chunk = max(1, _MAX_PAIRS // num_models)
    for begin in range(0, num_rows, chunk):
        index = torch.arange(begin, min(begin + chunk, num_rows))
        pair_row, pair_model = index.repeat_interleave(num_models), torch.arange(num_models).repeat(len(index))
        diffuse = torch.full((len(pair_row),), DIFFUSE_STEPS * length_m, dtype=torch.float64)
        filtered = filter_forward(scaled[pair_model], nodes[pair_row], diffuse)
        out[index] = filtered.log_likelihood.view(len(index), num_models)
    return out


def with_floor(rows: Nodes, floor_m: float) -> Nodes:
    """The same detections, none more exact than `floor_m` an axis."""
    floor = floor_m**2 * torch.eye(2, dtype=torch.float64)
    return Nodes(rows.time_s, rows.position_m, rows.covariance_m2 + floor, rows.is_observed)


def fit_ornstein_uhlenbeck(rows: Nodes, step_s: float, speed_mps: float, num_grids: int = 2) -> MotionModels:
    """The integrated Ornstein-Uhlenbeck model [1] of greatest likelihood over all rows, by a search on nested grids."""
    times, speeds = _geometric(0.2, 300.0, 10), _geometric(0.02, 8.0, 10)
    for _ in range(num_grids):
        grid = ornstein_uhlenbeck(times, speeds, [0.0])
        best = int(log_likelihood(grid, rows, step_s, speed_mps).sum(0).argmax())
        row, column = divmod(best, len(speeds))
        times, speeds = _around(times, row), _around(speeds, column)
    return grid[torch.tensor([best])]


def fit_constant_velocity(rows: Nodes, step_s: float, speed_mps: float, num_grids: int = 2) -> MotionModels:
    """The constant-velocity model [1] of greatest likelihood over all rows, by a search on nested grids."""
    diffusion = _geometric(1e-6, 10.0, 15)
    for _ in range(num_grids):
        grid = constant_velocity(diffusion)
        best = int(log_likelihood(grid, rows, step_s, speed_mps).sum(0).argmax())
        diffusion = _around(diffusion, best)
    return grid[torch.tensor([best])]


def _geometric(low: float, high: float, number: int) -> list[float]:
    return torch.logspace(0.0, 1.0, number, base=high / low, dtype=torch.float64).mul(low).tolist()


def _around(values: list[float], index: int) -> list[float]:
    """Seven values between the neighbours of the best one."""
    return _geometric(values[max(index - 1, 0)], values[min(index + 1, len(values) - 1)], 7)
