"""The paper's procedure in the residual's coordinates, because the shipped network works there; its costs one by one."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.sampler_cases import Case, bank_context
from cadence.bank.bank import BankPosterior
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.diffusion.guidance import PaperCost, adam_guidance
from cadence.diffusion.sampler import sample_ddpm
from cadence.network.residual import ResidualNetwork
from cadence.network.residual_context import ResidualContext
from cadence.schedule import clean_from, cosine_schedule
from cadence.types import HypothesisSet

NUM_STEPS, ITERATIONS, LEARNING_RATE = 100, 8, 1e-2
POOL = 64
"""Samples of the bank a window from which the steps of DDPM take their fresh noise."""


@dataclass(frozen=True)
class Paper:
    """The paper's procedure in the residual's coordinates, with its costs switched on one by one.

    encode_each_step  read the detections again for every hypothesis at every step
    is_guided         algorithm 1 on every posterior mean
    overwrite         set the step at the origin to what was detected there, clean, after every step
    seconds           processor time that the sampling of each call took
    """

    encode_each_step: bool = True
    is_guided: bool = True
    overwrite: bool = True
    seconds: list[float] = dataclasses.field(default_factory=list)

    def __call__(self, case: Case) -> HypothesisSet:
        """Hypotheses for all windows of a case."""
        posterior, context = bank_context(case)
        begin = time.process_time()
        residual = self.draw(case, posterior, context, bank_noise(case))
        self.seconds.append(time.process_time() - begin)
        position = posterior.mean_m[:, None] + posterior.sigma_m[:, None, :, None] * residual.double()
        return scatter_hypotheses(position, case.windows.batch)

    def draw(self, case: Case, posterior: BankPosterior, context: ResidualContext, pool: Tensor) -> Tensor:
        """Residuals [R, K, T, 2] by DDPM; fresh noise is drawn from the bank's further samples `pool` [R, P, T, 2]."""
        network = case.model.network
        assert network is not None
        num_rows, num_hypotheses = posterior.sample_m.shape[:2]
        generator = torch.Generator().manual_seed(0)
        each = torch.arange(num_rows)[:, None]

        def fresh(state: Tensor) -> Tensor:
            return pool[each, torch.randint(POOL, (num_rows, num_hypotheses), generator=generator)]

        with torch.inference_mode():
            denoise = denoiser(network, context, num_hypotheses, self.encode_each_step)
        mean, sigma = posterior.mean_m[:, None], posterior.sigma_m[:, None, :, None]
        cost = PaperCost(case.obstacles, case.unit_m, offset_m=case.datum_m)

        def guide(state: Tensor, angle: float) -> Tensor:
            return adam_guidance(state, lambda r: cost.cost(mean + sigma * r), LEARNING_RATE, ITERATIONS)

        known, is_known = detected_at_origin(case, posterior)

        def overwrite(state: Tensor, angle: float) -> Tensor:
            return torch.where(is_known, known, state)

        start = to_residual(posterior.sample_m, posterior)
        with torch.no_grad():
            return sample_ddpm(
                denoise,
                start,
                cosine_schedule(NUM_STEPS),
                fresh,
                on_mean=guide if self.is_guided else unmoved,
                on_state=overwrite if self.overwrite else unmoved,
            )


def denoiser(
    network: ResidualNetwork, context: ResidualContext, num_hypotheses: int, encode_each_step: bool
) -> Callable[[Tensor, float], Tensor]:
    """The network as a denoiser of residuals [R, K, T, 2]; detections read once a window, or for each hypothesis and call."""
    wide = context.repeated(num_hypotheses)
    once = network.encode(context).repeat_interleave(num_hypotheses, dim=0)

    @torch.inference_mode()
    def denoise(state: Tensor, angle: float) -> Tensor:
        flat = state.flatten(0, 1)
        code = network.encode(wide) if encode_each_step else once
        velocity = network(flat, torch.full((len(flat),), angle), wide, code)
        return clean_from("v", velocity, flat, torch.tensor(angle)).view_as(state)

    return denoise


def unmoved(state: Tensor, angle: float) -> Tensor:
    """No guidance, no overwriting."""
    return state


def to_residual(position_m: Tensor, posterior: BankPosterior) -> Tensor:
    """Positions [R, K, T, 2] in units of the bank's uncertainty."""
    return ((position_m - posterior.mean_m[:, None]) / posterior.sigma_m[:, None, :, None]).float()


_POOLS: dict[int, Tensor] = {}


def bank_noise(case: Case) -> Tensor:
    """Further samples of the bank [R, POOL, T, 2], as residuals: the noise that the network was trained with.

    Made once a case and left out of all times, in the paper's favour: its own noise, white, costs next to nothing.
    """
    if id(case) not in _POOLS:
        batch = case.windows.batch
        other = dataclasses.replace(batch, seeds=batch.seeds + 1)
        posterior = case.model.bank.posterior(other, POOL)
        _POOLS[id(case)] = to_residual(posterior.sample_m, posterior)
    return _POOLS[id(case)]


def detected_at_origin(case: Case, posterior: BankPosterior) -> tuple[Tensor, Tensor]:
    """The residual of what was detected within half a step of the origin [R, 1, T, 2], and the cells that it fills."""
    batch = case.windows.batch
    rows, _ = active_rows(batch)
    last = (rows.is_observed.sum(1) - 1).clamp_min(0)
    each = torch.arange(len(last))
    position = rows.position_m[each, last][:, None]
    is_seen = rows.time_s[each, last] >= -0.5 * batch.step_s
    is_origin = torch.arange(batch.num_steps) == batch.origin_index
    known = ((position - posterior.mean_m) / posterior.sigma_m[..., None]).float()[:, None]
    return known, (is_seen[:, None] & is_origin)[:, None, :, None]
