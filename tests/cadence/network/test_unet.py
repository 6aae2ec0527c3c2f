"""The temporal U-Net and the network of the general preset: shapes, starts, independence, sizes."""

import dataclasses

import pytest
import torch

from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.network.residual_context import NUM_FEATURES, ResidualContext
from cadence.network.unet import NoiseLevelEmbedding, UNet, UNetConfig

SMALL = UNetConfig(width=8, multipliers=(1, 2, 4), num_groups=4, condition_size=6)


def built(config: UNetConfig, seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    net = UNet(config)
    torch.nn.init.normal_(net.head.weight)  # a head of zeros would hide everything
    return net


def inputs(num: int = 3, steps: int = 16, channels: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    return torch.randn(num, channels, steps, generator=g), torch.randn(num, 6, generator=g)


@pytest.mark.parametrize("multipliers", [(1,), (1, 2), (1, 2, 4)])
@pytest.mark.parametrize("num_blocks", [1, 2])
@pytest.mark.parametrize("pre_norm", [False, True])
def test_shape_is_kept(multipliers: tuple[int, ...], num_blocks: int, pre_norm: bool) -> None:
    config = dataclasses.replace(SMALL, multipliers=multipliers, num_blocks=num_blocks, pre_norm=pre_norm, in_channels=5)
    trajectory, condition = inputs(channels=5)
    assert tuple(built(config)(trajectory, condition).shape) == (3, 2, 16)


def test_steps_must_divide() -> None:
    trajectory, condition = inputs(steps=18)
    with pytest.raises(ValueError, match="18 steps are not a multiple of 4"):
        built(SMALL)(trajectory, condition)


@pytest.mark.parametrize("change", [{"kernel_size": 4}, {"width": 10}])
def test_impossible_shapes_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="odd"):
        dataclasses.replace(SMALL, **change)


@pytest.mark.parametrize("pre_norm", [False, True])
def test_the_untrained_network_answers_zero(pre_norm: bool) -> None:
    net = UNet(dataclasses.replace(SMALL, pre_norm=pre_norm))
    assert not net(*inputs()).any()


@pytest.mark.parametrize("pre_norm", [False, True])
def test_rows_of_a_batch_are_independent(pre_norm: bool) -> None:
    net = built(dataclasses.replace(SMALL, pre_norm=pre_norm))
    trajectory, condition = inputs()
    together = net(trajectory, condition)
    changed = net(torch.cat([trajectory[:1], 9.0 * trajectory[1:]]), condition)
    torch.testing.assert_close(changed[0], together[0])
    torch.testing.assert_close(net(trajectory[2:], condition[2:])[0], together[2], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("conditioning", ["film", "bias"])
def test_the_condition_counts(conditioning: str) -> None:
    net = built(dataclasses.replace(SMALL, conditioning=conditioning))
    trajectory, condition = inputs()
    assert not torch.allclose(net(trajectory, condition), net(trajectory, condition + 1.0))


def test_film_scales_and_shifts_and_bias_only_shifts() -> None:
    film, bias = (built(dataclasses.replace(SMALL, conditioning=kind)).down[0][0] for kind in ("film", "bias"))
    assert film.modulate[1].out_features == 2 * bias.modulate[1].out_features
    hidden = torch.randn(2, 8, 16, generator=torch.Generator().manual_seed(2))
    shift = torch.randn(2, 8, 1, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(bias._modulated(hidden, shift), hidden + shift)
    scale = torch.full_like(shift, 2.0)
    torch.testing.assert_close(film._modulated(hidden, torch.cat([scale, shift], 1)), 3.0 * hidden + shift)
    # a condition that says nothing leaves everything as it is, with either
    nothing = torch.zeros_like(shift)
    assert torch.equal(film._modulated(hidden, torch.cat([nothing, nothing], 1)), bias._modulated(hidden, nothing))


def test_every_weight_takes_part() -> None:
    net = built(SMALL)
    (net(*inputs()) ** 2).sum().backward()
    assert [name for name, weight in net.named_parameters() if weight.grad is None] == []


def test_the_paper_preset_has_the_papers_size() -> None:
    """About 2.4 million weights, as the authors' network."""
    assert sum(weight.numel() for weight in UNet(UNetConfig()).parameters()) == 2_406_598


def test_noise_levels_are_told_apart() -> None:
    torch.manual_seed(0)
    embed = NoiseLevelEmbedding(32)
    code = embed(torch.tensor([0.0, 1.0, 50.0, 99.0])).detach()
    assert tuple(code.shape) == (4, 32)
    assert float(torch.pdist(code).min()) > 1e-3
    torch.testing.assert_close(embed(torch.tensor([50.0]))[0].detach(), code[2])


def context(num: int = 2, steps: int = 16) -> ResidualContext:
    g = torch.Generator().manual_seed(4)
    return ResidualContext(
        mean=torch.randn(num, steps, 2, generator=g),
        sigma=torch.rand(num, steps, generator=g) + 0.1,
        since=torch.rand(num, steps, generator=g),
        until=torch.rand(num, steps, generator=g),
        is_future=(torch.arange(steps) > 9).expand(num, -1),
        detections=torch.randn(num, 5, 4, generator=g),
        is_observed=torch.arange(5) < torch.tensor([[5], [3]]),
    )


def test_residual_network() -> None:
    config = ResidualNetworkConfig(width=16, encoder_size=8, level_size=8)
    assert config.unet().in_channels == NUM_FEATURES
    torch.manual_seed(0)
    net, seen = ResidualNetwork(config), context()
    noisy = torch.randn(6, 16, 2, generator=torch.Generator().manual_seed(5))
    angle = torch.linspace(0.1, 1.5, 6)
    code = net.encode(seen).repeat_interleave(3, 0)
    answer = net(noisy, angle, seen.repeated(3), code)
    assert tuple(answer.shape) == (6, 16, 2)
    assert not answer.any()  # untrained: a velocity of zero, which gives the bank back
    torch.nn.init.normal_(net.unet.head.weight)
    together = net(noisy, angle, seen.repeated(3), code)
    alone = net(noisy[4:5], angle[4:5], seen[slice(1, 2)], net.encode(seen)[1:])
    torch.testing.assert_close(alone[0], together[4], rtol=1e-4, atol=1e-5)
