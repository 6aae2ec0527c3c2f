"""A U-Net with its weights laid out for sampling: the same function within rounding, in less time.

Convolutions over time run as convolutions over pictures of height one with channels last, the layout that CPU kernels work in
without reordering. FiLM's linear layers act on each half of the condition alone, so that a window's half is computed once,
whatever the number of hypotheses and sampling steps.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from cadence.network.attention import Team
from cadence.network.place import Pieces, PlaceInputs, PlaceNetwork
from cadence.network.unet import UNet, _Block


class FrozenPlace:
    """The function of a place network; see `FrozenUNet`."""

    def __init__(self, network: PlaceNetwork, dtype: torch.dtype = torch.float32) -> None:
        self.network = network
        self.unet = FrozenUNet(network.unet, dtype)

    def known(self, inputs: PlaceInputs) -> list[Tensor]:
        """What R windows tell the blocks of the U-Net, whatever the noise level [R, *] each."""
        return self.unet.shares(self.network.encode(inputs))

    def __call__(self, noisy: Tensor, angle: float, pieces: Pieces, known: list[Tensor], team: Team | None = None) -> Tensor:
        """The velocity [R * K, P, 2] for noisy [R * K, P, 2] at one noise level, K rows in a row for each window of `known`."""
        at = torch.tensor([angle])
        features = self.network.features(noisy, at, pieces)
        return self.unet(features, known, self.network.level_code(at)[0], team)


class FrozenUNet:
    """The function of a pre-norm U-Net with FiLM and SiLU; later changes of its weights are not seen.

    States are held in `dtype`, sums and conditioning are computed in float32. Raises ValueError for other U-Nets.
    """

    def __init__(self, unet: UNet, dtype: torch.dtype = torch.float32) -> None:
        config = unet.config
        if not config.pre_norm or config.conditioning != "film" or config.activation != "silu":
            raise ValueError("FrozenUNet: a pre-norm U-Net with conditioning 'film' and activation 'silu' is needed")
        self.unet, self.dtype = unet, dtype
        self._weights = {
            module: _picture_weights(module, dtype)
            for name, module in unet.named_modules()
            if isinstance(module, nn.Conv1d | nn.ConvTranspose1d) and not name.startswith("across.")
        }
        self._blocks = [b for blocks in (*unet.down, unet.middle, *unet.up) for b in blocks]

    def shares(self, code: Tensor) -> list[Tensor]:
        """What the first part of the condition, `code` [R, C], adds to every block's scale and shift [R, 2 * channels]."""
        active = functional.silu(code)
        return [functional.linear(active, block.modulate[1].weight[:, : code.shape[1]]) for block in self._blocks]

    def __call__(self, trajectory: Tensor, shares: list[Tensor], rest: Tensor, team: Team | None = None) -> Tensor:
        """Answers [R * K, T, out_channels] for [R * K, T, in_channels], K rows in a row for each of the R `shares`.

        `rest` [E] is the second part of the condition, the same for all rows.
        """
        unet = self.unet
        film = iter([self._film(block, share, rest) for block, share in zip(self._blocks, shares, strict=True)])
        picture = trajectory.to(self.dtype)[:, None].permute(0, 3, 1, 2)
        hidden = self._convolved(unet.stem, picture)
        skips: list[Tensor] = []
        for blocks, narrow in zip(unet.down, unet.narrow, strict=True):
            for block in blocks:  # type: ignore[attr-defined]
                hidden = self._block(block, hidden, next(film))
            hidden = self._seen(hidden, len(skips), team)
            skips.append(hidden)
            hidden = self._convolved(narrow, hidden)
        for block in unet.middle:
            hidden = self._block(block, hidden, next(film))  # type: ignore[arg-type]
        hidden = self._seen(hidden, len(skips), team)
        skips.pop()
        for widen, blocks in zip(unet.widen, unet.up, strict=True):
            hidden = torch.cat([self._convolved(widen, hidden), skips.pop()], dim=1)
            for block in blocks:  # type: ignore[attr-defined]
                hidden = self._block(block, hidden, next(film))
        hidden = functional.silu(unet.head_norm(hidden), inplace=True)
        answer = self._convolved(unet.head, torch.cat([hidden, picture], dim=1))
        return answer.permute(0, 2, 3, 1)[:, 0].to(trajectory.dtype)

    def _film(self, block: _Block, share: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and shift [R, 1, channels] of a block."""
        linear = block.modulate[1]
        active = functional.silu(rest)
        whole = share + functional.linear(active, linear.weight[:, -len(rest) :], linear.bias)  # type: ignore[index,arg-type]
        scale, shift = whole[:, None].chunk(2, dim=-1)
        return (1.0 + scale).to(self.dtype), shift.to(self.dtype)

    def _block(self, block: _Block, hidden: Tensor, film: tuple[Tensor, Tensor]) -> Tensor:
        skip = self._convolved(block.skip, hidden)
        hidden = self._convolved(block.first, functional.silu(block.first_norm(hidden), inplace=True))
        hidden = block.second_norm(hidden)
        rows, channels, _, steps = hidden.shape
        by_window = hidden.permute(0, 2, 3, 1).reshape(len(film[0]), -1, channels)
        by_window = torch.addcmul(film[1], by_window, film[0])
        hidden = by_window.reshape(rows, 1, steps, channels).permute(0, 3, 1, 2)
        return self._convolved(block.second, functional.silu(hidden, inplace=True)).add_(skip)

    def _seen(self, hidden: Tensor, level: int, team: Team | None) -> Tensor:
        """Attention between agents, in float32, of pictures [N, C, 1, T]."""
        if team is None or not self.unet.has_attention(level):
            return hidden
        seen = self.unet.seen(hidden[:, :, 0].float(), level, team)[:, :, None].to(self.dtype)
        return seen.contiguous(memory_format=torch.channels_last)

    def _convolved(self, module: nn.Module, picture: Tensor) -> Tensor:
        """A convolution of pictures [N, C, 1, T]; other modules, which do nothing, give the picture back."""
        if module not in self._weights:
            return picture
        weight, bias = self._weights[module]
        if isinstance(module, nn.ConvTranspose1d):
            return functional.conv_transpose2d(picture, weight, bias, (1, module.stride[0]), (0, int(module.padding[0])))
        assert isinstance(module, nn.Conv1d)
        return functional.conv2d(picture, weight, bias, (1, module.stride[0]), (0, int(module.padding[0])))


def _picture_weights(module: nn.Conv1d | nn.ConvTranspose1d, dtype: torch.dtype) -> tuple[Tensor, Tensor | None]:
    weight = module.weight.detach().to(dtype)[:, :, None].contiguous(memory_format=torch.channels_last)
    return weight, None if module.bias is None else module.bias.detach().to(dtype)
