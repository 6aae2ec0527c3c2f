"""The general preset as an estimator: bank, then diffusion of the residual, then constraints.

No detection enters twice: the bank is conditioned on them, and the network only reshapes what the bank says in units of
the bank's own uncertainty, which vanishes where something was seen.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.bank.bank import Bank, BankPosterior
from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.diffusion.residual import ResidualContext, build_context
from cadence.diffusion.sampler import even_angles, sample_ddim, sample_dpmpp_2m, sample_rotation
from cadence.diffusion.schedule import clean_from
from cadence.network.residual import ResidualNetwork
from cadence.types import Detections, HypothesisSet, WindowBatch

_SAMPLERS = {"rotation": sample_rotation, "ddim": sample_ddim, "dpmpp": sample_dpmpp_2m}
_MAX_BATCH = 960
_RAMP_STEPS = 8.0

CleanHook = Callable[[Tensor, Tensor, slice], Tensor]
"""(positions [R', K, T, 2] in metres, sigma [R', T], which R' of the active rows) -> positions: guidance of clean estimates."""


@dataclass(frozen=True)
class GateScores:
    """Energy scores over the bank's, on detections withheld from both: of the network alone, and of half and half.

    None where too little could be withheld.
    """

    past_network: float | None
    past_half: float | None
    future_network: float | None
    future_half: float | None


@dataclass(frozen=True, eq=False)
class GeneralModel:
    """Bank and residual network; `sample` draws joint hypotheses of past and future.

    bank       fitted to the log
    network    trained; without one the bank's samples are returned as they are
    sampler    "rotation", "ddim" or "dpmpp"
    num_steps  evaluations of the network for each hypothesis
    guide      moves clean estimates, or None
    share_past, share_future  share of the hypotheses that the network moves, up to the origin and after it; the others stay
               samples of the bank
    bf16       network in bfloat16: about twice as fast where the processor knows it
    device     of the network; the bank works on the processor
    gate       what decided the strengths, or None
    """

    bank: Bank
    network: ResidualNetwork | None
    sampler: str = "rotation"
    num_steps: int = 6
    guide: CleanHook | None = None
    share_past: float = 1.0
    share_future: float = 1.0
    bf16: bool = False
    device: str = "cpu"
    gate: GateScores | None = None
    name: str = "cadence"

    def fit(self, tracks: Detections, step_s: float | None = None) -> "GeneralModel":
        """The model with its bank fitted to a log's detections."""
        return dataclasses.replace(self, bank=self.bank.fit(tracks, step_s))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Draw hypotheses for every active agent; deterministic in the windows' seeds."""
        rows, _ = active_rows(windows)
        posterior = self.bank.posterior(windows, num_hypotheses)
        if self.network is None or len(rows.time_s) == 0 or self.share_past == self.share_future == 0.0:
            return scatter_hypotheses(posterior.sample_m, windows)
        length_m = self.bank.length_m(windows.step_s)
        context = build_context(posterior, rows, windows.time_s, windows.step_s, length_m)
        residual = self._denoise(posterior, context)
        position = posterior.mean_m[:, None] + posterior.sigma_m[:, None, :, None] * residual.double()
        return scatter_hypotheses(position, windows)

    @torch.inference_mode()
    def _denoise(self, posterior: BankPosterior, context: ResidualContext) -> Tensor:
        noise = ((posterior.sample_m - posterior.mean_m[:, None]) / posterior.sigma_m[:, None, :, None]).float()
        num_rows, num_hypotheses = noise.shape[:2]
        chunk = max(1, _MAX_BATCH // num_hypotheses)
        parts = [
            self._denoise_rows(noise[begin : begin + chunk], context[begin : begin + chunk], posterior, begin)
            for begin in range(0, num_rows, chunk)
        ]
        return torch.cat(parts)

    def _denoise_rows(self, noise: Tensor, context: ResidualContext, posterior: BankPosterior, begin: int) -> Tensor:
        network = self.network
        assert network is not None
        num_rows, num_hypotheses = noise.shape[:2]
        context = context.to(self.device)
        code = network.encode(context).repeat_interleave(num_hypotheses, dim=0)
        wide = context.repeated(num_hypotheses)
        rows = slice(begin, begin + num_rows)
        mean, sigma = posterior.mean_m[rows, None], posterior.sigma_m[rows]
        part = self._part(num_hypotheses, context).repeat(num_rows, 1, 1)

        def denoise(state: Tensor, angle: float) -> Tensor:
            level = torch.full((len(state),), angle, device=state.device)
            with torch.autocast(torch.device(self.device).type, dtype=torch.bfloat16, enabled=self.bf16):
                velocity = part * network(state, level, wide, code).float()
            return clean_from("v", velocity, state, torch.tensor(angle))

        def guide(clean: Tensor, angle: float) -> Tensor:
            if self.guide is None:
                return clean
            scale = sigma[:, None, :, None]
            position = mean + scale * clean.view(num_rows, num_hypotheses, -1, 2).cpu().double()
            moved = (self.guide(position, sigma, rows) - mean) / scale
            return moved.float().flatten(0, 1).to(clean.device)

        start = noise.flatten(0, 1).to(self.device)
        result = _SAMPLERS[self.sampler](denoise, start, even_angles(self.num_steps), guide)
        return result.cpu().view(num_rows, num_hypotheses, -1, 2)

    def _part(self, num_hypotheses: int, context: ResidualContext) -> Tensor:
        """Factor of the network's answer [K, T, 1]: one for its share of the hypotheses, with a ramp at the origin."""
        steps = torch.arange(context.is_future.shape[1], device=context.mean.device) - (~context.is_future[0]).sum() + 0.5
        later = (0.5 + steps / _RAMP_STEPS).clamp(0.0, 1.0)
        number = torch.arange(num_hypotheses + 1, dtype=torch.float64, device=steps.device)
        past, future = (torch.diff((number * share).floor()) for share in (self.share_past, self.share_future))
        return (past[:, None] * (1.0 - later) + future[:, None] * later)[..., None].float()
