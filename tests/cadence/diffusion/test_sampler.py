"""Samplers on a Gaussian, whose denoiser and probability flow are known in closed form."""

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cadence.diffusion.sampler import even_angles, sample_ddim, sample_ddpm, sample_dpmpp_2m, sample_rotation
from cadence.schedule import MAX_ANGLE, clean_from, cosine_schedule

MEAN, SIGMA = 1.5, 0.4
DETERMINISTIC = {"ddim": sample_ddim, "dpmpp": sample_dpmpp_2m, "rotation": sample_rotation}
NOISE = torch.linspace(-2.0, 2.0, 9, dtype=torch.float64)


def denoise(state: Tensor, angle: float) -> Tensor:
    """E[clean | state] where clean is normal (MEAN, SIGMA)."""
    cos, sin = math.cos(angle), math.sin(angle)
    return MEAN + SIGMA**2 * cos / (SIGMA**2 * cos**2 + sin**2) * (state - cos * MEAN)


def flow_start(angle: float) -> Tensor:
    """Where the probability flow that ends in MEAN + SIGMA * NOISE is at `angle`."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * MEAN + math.sqrt(SIGMA**2 * cos**2 + sin**2) * NOISE


def error(sampler: Callable[..., Tensor], num_steps: int, start: float = MAX_ANGLE - 0.02) -> float:
    got = sampler(denoise, flow_start(start), even_angles(num_steps, start))
    return float((got - (MEAN + SIGMA * NOISE)).abs().max())


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_the_flow_ends_in_the_gaussian(name: str) -> None:
    assert error(DETERMINISTIC[name], 400) < 0.02
    assert error(DETERMINISTIC[name], 400, MAX_ANGLE) < 0.02


@pytest.mark.parametrize(("name", "order"), [("ddim", 1.0), ("rotation", 2.0), ("dpmpp", 2.0)])
def test_order_of_convergence(name: str, order: float) -> None:
    """Away from the ends of the scale, where DPM-Solver++ takes steps of first order over an infinite range of log SNR."""
    start, end, errors = 1.2, 0.3, []
    for num_steps in (32, 64, 128):
        angles = torch.linspace(start, end, num_steps + 1, dtype=torch.float64)
        errors.append(float((DETERMINISTIC[name](denoise, flow_start(start), angles) - flow_start(end)).abs().max()))
    got = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert got == pytest.approx([order, order], abs=0.25)


def test_second_order_beats_first_order() -> None:
    for num in (8, 16, 32):
        assert max(error(sample_dpmpp_2m, num), error(sample_rotation, num)) < 0.6 * error(sample_ddim, num)


def test_ddpm_draws_the_gaussian() -> None:
    num = 20_000
    g = torch.Generator().manual_seed(0)
    start = torch.randn(num, generator=g, dtype=torch.float64)
    got = sample_ddpm(denoise, start, cosine_schedule(100), g)
    assert float(got.mean()) == pytest.approx(MEAN, abs=4.0 * SIGMA / math.sqrt(num) + 0.01)
    assert float(got.std()) == pytest.approx(SIGMA, rel=0.05)  # the small variance is a little too small
    assert abs(float(torch.corrcoef(torch.stack([got, start]))[0, 1])) < 0.05


def test_ddpm_variance_is_the_recursion_and_converges() -> None:
    """The sampler is affine here: its variance follows exactly from the coefficients of algorithm 2."""
    for num_steps, tolerance in ((100, 0.05), (1000, 0.006)):
        schedule = cosine_schedule(num_steps)
        bars = [1.0, *schedule.alpha_bar.tolist()]
        variance = 1.0
        for s in range(num_steps, 0, -1):
            bar, before = bars[s], bars[s - 1]
            alpha = bar / before
            slope = SIGMA**2 * math.sqrt(bar) / (SIGMA**2 * bar + 1 - bar)
            factor = (math.sqrt(before) * (1 - alpha) * slope + math.sqrt(alpha) * (1 - before)) / (1 - bar)
            variance = factor**2 * variance + (1 - before) / (1 - bar) * (1 - alpha)
        assert math.sqrt(variance) == pytest.approx(SIGMA, rel=tolerance)
        if num_steps == 100:
            g = torch.Generator().manual_seed(1)
            drawn = sample_ddpm(denoise, torch.randn(20_000, generator=g, dtype=torch.float64), schedule, g)
            assert float(drawn.std()) == pytest.approx(math.sqrt(variance), rel=0.025)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_steps", [1, 3, 8])
def test_no_velocity_leaves_the_start_as_it_is(dtype: torch.dtype, num_steps: int) -> None:
    start = torch.randn(4, 6, 2, generator=torch.Generator().manual_seed(0), dtype=dtype)

    def still(state: Tensor, angle: float) -> Tensor:
        return clean_from("v", torch.zeros_like(state), state, torch.tensor(angle))

    assert torch.equal(sample_rotation(still, start, even_angles(num_steps)), start)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_one_step_from_pure_noise_is_close_to_the_mean(name: str) -> None:
    """All that one evaluation at pure noise can know is the mean of the clean law (the rotation keeps its start's spread)."""
    got = DETERMINISTIC[name](denoise, NOISE, even_angles(1))
    want = NOISE + MAX_ANGLE * MEAN if name == "rotation" else torch.full_like(NOISE, MEAN)
    torch.testing.assert_close(got, want, rtol=0, atol=1e-2)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_a_known_clean_trajectory_is_reached_exactly(name: str) -> None:
    target = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    start = torch.randn(3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    got = DETERMINISTIC[name](lambda state, angle: target, start, even_angles(200))
    torch.testing.assert_close(got, target, rtol=0, atol=2e-2 if name == "rotation" else 1e-3)


@pytest.mark.parametrize("name", DETERMINISTIC)
def test_hooks_move_the_clean_estimate_and_the_state(name: str) -> None:
    levels: list[float] = []

    def on_clean(clean: Tensor, angle: float) -> Tensor:
        levels.append(angle)
        return torch.zeros_like(clean)

    def on_state(state: Tensor, angle: float) -> Tensor:
        state = state.clone()
        state[0] = 7.0
        return state

    angles = even_angles(5)
    got = DETERMINISTIC[name](denoise, NOISE, angles, on_clean, on_state)
    assert levels == angles[:-1].tolist()
    assert float(got[0]) == 7.0
    assert float(got[1:].abs().max()) < 1.0  # drawn to the clean estimate that the hook put there


def test_ddpm_hooks_and_determinism() -> None:
    def clamp(state: Tensor, angle: float) -> Tensor:
        return torch.cat([torch.full_like(state[:1], 7.0), state[1:]])

    def draw(seed: int) -> Tensor:
        return sample_ddpm(denoise, NOISE, cosine_schedule(20), torch.Generator().manual_seed(seed), on_state=clamp)

    assert float(draw(0)[0]) == 7.0
    assert torch.equal(draw(0), draw(0))
    assert not torch.equal(draw(0), draw(1))
    g = torch.Generator().manual_seed(0)
    still = sample_ddpm(denoise, NOISE, cosine_schedule(20), g, on_mean=lambda mean, angle: torch.zeros_like(mean))
    assert not still.any()  # no noise is added in the last step


def test_even_angles() -> None:
    assert even_angles(4).tolist() == pytest.approx([MAX_ANGLE * share for share in (1.0, 0.75, 0.5, 0.25, 0.0)])
