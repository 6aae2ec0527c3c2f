"""The network of the paper: noisy trajectories in normalised coordinates, conditioned on noise level and detections.

Ye, Natarajan, Wu, Gombolay, "Diffusion Models for Multi-target Adversarial Tracking" (CADENCE, MRS 2023), section IV. The
general model has a network of its own (`cadence.network.residual`).
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from cadence.network.encoder import DetectionEncoder
from cadence.network.unet import NoiseLevelEmbedding, UNet, UNetConfig
from cadence.schedule import MAX_ANGLE, Prediction, Schedule, clean_from, cosine_schedule

NUM_DETECTION_FEATURES = 3
"""Columns of a detection's row: age, x, y."""


@dataclass(frozen=True)
class TrajectoryNetworkConfig:
    """Sizes and switches of the network; the defaults are the paper's.

    num_steps       steps T of a trajectory; a multiple of 2 ** (levels - 1)
    num_levels      sampling steps of the cosine schedule it is trained on
    prediction      what it answers
    conditioning    FiLM (the paper's text) or a bias alone (the authors' code)
    width, multipliers, num_blocks  channels of the first level, multiples on each level, residual blocks a level
    kernel_size, num_groups         of the convolutions, and of the group normalisation
    activation, pre_norm            nonlinearity; normalise before instead of after the convolution
    encoder_size    state of the detections' LSTM
    level_size      embedding of the noise level
    max_detections  the last detections that the encoder reads
    known_goal      the goal's position is an input (the authors' code; its rivals do not get it)
    elapsed         the share of the longest mission that has passed is an input (the authors' code)
    """

    num_steps: int = 120
    num_levels: int = 100
    prediction: Prediction = "epsilon"
    width: int = 32
    multipliers: tuple[int, ...] = (1, 4, 8)
    num_blocks: int = 2
    kernel_size: int = 3
    num_groups: int = 8
    activation: Literal["mish", "silu"] = "mish"
    conditioning: Literal["film", "bias"] = "film"
    pre_norm: bool = False
    encoder_size: int = 32
    level_size: int = 32
    max_detections: int = 32
    known_goal: bool = False
    elapsed: bool = False

    def __post_init__(self) -> None:
        factor = 2 ** (len(self.multipliers) - 1)
        if self.num_steps < 1 or self.num_steps % factor:
            raise ValueError(
                f"num_steps is {self.num_steps}, expected a multiple of {factor} for {len(self.multipliers)} levels"
            )
        if min(self.num_levels, self.max_detections, self.encoder_size) < 1 or self.level_size < 4 or self.level_size % 2:
            raise ValueError("num_levels, max_detections and encoder_size must be positive, level_size even and at least 4")

    @property
    def num_extra(self) -> int:
        """Further inputs beside the detections: goal x and y, elapsed share."""
        return 2 * self.known_goal + self.elapsed

    def unet(self) -> UNetConfig:
        """The U-Net these sizes mean."""
        return UNetConfig(
            width=self.width,
            multipliers=self.multipliers,
            num_blocks=self.num_blocks,
            kernel_size=self.kernel_size,
            num_groups=self.num_groups,
            activation=self.activation,
            conditioning=self.conditioning,
            condition_size=self.encoder_size + self.level_size + self.num_extra,
            pre_norm=self.pre_norm,
        )

    def schedule(self) -> Schedule:
        """The noise levels it is trained on."""
        return cosine_schedule(self.num_levels)


PAPER = TrajectoryNetworkConfig()
"""The paper's values, one by one the defaults above."""


class TrajectoryNetwork(nn.Module):
    """Noisy trajectories [B, A, T, 2] to what `config.prediction` names, of the same shape.

    Agents are folded into the batch: nothing passes between them. Everything is in normalised units.
    """

    def __init__(self, config: TrajectoryNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.unet = UNet(config.unet())
        self.encoder = DetectionEncoder(NUM_DETECTION_FEATURES, config.encoder_size)
        self.level = NoiseLevelEmbedding(config.level_size)

    def encode(self, rows: Tensor, is_observed: Tensor, extra: Tensor | None = None) -> Tensor:
        """What a window's detections say, one code an agent [B, A, E]; computed once, whatever is sampled from it.

        Args:
            rows: [B, A, N, 3] age, x, y, oldest first, left-packed.
            is_observed: [B, A, N] bool, False on padding.
            extra: [B, A, num_extra] goal x, goal y, elapsed share, as far as the configuration has them.
        """
        b, a, n = is_observed.shape
        code: Tensor = self.encoder(rows.reshape(b * a, n, -1), is_observed.reshape(b * a, n)).reshape(b, a, -1)
        given = 0 if extra is None else extra.shape[-1]
        if given != self.config.num_extra:
            raise ValueError(f"TrajectoryNetwork: {given} further inputs (goal, elapsed), expected {self.config.num_extra}")
        return code if extra is None else torch.cat([code, extra.to(code.dtype)], dim=-1)

    def forward(self, noisy: Tensor, angle: Tensor | float, code: Tensor) -> Tensor:
        """The answer [B, A, T, 2] at noise level `angle` (one number, or [B]) for windows of codes [B, A, E]."""
        b, a, t, d = noisy.shape
        angles = torch.as_tensor(angle, dtype=torch.float32, device=noisy.device)
        level = self.level(angles.reshape(-1) / MAX_ANGLE * self.config.num_levels)
        # one number is embedded once, whatever the batch
        levels = level[:, None].expand(b, a, -1)
        condition = torch.cat([code, levels.to(code.dtype)], dim=-1).reshape(b * a, -1)
        answer: Tensor = self.unet(noisy.reshape(b * a, t, d).mT, condition)
        return answer.mT.reshape(b, a, t, d)

    def clean(self, noisy: Tensor, angle: float, code: Tensor) -> Tensor:
        """The clean estimate [B, A, T, 2] that the answer means."""
        level = torch.tensor(angle, dtype=noisy.dtype, device=noisy.device)
        return clean_from(self.config.prediction, self(noisy, angle, code), noisy, level)
