"""The network of the place preset: a temporal U-Net over a track's pieces that knows one place by heart.

From the paper (Ye et al., CADENCE, MRS 2023): a temporal U-Net with FiLM at every block, conditioned on an LSTM over the
detections. Beyond it: the track is stated as displacements from the last detection on, and along the track that the noisy state
amounts to the network reads a map that it has learned.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from cadence.network.attention import Team
from cadence.network.encoder import DetectionEncoder
from cadence.network.unet import NoiseLevelEmbedding, UNet, UNetConfig

_LEVEL_SCALE = 100.0
_TRACKER_SIZE = 64
_NUM_PIECE_FEATURES = 7
"""Beside the noisy pieces and the map: place x, y, offset x, y, time, duration, whether the piece lies in the future."""


@dataclass(frozen=True)
class PlaceNetworkConfig:
    """Sizes and inputs of the place preset's network.

    width, multipliers, num_blocks, kernel_size  of the U-Net: channels of the first level, their multiples on every level
                    (each halves the pieces), residual blocks a level
    encoder_size    state of the detections' LSTM
    code_size       vector that stands for all that is known of a window
    level_size      vector that stands for the noise level
    max_detections  rows that the LSTM reads
    map_cells, map_channels  of the learned map; no channels: no map
    known_goal      the goal that the trackers know of is an input, where one is given
    trackers        the trackers' positions are inputs, where they are given
    places          detections are told as places on the map ("absolute"), as offsets from the last one ("relative"), or both;
                    with "relative" nothing but the learned map tells where on the map a track is
    attention_heads of the attention between the agents of a window; 0: agents are independent of each other
    attention_form  "joint" (one softmax over all others) or "paired" (one for each other agent, summed: the paper's text)
    """

    width: int = 64
    multipliers: tuple[int, ...] = (1, 2, 3)
    num_blocks: int = 1
    kernel_size: int = 5
    encoder_size: int = 96
    code_size: int = 256
    level_size: int = 32
    max_detections: int = 32
    map_cells: int = 64
    map_channels: int = 8
    known_goal: bool = True
    trackers: bool = True
    places: Literal["both", "absolute", "relative"] = "both"
    attention_heads: int = 0
    attention_form: Literal["joint", "paired"] = "joint"

    def __post_init__(self) -> None:
        if self.map_channels < 0 or min(self.encoder_size, self.code_size, self.max_detections, self.map_cells) < 1:
            raise ValueError("sizes of the place network must be positive, map_channels not negative")
        self.unet()  # refuses sizes that cannot be

    def unet(self) -> UNetConfig:
        """The U-Net these sizes mean."""
        return UNetConfig(
            in_channels=2 + _NUM_PIECE_FEATURES + self.map_channels,
            width=self.width,
            multipliers=self.multipliers,
            num_blocks=self.num_blocks,
            kernel_size=self.kernel_size,
            activation="silu",
            condition_size=self.code_size + self.level_size,
            pre_norm=True,
            attention_heads=self.attention_heads,
            attention_form=self.attention_form,
        )


@dataclass(frozen=True, eq=False)
class Pieces:
    """How the tracks of R windows are cut into P pieces; places in units of half the map's side about its middle.

    last     [R, 2] place of the last detection, where every track begins
    start, duration  [R, P] when a piece begins, relative to now, and how long it lasts, in steps
    span     [R, P] length of a piece at unit speed, as a place
    """

    last: Tensor
    start: Tensor
    duration: Tensor
    span: Tensor

    def __getitem__(self, pick: slice | Tensor) -> "Pieces":
        """A selection of windows."""
        return Pieces(self.last[pick], self.start[pick], self.duration[pick], self.span[pick])

    def repeated(self, times: int) -> "Pieces":
        """Every window `times` times in a row."""
        return Pieces(*(value.repeat_interleave(times, dim=0) for value in vars(self).values()))


@dataclass(frozen=True, eq=False)
class PlaceInputs:
    """What is known of R windows, float32, in the units of `Pieces`.

    rows [R, N, F], is_observed [R, N]   detections, oldest first, left-packed
    summary [R, S]                       the window as a whole
    trackers [R, M, G], is_tracker [R, M] the trackers' tracks, 1 where there is one
    """

    rows: Tensor
    is_observed: Tensor
    summary: Tensor
    trackers: Tensor
    is_tracker: Tensor
    pieces: Pieces

    def __len__(self) -> int:
        return len(self.summary)

    def __getitem__(self, pick: slice | Tensor) -> "PlaceInputs":
        """A selection of windows."""
        return PlaceInputs(**{name: value[pick] for name, value in vars(self).items()})

    def repeated(self, times: int) -> "PlaceInputs":
        """Every window `times` times in a row."""
        return self[torch.arange(len(self)).repeat_interleave(times)]


class PlaceNetwork(nn.Module):
    """v-prediction of tracks as pieces [R, P, 2]; num_row, num_summary, num_tracker are the features in `PlaceInputs`."""

    def __init__(self, config: PlaceNetworkConfig, num_row: int, num_summary: int, num_tracker: int) -> None:
        super().__init__()
        self.config = config
        self.unet = UNet(config.unet())
        self.encoder = DetectionEncoder(num_row, config.encoder_size)
        self.level = NoiseLevelEmbedding(config.level_size)
        size = config.encoder_size + num_summary + config.map_channels
        if config.trackers:
            self.tracker = nn.Sequential(
                nn.Linear(num_tracker, _TRACKER_SIZE), nn.SiLU(), nn.Linear(_TRACKER_SIZE, _TRACKER_SIZE)
            )
            size += _TRACKER_SIZE
        self.mix = nn.Sequential(
            nn.Linear(size, config.code_size), nn.SiLU(), nn.Linear(config.code_size, config.code_size), nn.SiLU()
        )
        self.last = nn.Linear(config.code_size, config.code_size)
        self.map = nn.Parameter(torch.empty(1, config.map_channels, config.map_cells, config.map_cells))
        nn.init.normal_(self.map, std=0.3)

    def encode(self, inputs: PlaceInputs) -> Tensor:
        """One vector a window [R, C]; computed once, whatever the number of hypotheses and steps."""
        parts = [self.encoder(inputs.rows, inputs.is_observed), inputs.summary, self._read(inputs.pieces.last[:, None])[:, 0]]
        if self.config.trackers:
            parts.append((self.tracker(inputs.trackers) * inputs.is_tracker[..., None]).sum(dim=1))
        code: Tensor = self.mix(torch.cat(parts, dim=-1))
        result: Tensor = code + self.last(code)
        return result

    def forward(self, noisy: Tensor, angle: Tensor, pieces: Pieces, code: Tensor, team: Team | None = None) -> Tensor:
        """The velocity [R, P, 2] for noisy [R, P, 2] at noise levels `angle` [R], windows of codes [R, C]."""
        condition = torch.cat([code, self.level_code(angle)], dim=-1)
        answer: Tensor = self.unet(self.features(noisy, angle, pieces).mT, condition, team)
        return answer.mT

    def features(self, noisy: Tensor, angle: Tensor, pieces: Pieces) -> Tensor:
        """What the U-Net sees of noisy tracks [R, P, 2] at noise levels `angle` [R]: [R, P, features]."""
        moved = torch.cos(angle)[:, None, None] * noisy * pieces.span[..., None]
        offset = moved.cumsum(dim=1)
        ends = pieces.last[:, None] + offset
        place = torch.zeros_like(ends) if self.config.places == "relative" else ends.clamp(-1.5, 1.5)
        times = torch.stack([pieces.start / 100.0, pieces.duration / 10.0, (pieces.start >= 0).to(noisy.dtype)], dim=-1)
        return torch.cat([noisy, place, (4.0 * offset).clamp(-6.0, 6.0), times, self._read(ends)], dim=-1)

    def level_code(self, angle: Tensor) -> Tensor:
        """The vector that stands for a noise level [R] -> [R, level_size]."""
        code: Tensor = self.level(angle * _LEVEL_SCALE)
        return code

    def _read(self, place: Tensor) -> Tensor:
        """The learned map at places [R, P, 2] -> [R, P, channels]."""
        if not self.config.map_channels:
            return place.new_zeros(*place.shape[:-1], 0)
        grid = place[None].clamp(-1.0, 1.0)
        found = nn.functional.grid_sample(self.map.float(), grid.float(), align_corners=False, padding_mode="border")
        read: Tensor = found[0].permute(1, 2, 0)
        return read


def octaves(values: Tensor, count: int) -> Tensor:
    """Sines and cosines [..., 2 * count * D] of values [..., D] at wave lengths 4, 2, 1, 1/2 ... (Mildenhall et al., 2020)."""
    phase = values[..., None] * (0.5 * math.pi * 2.0 ** torch.arange(count, dtype=values.dtype))
    return torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(-2)
