"""The network of the general preset: U-Net over the residual, conditioned on noise level and detections."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cadence.network.encoder import DetectionEncoder
from cadence.network.residual_context import NUM_DETECTION_FEATURES, NUM_FEATURES, ResidualContext, encoder_rows, features
from cadence.network.unet import NoiseLevelEmbedding, UNet, UNetConfig

_LEVEL_SCALE = 100.0


@dataclass(frozen=True)
class ResidualNetworkConfig:
    """Sizes of the general preset's network.

    width, multipliers  channels of the first level, and their multiples on every level (each halves the time resolution)
    num_blocks          residual blocks of a level
    encoder_size        of the vector that stands for the detections
    level_size          of the vector that stands for the noise level
    """

    width: int = 32
    multipliers: tuple[int, ...] = (1, 2, 4)
    num_blocks: int = 1
    encoder_size: int = 32
    level_size: int = 32

    def __post_init__(self) -> None:
        self.unet()  # refuses sizes that cannot be

    def unet(self) -> UNetConfig:
        """The U-Net these sizes mean."""
        return UNetConfig(
            in_channels=NUM_FEATURES,
            width=self.width,
            multipliers=self.multipliers,
            num_blocks=self.num_blocks,
            kernel_size=5,
            activation="silu",
            condition_size=self.encoder_size + self.level_size,
            pre_norm=True,
        )


class ResidualNetwork(nn.Module):
    """v-prediction of residuals: noisy [R * K, T, 2], angle [R * K], context of R windows, K hypotheses each."""

    def __init__(self, config: ResidualNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.unet = UNet(config.unet())
        self.encoder = DetectionEncoder(NUM_DETECTION_FEATURES, config.encoder_size)
        self.level = NoiseLevelEmbedding(config.level_size)

    def encode(self, context: ResidualContext) -> Tensor:
        """One vector a window [R, encoder_size]; computed once, whatever the number of hypotheses and steps."""
        code: Tensor = self.encoder(encoder_rows(context), context.is_observed)
        return code

    def forward(self, noisy: Tensor, angle: Tensor, context: ResidualContext, code: Tensor) -> Tensor:
        """The velocity [R * K, T, 2]; `context` and `code` are already repeated for each hypothesis."""
        condition = torch.cat([code, self.level(angle * _LEVEL_SCALE)], dim=-1)
        answer: Tensor = self.unet(features(noisy, context), condition)
        return answer.mT
