"""The temporal U-Net: 1-D convolutions over time, conditioned at every block by FiLM.

Ye, Natarajan, Wu, Gombolay, "Diffusion Models for Multi-target Adversarial Tracking" (CADENCE, MRS 2023), section IV; the
form goes back to Janner et al., "Planning with Diffusion for Flexible Behavior Synthesis" (ICML 2022).
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from cadence.network.attention import AgentAttention, Team


@dataclass(frozen=True)
class UNetConfig:
    """Shape of the U-Net; the defaults are the paper's.

    in_channels, out_channels  channels per step of input and output
    width           channels of the first level
    multipliers     channels of each level, in units of the width; each level below the first halves the steps
    num_blocks      residual blocks a level and side
    kernel_size     of every convolution, odd
    num_groups      of every group normalisation
    activation      "mish" as in the paper, or "silu", which is cheaper
    conditioning    "film" (scale and shift, the paper's text) or "bias" (shift only, the authors' code)
    condition_size  length of the condition vector
    pre_norm        normalise before each convolution, with residual branches that start at zero
    attention_heads of the attention between agents below the first level and in the middle; 0: agents do not see each other
    attention_form  "joint" (one softmax over all others) or "paired" (one for each other agent, summed: the paper's text)
    """

    in_channels: int = 2
    out_channels: int = 2
    width: int = 32
    multipliers: tuple[int, ...] = (1, 4, 8)
    num_blocks: int = 2
    kernel_size: int = 3
    num_groups: int = 8
    activation: Literal["mish", "silu"] = "mish"
    conditioning: Literal["film", "bias"] = "film"
    condition_size: int = 64
    pre_norm: bool = False
    attention_heads: int = 0
    attention_form: Literal["joint", "paired"] = "joint"

    def __post_init__(self) -> None:
        if self.kernel_size % 2 == 0 or self.width % self.num_groups:
            raise ValueError("kernel_size must be odd, and width a multiple of num_groups")


class UNet(nn.Module):
    """Trajectories [N, in_channels, T] and conditions [N, condition_size] to [N, out_channels, T].

    T must be a multiple of 2 ** (levels - 1).
    """

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = [config.width * m for m in config.multipliers]
        self.stem = nn.Conv1d(config.in_channels, widths[0], config.kernel_size, padding=config.kernel_size // 2)
        self.down = nn.ModuleList()
        self.narrow = nn.ModuleList()
        channels = widths[0]
        for level, width in enumerate(widths):
            self.down.append(_blocks(config, channels, width))
            self.narrow.append(nn.Conv1d(width, width, 3, stride=2, padding=1) if level + 1 < len(widths) else nn.Identity())
            channels = width
        self.middle = _blocks(config, channels, channels)
        # after the blocks of every level but the first, and in the middle
        self.across = nn.ModuleList(
            AgentAttention(width, config.attention_heads, config.num_groups, config.attention_form)
            for width in ([*widths[1:], widths[-1]] if config.attention_heads else [])
        )
        self.up = nn.ModuleList()
        self.widen = nn.ModuleList()
        for level in range(len(widths) - 2, -1, -1):
            self.widen.append(nn.ConvTranspose1d(channels, widths[level], 4, stride=2, padding=1))
            self.up.append(_blocks(config, 2 * widths[level], widths[level]))
            channels = widths[level]
        self.head_norm = nn.GroupNorm(config.num_groups, channels)
        self.head_act = _activation(config)
        self.head = nn.Conv1d(channels + config.in_channels, config.out_channels, 1)
        # the untrained network answers zero: for the residual model that is the bank itself
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias if self.head.bias is not None else torch.zeros(0))

    def forward(self, trajectory: Tensor, condition: Tensor, team: Team | None = None) -> Tensor:
        """See the class; every row of the batch is independent, but for the rows of a `team` where there is attention."""
        factor = 2 ** (len(self.config.multipliers) - 1)
        if trajectory.shape[-1] % factor:
            raise ValueError(f"UNet: {trajectory.shape[-1]} steps are not a multiple of {factor}")
        hidden = self.stem(trajectory)
        skips: list[Tensor] = []
        for blocks, narrow in zip(self.down, self.narrow, strict=True):
            for block in blocks:  # type: ignore[attr-defined]
                hidden = block(hidden, condition)
            hidden = self.seen(hidden, len(skips), team)
            skips.append(hidden)
            hidden = narrow(hidden)
        for block in self.middle:
            hidden = block(hidden, condition)
        hidden = self.seen(hidden, len(skips), team)
        skips.pop()
        for widen, blocks in zip(self.widen, self.up, strict=True):
            hidden = torch.cat([widen(hidden), skips.pop()], dim=1)
            for block in blocks:  # type: ignore[attr-defined]
                hidden = block(hidden, condition)
        hidden = self.head_act(self.head_norm(hidden))
        result: Tensor = self.head(torch.cat([hidden, trajectory], dim=1))
        return result

    def seen(self, hidden: Tensor, level: int, team: Team | None) -> Tensor:
        """States [N, C, T] after the attention that follows `level`; unchanged where there is none, or no team."""
        if team is None or not self.has_attention(level):
            return hidden
        result: Tensor = self.across[level - 1](hidden, team)
        return result

    def has_attention(self, level: int) -> bool:
        """Whether agents see each other after the blocks of `level`; the middle counts as one level more than there are."""
        return 1 <= level <= len(self.across)


class _Block(nn.Module):
    """Two convolutions with normalisation, conditioned between them, and a skip."""

    def __init__(self, config: UNetConfig, channels_in: int, channels_out: int) -> None:
        super().__init__()
        padding = config.kernel_size // 2
        self.first = nn.Conv1d(channels_in, channels_out, config.kernel_size, padding=padding)
        self.second = nn.Conv1d(channels_out, channels_out, config.kernel_size, padding=padding)
        self.first_norm = nn.GroupNorm(config.num_groups, channels_in if config.pre_norm else channels_out)
        self.second_norm = nn.GroupNorm(config.num_groups, channels_out)
        self.act = _activation(config)
        self.is_film = config.conditioning == "film"
        self.pre_norm = config.pre_norm
        self.modulate = nn.Sequential(_activation(config), nn.Linear(config.condition_size, channels_out * (1 + self.is_film)))
        self.skip = nn.Conv1d(channels_in, channels_out, 1) if channels_in != channels_out else nn.Identity()
        if config.pre_norm:
            nn.init.zeros_(self.second.weight)

    def forward(self, hidden: Tensor, condition: Tensor) -> Tensor:
        skip = self.skip(hidden)
        modulation = self.modulate(condition)[..., None]
        if self.pre_norm:
            hidden = self.first(self.act(self.first_norm(hidden)))
            hidden = self.second(self.act(self._modulated(self.second_norm(hidden), modulation)))
        else:
            hidden = self._modulated(self.act(self.first_norm(self.first(hidden))), modulation)
            hidden = self.act(self.second_norm(self.second(hidden)))
        result: Tensor = hidden + skip
        return result

    def _modulated(self, hidden: Tensor, modulation: Tensor) -> Tensor:
        if not self.is_film:
            return hidden + modulation
        scale, shift = modulation.chunk(2, dim=1)
        return hidden * (1.0 + scale) + shift


def _blocks(config: UNetConfig, channels_in: int, channels_out: int) -> nn.ModuleList:
    widths = [channels_in] + [channels_out] * config.num_blocks
    return nn.ModuleList(_Block(config, a, b) for a, b in itertools.pairwise(widths))


def _activation(config: UNetConfig) -> nn.Module:
    return nn.Mish() if config.activation == "mish" else nn.SiLU()


class NoiseLevelEmbedding(nn.Module):
    """Sinusoids of the noise level and two dense layers, [N] -> [N, size] (Ho et al., DDPM, 2020)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size
        self.layers = nn.Sequential(nn.Linear(size, 4 * size), nn.Mish(), nn.Linear(4 * size, size))

    def forward(self, level: Tensor) -> Tensor:
        """`level` in the units the schedule counts in: sampling steps 0 ... 99 for the paper's."""
        half = self.size // 2
        frequency = torch.exp(-math.log(10_000.0) / (half - 1) * torch.arange(half, device=level.device, dtype=torch.float32))
        phase = level.to(torch.float32)[:, None] * frequency
        result: Tensor = self.layers(torch.cat([phase.sin(), phase.cos()], dim=-1))
        return result
