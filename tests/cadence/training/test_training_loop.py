"""The training loop: a state laid down and taken up, the average of the weights, losses that are not finite, the rate."""

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from cadence.network.residual_context import RESIDUAL_CLAMP
from cadence.training.ema import Ema
from cadence.training.loop import Loss, OptimiserConfig, Trainer
from cadence.training.residual import residual_loss
from cadence.training.synthetic import ResidualWindows, SyntheticConfig, synthesise

CONFIG = OptimiserConfig(learning_rate=0.05, num_steps=20, warm_up_steps=2, ema_decay=0.9)
INPUTS = torch.randn(20, 6, 3, generator=torch.Generator().manual_seed(0))


def fresh(config: OptimiserConfig = CONFIG) -> Trainer:
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(1)
        return Trainer(nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 1)), config)


def loss_at(step: int) -> Loss:
    """Learn the sum of three numbers."""

    def loss(network: nn.Module) -> Tensor:
        error: Tensor = network(INPUTS[step]) - INPUTS[step].sum(-1, keepdim=True)
        return (error**2).mean()

    return loss


def same(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


@pytest.mark.parametrize("at", [0, 1, 7])
def test_going_on_from_a_state_is_going_on(at: int) -> None:
    trainer = fresh()
    for step in range(at):
        trainer.advance(loss_at(step))
    state = {name: value.clone() for name, value in trainer.state().items()}
    rest = [trainer.advance(loss_at(step)) for step in range(at, 12)]
    other = Trainer(copy.deepcopy(fresh().network), CONFIG)
    other.advance(loss_at(19))  # forgotten
    other.restore(state)
    assert other.step == at and same(other.state(), state)
    assert [other.advance(loss_at(step)) for step in range(at, 12)] == rest
    assert same(other.state(), trainer.state())


def test_a_state_is_a_copy() -> None:
    trainer = fresh()
    trainer.advance(loss_at(0))
    state = trainer.state()
    kept = {name: value.clone() for name, value in state.items()}
    trainer.advance(loss_at(1))
    assert same(state, kept) and not same(state, trainer.state())


def test_learning_lowers_the_loss() -> None:
    trainer = fresh()
    losses = [trainer.advance(loss_at(step)) for step in range(20)]
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_leaves_the_weights(bad: float) -> None:
    trainer = fresh()
    trainer.advance(loss_at(0))
    before = trainer.state()
    answer = trainer.advance(lambda network: network(INPUTS[0]).sum() * bad)
    after = trainer.state()
    assert not math.isfinite(answer)
    assert after.pop("step").tolist() == [2, 1] and before.pop("step").tolist() == [1, 1]
    assert same(before, after)


def test_the_rate_warms_up_and_decays() -> None:
    trainer = fresh(OptimiserConfig(learning_rate=1.0, num_steps=20, warm_up_steps=4))
    rates = []
    for step in range(20):
        trainer.advance(loss_at(step))
        rates.append(trainer.optimiser.param_groups[0]["lr"])
    assert rates[0] == pytest.approx(0.25) and max(rates) == rates[3]
    assert rates[3:] == sorted(set(rates[3:]), reverse=True) and 0.02 < rates[-1] < 0.03


def test_long_gradients_are_shortened() -> None:
    trainer = fresh()
    trainer.advance(lambda network: 1e6 * network(INPUTS[0]).sum())
    norm = torch.cat([p.grad.flatten() for p in trainer.network.parameters() if p.grad is not None]).norm()
    assert float(norm) == pytest.approx(1.0, rel=1e-3)


def test_the_average_by_hand() -> None:
    network = nn.Linear(1, 1, bias=False)
    nn.init.constant_(network.weight, 1.0)
    ema = Ema(network, 0.15)
    nn.init.constant_(network.weight, 2.0)
    ema.update(network)  # decay 1 / 10
    assert ema.network.weight.item() == pytest.approx(1.9)
    nn.init.constant_(network.weight, 3.0)
    ema.update(network)  # decay min(0.15, 2 / 11)
    assert ema.network.weight.item() == pytest.approx(0.15 * 1.9 + 0.85 * 3.0)
    assert not ema.network.weight.requires_grad and not ema.network.training and ema.num_updates == 2
    assert network.weight.item() == 3.0


@pytest.fixture(scope="module")
def windows() -> ResidualWindows:
    return synthesise(SyntheticConfig(history_steps=16, horizon_steps=8, num_tracks=4, num_windows=1, num_samples=2), 1, 2)


def test_the_residual_loss_of_an_untrained_network_is_the_velocitys_square(windows: ResidualWindows) -> None:
    """With samples that are the truth, v = (cos - sin) clean: by hand; turning and mirroring keep its square."""
    network = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2)))
    clean = windows.residual.clamp(-RESIDUAL_CLAMP, RESIDUAL_CLAMP)
    told = ResidualWindows(windows.context, clean, clean[:, None].expand_as(windows.sample))
    loss = residual_loss(network, told, torch.Generator().manual_seed(3)).item()
    g = torch.Generator().manual_seed(3)
    torch.randint(2, (len(clean),), generator=g)
    angle = torch.rand(len(clean), generator=g) * math.pi / 2
    expected = ((torch.cos(angle) - torch.sin(angle))[:, None, None] * clean).square().mean()
    assert loss == pytest.approx(float(expected), rel=1e-4)


def test_the_residual_loss_draws_from_its_generator_alone(windows: ResidualWindows) -> None:
    network = ResidualNetwork(ResidualNetworkConfig(width=8, multipliers=(1, 2)))
    nn.init.normal_(network.unet.head.weight)
    first, again, other = (residual_loss(network, windows, torch.Generator().manual_seed(s)).item() for s in (1, 1, 2))
    assert first == again != other and math.isfinite(first)
    with pytest.raises(TypeError, match="Linear"):
        residual_loss(nn.Linear(1, 1), windows, torch.Generator())
