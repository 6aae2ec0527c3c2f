"""The residual model's view of a window: what the bank says, in the network's units, and the features it sees.

The network models r = (position - bank mean) / bank sigma. Its starting noise is a joint sample of the bank in the same
units, so that an answer of zero gives the bank back. Everything is measured in steps and step lengths, times the log's
typical speed: nothing knows metres or seconds.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import BankPosterior
from cadence.bank.smoother import Nodes

NUM_FEATURES = 14
"""Channels per step that the network sees, the two of the noisy residual included."""
NUM_DETECTION_FEATURES = 4
MAX_DETECTIONS = 32
"""The last detections that the encoder reads (REFERENCE: the paper's number)."""
RESIDUAL_CLAMP = 8.0
"""Residuals beyond this many bank sigmas are cut off in training: they are faults of the bank, not a law to learn."""

_LENGTH = 16.0


@dataclass(frozen=True, eq=False)
class ResidualContext:
    """What the network knows of R windows, float32, in steps and step lengths about the last detection.

    mean       [R, T, 2] bank mean
    sigma      [R, T] bank sigma an axis
    since      [R, T] steps since the detection before each step (the window's length where there is none)
    until      [R, T] steps until the next detection
    is_future  [R, T] bool, after the origin
    detections [R, N, 4] age, x, y, log sigma of the last detections, oldest first
    is_observed [R, N] bool
    """

    mean: Tensor
    sigma: Tensor
    since: Tensor
    until: Tensor
    is_future: Tensor
    detections: Tensor
    is_observed: Tensor

    def __getitem__(self, rows: slice | Tensor) -> "ResidualContext":
        """A selection of windows."""
        return ResidualContext(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def to(self, device: str) -> "ResidualContext":
        """The same on another device."""
        return ResidualContext(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))

    def repeated(self, times: int) -> "ResidualContext":
        """Every window `times` times in a row: one for each hypothesis."""
        return ResidualContext(*(getattr(self, name).repeat_interleave(times, dim=0) for name in self.__dataclass_fields__))

    def rotated(self, angle: Tensor) -> "ResidualContext":
        """Every window turned by its own angle [R] (augmentation: no direction is special)."""
        detections = torch.cat(
            [self.detections[..., :1], rotate(self.detections[..., 1:3], angle), self.detections[..., 3:]], -1
        )
        return ResidualContext(
            rotate(self.mean, angle), self.sigma, self.since, self.until, self.is_future, detections, self.is_observed
        )


def rotate(vectors: Tensor, angle: Tensor) -> Tensor:
    """Vectors [R, ..., 2] turned by angles [R]."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    matrix = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2).to(vectors.dtype)
    return (matrix[(slice(None), *(None,) * (vectors.ndim - 2))] @ vectors[..., None])[..., 0]


def build_context(posterior: BankPosterior, rows: Nodes, time_s: Tensor, step_s: float, length_m: float) -> ResidualContext:
    """The context of R windows from the bank's posterior and their detections.

    Args:
        posterior: of the R rows.
        rows: their detections [R, N], oldest first, relative to the origin.
        time_s: [T] grid.
        step_s: the unit of time, a step.
        length_m: the unit of length, the way at typical speed in a step.
    """
    num_rows = len(rows.time_s)
    last = rows.is_observed.sum(1).clamp_min(1) - 1
    anchor = rows.position_m[torch.arange(num_rows), last]
    since, until = _times_between(rows, time_s)
    keep = min(MAX_DETECTIONS, rows.time_s.shape[1])
    pick = (last[:, None] + 1 - keep).clamp_min(0) + torch.arange(keep)
    observed = rows.is_observed.gather(1, pick.clamp(max=rows.time_s.shape[1] - 1)) & (pick <= last[:, None])
    pick = pick.clamp(max=rows.time_s.shape[1] - 1)
    age = -rows.time_s.gather(1, pick) / step_s
    place = (rows.position_m.gather(1, pick[..., None].expand(-1, -1, 2)) - anchor[:, None]) / length_m
    noise = rows.covariance_m2.diagonal(dim1=-2, dim2=-1).mean(-1).gather(1, pick).sqrt() / length_m
    detections = torch.cat([age[..., None], place, torch.log(noise.clamp_min(1e-3))[..., None]], -1)
    return ResidualContext(
        mean=((posterior.mean_m - anchor[:, None]) / length_m).float(),
        sigma=(posterior.sigma_m / length_m).float(),
        since=(since / step_s).float(),
        until=(until / step_s).float(),
        is_future=(time_s > 0).expand(num_rows, -1),
        detections=(detections * observed[..., None]).float(),
        is_observed=observed,
    )


def _times_between(rows: Nodes, time_s: Tensor) -> tuple[Tensor, Tensor]:
    """Seconds since the previous and until the next detection at every step [R, T]; the window's length where there is none."""
    length = time_s[-1] - time_s[0]
    difference = time_s[None, :, None] - rows.time_s[:, None, :]
    far = torch.full_like(difference, float(length))
    seen = rows.is_observed[:, None, :]
    since = torch.where(seen & (difference >= 0), difference, far).amin(-1)
    until = torch.where(seen & (difference <= 0), -difference, far).amin(-1)
    return since.clamp(max=length), until.clamp(max=length)


def features(noisy: Tensor, context: ResidualContext) -> Tensor:
    """The network's input [R, NUM_FEATURES, T] for noisy residuals [R, T, 2]."""
    path = context.mean + context.sigma[..., None] * noisy
    velocity = torch.diff(path, dim=1, prepend=path[:, :1])
    mean_velocity = torch.diff(context.mean, dim=1, prepend=context.mean[:, :1])
    scalars = torch.stack(
        [
            torch.log(context.sigma) / 3.0,
            torch.log1p(context.since) / 4.0,
            torch.log1p(context.until) / 4.0,
            context.is_future.to(noisy.dtype),
        ],
        dim=-1,
    )
    columns = [noisy, torch.asinh(path / _LENGTH), torch.asinh(context.mean / _LENGTH), torch.asinh(velocity)]
    return torch.cat([*columns, torch.asinh(mean_velocity), scalars], dim=-1).mT


def encoder_rows(context: ResidualContext) -> Tensor:
    """The encoder's input [R, N, 4]: age, x, y, log sigma, each of order one."""
    d = context.detections
    return torch.cat([d[..., :1] / 32.0, torch.asinh(d[..., 1:3] / _LENGTH), d[..., 3:] / 4.0], dim=-1)
