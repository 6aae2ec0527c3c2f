"""Samplers: plain functions of a denoiser (after k-diffusion's idea; Karras et al., 2022).

A denoiser takes a noisy trajectory and its noise level (an angle, see `schedule`) and returns the clean estimate. A sampler
does not know what a trajectory is: any shape, conditions and batching live in the denoiser. Hooks see the clean estimate
(guidance, inpainting) or the state after a step (the paper's overwriting).
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from cadence.schedule import MAX_ANGLE, Schedule, noise_from

Denoiser = Callable[[Tensor, float], Tensor]
"""(noisy [...], angle) -> clean estimate [...]."""
Hook = Callable[[Tensor, float], Tensor]
"""(estimate or state [...], angle it is at) -> the same, moved."""
Draw = Callable[[Tensor], Tensor]
"""state [...] -> standard normal noise of its shape: for windows that have a random stream each."""


def _keep(state: Tensor, angle: float) -> Tensor:
    return state


def sample_ddpm(
    denoise: Denoiser,
    noise: Tensor,
    schedule: Schedule,
    generator: torch.Generator | Draw,
    on_mean: Hook = _keep,
    on_state: Hook = _keep,
) -> Tensor:
    """Ancestral sampling with the fixed small variance (Ho et al., 2020, algorithm 2): the paper's procedure.

    Args:
        denoise: the denoiser; clamping its estimate is its own business.
        noise: [...] start, standard normal.
        schedule: S steps; all are taken.
        generator: of the noise added at each step, or a function that draws it.
        on_mean: moves the posterior mean before noise is added (the paper's algorithm 1).
        on_state: changes the state after each step (the paper's inpainting).
    """
    state = noise
    alpha_bar = schedule.alpha_bar.tolist()
    angles = schedule.angle.tolist()
    for s in range(len(schedule) - 1, -1, -1):
        clean = denoise(state, angles[s])
        before = alpha_bar[s - 1] if s else 1.0
        alpha = alpha_bar[s] / before
        beta = 1.0 - alpha
        scale = 1.0 / (1.0 - alpha_bar[s])
        mean = before**0.5 * beta * scale * clean + alpha**0.5 * (1.0 - before) * scale * state
        mean = on_mean(mean, angles[s])
        sigma = (beta * (1.0 - before) * scale) ** 0.5
        fresh = _fresh(state, generator) if s else 0.0
        state = on_state(mean + sigma * fresh, angles[s - 1] if s else 0.0)
    return state


def _fresh(state: Tensor, generator: torch.Generator | Draw) -> Tensor:
    if isinstance(generator, torch.Generator):
        return torch.randn(state.shape, generator=generator, dtype=state.dtype, device=state.device)
    return generator(state)


def sample_ddim(denoise: Denoiser, noise: Tensor, angles: Tensor, on_clean: Hook = _keep, on_state: Hook = _keep) -> Tensor:
    """Deterministic DDIM (Song et al., 2021): rotate the noise out, one evaluation a step.

    Args:
        denoise: the denoiser.
        noise: [...] start.
        angles: [S + 1] decreasing noise levels; the last is zero.
        on_clean: moves the clean estimate.
        on_state: changes the state after each step.
    """
    state = noise
    levels = angles.tolist()
    for here, there in itertools.pairwise(levels):
        clean = on_clean(denoise(state, here), here)
        state = _rotate(clean, noise_from(clean, state, torch.tensor(here)), there)
        state = on_state(state, there)
    return state


def sample_dpmpp_2m(denoise: Denoiser, noise: Tensor, angles: Tensor, on_clean: Hook = _keep, on_state: Hook = _keep) -> Tensor:
    """DPM-Solver++(2M) (Lu et al., 2022): second order from the previous clean estimate, one evaluation a step.

    Arguments as for `sample_ddim`. The first and the last step are of first order.
    """
    state = noise
    levels = angles.clamp(1e-4, MAX_ANGLE - 1e-3)
    log_snr = -torch.log(torch.tan(levels))
    previous: Tensor | None = None
    for s in range(len(levels) - 1):
        here, there = float(angles[s]), float(angles[s + 1])
        clean = on_clean(denoise(state, here), here)
        step = float(log_snr[s + 1] - log_snr[s])
        estimate = clean
        if previous is not None and there > 0.0:
            ratio = float(log_snr[s] - log_snr[s - 1]) / step
            estimate = (1.0 + 0.5 / ratio) * clean - 0.5 / ratio * previous
        if there <= 0.0:
            state = estimate
        else:
            sin_ratio = torch.sin(levels[s + 1]) / torch.sin(levels[s])
            state = float(sin_ratio) * state - float(torch.cos(levels[s + 1])) * math.expm1(-step) * estimate
        state = on_state(state, there)
        previous = clean
    return state


def sample_rotation(denoise: Denoiser, noise: Tensor, angles: Tensor, on_clean: Hook = _keep, on_state: Hook = _keep) -> Tensor:
    """The probability flow in the angle, dx/d(angle) = v, by two-step Adams-Bashforth, one evaluation a step.

    A velocity of zero leaves the start exactly as it is, whatever the number of steps (unlike DDIM, which shrinks it): the
    sampler of the residual model, whose start already is a sample of the bank (v as in Lu, Song, "TrigFlow", 2024). Arguments
    as for `sample_ddim`.
    """
    state = noise
    levels = angles.tolist()
    previous: Tensor | None = None
    step_before = 0.0
    for here, there in itertools.pairwise(levels):
        clean = on_clean(denoise(state, here), here)
        velocity = (torch.cos(torch.tensor(here)) * state - clean) / max(float(torch.sin(torch.tensor(here))), 1e-4)
        step = there - here
        slope = velocity
        if previous is not None:
            slope = velocity + 0.5 * step / step_before * (velocity - previous)
        state = on_state(state + step * slope, there)
        previous, step_before = velocity, step
    return state


def even_angles(num_steps: int, start: float = MAX_ANGLE) -> Tensor:
    """Evenly spaced noise levels [S + 1] from pure noise to none."""
    return torch.linspace(start, 0.0, num_steps + 1, dtype=torch.float64)


def even_log_snr(num_steps: int, start: float, end: float) -> Tensor:
    """Noise levels [S + 1] evenly spaced in the logarithm of signal over noise from `start` to `end`, then none.

    The variable in which DPM-Solver++ is of second order (Lu et al., 2022).
    """
    ends = torch.tensor([start, end], dtype=torch.float64)
    first, last = torch.log(torch.tan(ends)).tolist()
    levels = torch.atan(torch.exp(torch.linspace(first, last, num_steps, dtype=torch.float64)))
    return torch.cat([levels, levels.new_zeros(1)])


def _rotate(clean: Tensor, noise: Tensor, angle: float) -> Tensor:
    at = torch.tensor(angle)
    return torch.cos(at).to(clean.dtype) * clean + torch.sin(at).to(clean.dtype) * noise
