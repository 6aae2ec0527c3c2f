"""Networks laid out for sampling answer as the networks do."""

import pytest
import torch

from cadence.network.frozen import FrozenUNet
from cadence.network.unet import UNet, UNetConfig


def unet(**changes: object) -> UNet:
    torch.manual_seed(0)
    settings: dict[str, object] = dict(
        in_channels=3, width=16, multipliers=(1, 2), kernel_size=5, activation="silu", condition_size=10, pre_norm=True
    )
    net = UNet(UNetConfig(**{**settings, **changes}))  # type: ignore[arg-type]
    for weight in net.parameters():  # layers that begin at zero would hide mistakes
        torch.nn.init.normal_(weight, std=0.2)
    return net.eval()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 0.03)])
@pytest.mark.parametrize("num_blocks", [1, 2])
@torch.no_grad()
def test_the_answers_are_those_of_the_network(num_blocks: int, dtype: torch.dtype, tolerance: float) -> None:
    net, rows, times = unet(num_blocks=num_blocks), 3, 4
    noisy, code, rest = torch.randn(rows * times, 12, 3), torch.randn(rows, 7), torch.randn(3)
    condition = torch.cat([code.repeat_interleave(times, dim=0), rest.expand(rows * times, -1)], dim=1)
    expected = net(noisy.mT, condition).mT
    frozen = FrozenUNet(net, dtype)
    found = frozen(noisy, frozen.shares(code), rest)
    assert found.dtype == torch.float32 and found.shape == expected.shape
    assert float((found - expected).norm() / expected.norm()) < tolerance


@pytest.mark.parametrize("changes", [{"pre_norm": False}, {"conditioning": "bias"}, {"activation": "mish"}])
def test_other_networks_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="pre-norm"):
        FrozenUNet(unet(**changes))
