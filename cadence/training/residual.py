"""The loss of the residual model: v-prediction between the true residual and a sample of the bank."""

import math

import torch
from torch import Tensor, nn

from cadence.network.residual import ResidualNetwork
from cadence.network.residual_context import RESIDUAL_CLAMP, ResidualContext, rotate
from cadence.schedule import MAX_ANGLE, target_of
from cadence.training.synthetic import ResidualWindows


def residual_loss(network: nn.Module, windows: ResidualWindows, generator: torch.Generator) -> Tensor:
    """Mean square error of the velocity at a random noise level for each window, mirrored and turned at random.

    An untrained network (zero) scores the mean square of the velocity itself, about one where the bank is calibrated.
    """
    if not isinstance(network, ResidualNetwork):
        raise TypeError(f"residual_loss: got a {type(network).__name__}, this is the loss of a ResidualNetwork")
    num_rows, num_samples = windows.sample.shape[:2]
    pick = torch.randint(num_samples, (num_rows,), generator=generator)
    angle = torch.rand(num_rows, generator=generator) * MAX_ANGLE
    turn = torch.rand(num_rows, generator=generator) * 2.0 * math.pi
    mirror = torch.where(torch.rand(num_rows, generator=generator) < 0.5, -1.0, 1.0)
    clean = _turned(windows.residual.clamp(-RESIDUAL_CLAMP, RESIDUAL_CLAMP), turn, mirror)
    noise = _turned(windows.sample[torch.arange(num_rows), pick], turn, mirror)
    context = _mirrored(windows.context, mirror).rotated(turn)
    level = angle[:, None, None]
    noisy = torch.cos(level) * clean + torch.sin(level) * noise
    answer = network(noisy, angle, context, network.encode(context))
    error: Tensor = answer.float() - target_of("v", clean, noise, level)
    return (error**2).mean()


def _turned(vectors: Tensor, turn: Tensor, mirror: Tensor) -> Tensor:
    return rotate(_flip(vectors, mirror), turn)


def _flip(vectors: Tensor, mirror: Tensor) -> Tensor:
    sign = torch.stack([torch.ones_like(mirror), mirror], dim=-1)
    return vectors * sign[:, None]


def _mirrored(context: ResidualContext, mirror: Tensor) -> ResidualContext:
    d = context.detections
    detections = torch.cat([d[..., :1], _flip(d[..., 1:3], mirror), d[..., 3:]], dim=-1)
    return ResidualContext(
        _flip(context.mean, mirror),
        context.sigma,
        context.since,
        context.until,
        context.is_future,
        detections,
        context.is_observed,
    )
