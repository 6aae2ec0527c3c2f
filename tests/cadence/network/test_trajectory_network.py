"""The paper's network: its values, its interface [B, A, T, 2], and that what goes in has an effect."""

import dataclasses

import pytest
import torch

from cadence.network.trajectory import PAPER, TrajectoryNetwork, TrajectoryNetworkConfig

SMALL = TrajectoryNetworkConfig(num_steps=16, width=8, multipliers=(1, 2), num_blocks=1, encoder_size=8, level_size=8)


def awake(network, seed=0):
    """Random weights everywhere: a new network answers zero."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def inputs(b=3, a=2, t=16, n=5, seed=1):
    generator = torch.Generator().manual_seed(seed)
    noisy, rows = torch.randn(b, a, t, 2, generator=generator), torch.randn(b, a, n, 3, generator=generator)
    return noisy, rows, torch.arange(n).expand(b, a, n) < torch.tensor([[5, 3], [0, 1], [2, 4]])[:b, :a, None]


def test_the_preset_is_the_papers():
    unet = PAPER.unet()
    assert (unet.width, unet.multipliers, unet.kernel_size, unet.num_groups, unet.num_blocks) == (32, (1, 4, 8), 3, 8, 2)
    assert (unet.activation, unet.conditioning, unet.condition_size, unet.pre_norm) == ("mish", "film", 64, False)
    assert (PAPER.num_steps, PAPER.num_levels, PAPER.prediction, PAPER.max_detections) == (120, 100, "epsilon", 32)
    assert len(PAPER.schedule()) == 100
    num_weights = sum(parameter.numel() for parameter in TrajectoryNetwork(PAPER).parameters())
    assert 2.0e6 < num_weights < 3.5e6


def test_every_weight_has_a_gradient():
    network = awake(TrajectoryNetwork(SMALL))
    noisy, rows, observed = inputs()
    network(noisy, torch.tensor([0.1, 0.7, 1.4]), network.encode(rows, observed)).square().sum().backward()
    assert [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []


def test_agents_and_windows_are_independent_and_permute():
    network = awake(TrajectoryNetwork(SMALL))
    noisy, rows, observed = inputs()
    angle = torch.tensor([0.1, 0.7, 1.4])
    with torch.no_grad():
        answer = network(noisy, angle, network.encode(rows, observed))
        order = torch.tensor([1, 0])
        permuted = network(noisy[:, order], angle, network.encode(rows[:, order], observed[:, order]))
        alone = network(noisy[1:2], 0.7, network.encode(rows[1:2], observed[1:2]))
    torch.testing.assert_close(permuted, answer[:, order], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(alone, answer[1:2], rtol=1e-4, atol=1e-5)


def test_detections_and_level_matter_and_padding_does_not():
    network = awake(TrajectoryNetwork(SMALL))
    noisy, rows, observed = inputs()
    with torch.no_grad():
        code = network.encode(rows, observed)
        answer = network(noisy, 0.7, code)
        assert not torch.allclose(answer, network(noisy, 1.2, code), atol=1e-3)
        changed = rows.clone()
        changed[0, 0, 4] += 1.0
        changed[1, 0] += 1.0  # nothing is observed there
        other = network.encode(changed, observed)
        assert not torch.allclose(code[0, 0], other[0, 0], atol=1e-3)
        assert torch.equal(code[1:], other[1:])
        torch.testing.assert_close(code, network.encode(rows[:, :, :5], observed[:, :, :5]))


@pytest.mark.parametrize("prediction", ["epsilon", "x0", "v"])
def test_clean_estimate_of_an_untrained_network(prediction):
    network = TrajectoryNetwork(dataclasses.replace(SMALL, prediction=prediction))
    noisy, rows, observed = inputs()
    with torch.no_grad():
        clean = network.clean(noisy, 0.6, network.encode(rows, observed))
    factor = {"epsilon": 1 / torch.cos(torch.tensor(0.6)), "x0": 0.0, "v": torch.cos(torch.tensor(0.6))}[prediction]
    torch.testing.assert_close(clean, noisy * factor)


def test_goal_and_elapsed_are_inputs_where_asked_for():
    config = dataclasses.replace(SMALL, known_goal=True, elapsed=True)
    network = awake(TrajectoryNetwork(config))
    noisy, rows, observed = inputs()
    code = network.encode(rows, observed, torch.zeros(3, 2, 3))
    assert code.shape == (3, 2, 11)
    other = network.encode(rows, observed, torch.ones(3, 2, 3))
    assert not torch.allclose(network(noisy, 0.5, code), network(noisy, 0.5, other), atol=1e-3)
    with pytest.raises(ValueError, match="expected 3"):
        network.encode(rows, observed)


def test_bias_alone_and_bad_sizes():
    networks = [TrajectoryNetwork(dataclasses.replace(SMALL, conditioning=kind)) for kind in ("film", "bias")]
    film, bias = (sum(parameter.numel() for parameter in network.parameters()) for network in networks)
    assert bias < film
    with pytest.raises(ValueError, match="multiple of 2"):
        dataclasses.replace(SMALL, num_steps=15)
