"""The general preset as an estimator: bank, then diffusion of the residual, then constraints.

No detection enters twice: the bank is conditioned on them, and the network only reshapes what the bank says in units of
the bank's own uncertainty, which vanishes where something was seen.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from cadence.bank.bank import Bank, BankPosterior
from cadence.bank.plausible import TopSpeed
from cadence.bank.pool import BankPool
from cadence.bank.rows import active_rows, scatter_hypotheses, with_status
from cadence.diffusion.feasible import Feasibility, redrawn, resampled
from cadence.diffusion.sampler import even_angles, sample_ddim, sample_dpmpp_2m, sample_rotation
from cadence.diffusion.settings import GuidanceConfig, SamplerName
from cadence.diffusion.transport import bend_of, smoothed_displacement
from cadence.network.residual import ResidualNetwork
from cadence.network.residual_context import ResidualContext, build_context
from cadence.schedule import clean_from
from cadence.types import Detections, HypothesisSet, WindowBatch

_SAMPLERS = {"rotation": sample_rotation, "ddim": sample_ddim, "dpmpp": sample_dpmpp_2m}

_MAX_BATCH = 960
_RAMP_STEPS = 8.0

_ENOUGH = 0.5
"""Where a smaller share of the hypotheses keeps the limits more are drawn: a few, drawn again and again, would look certain."""
_MORE = 8
_FEW = 0.5
"""A row in which fewer tracks, of all that were drawn, can be kept than this share of its hypotheses has too little spread."""

CleanHook = Callable[[Tensor, Tensor, slice], Tensor]
"""(positions [R', K, T, 2] in metres, sigma [R', T], which R' of the active rows) -> positions: guidance of clean estimates."""


@dataclass(frozen=True)
class GateScores:
    """Energy scores of the network over the bank's, on detections withheld from both; None where there were too few."""

    past_network: float | None
    future_network: float | None


@dataclass(frozen=True, eq=False)
class _Rows:
    """Tracks of R active agents.

    position_m  [R, K, T, 2]
    weight      [R, K] by how far they had to be moved
    is_kept     [R, K] they keep the limits
    is_finite   [R] sampling stayed finite
    num_kept    [R] of all draws that these were chosen from
    """

    position_m: Tensor
    weight: Tensor
    is_kept: Tensor
    is_finite: Tensor
    num_kept: Tensor


@dataclass(frozen=True, eq=False)
class GeneralModel:
    """Bank and residual network; `sample` draws joint hypotheses of past and future that keep the constraints.

    bank       fitted to the log
    network    trained; without one the bank's samples are returned as they are
    sampler    "rotation", "ddim" or "dpmpp"
    num_steps  evaluations of the network for each hypothesis
    guidance   how constraints act: a speed limit, and the obstacles of the windows' context
    top_speed  what the log's detections show of how fast its targets are at most; no track is faster, but a little on ways
               round obstacles
    is_smooth  what the network adds to a track of the bank is smoothed (`cadence.diffusion.transport`)
    share_past, share_future  share of the hypotheses that the network moves, up to the origin and after it; the others stay
               samples of the bank
    bf16       network in bfloat16: about twice as fast where the processor knows it
    device     of the network; the bank works on the processor
    gate       what decided the strengths, or None
    """

    bank: Bank | BankPool
    network: ResidualNetwork | None
    sampler: SamplerName = "rotation"
    num_steps: int = 6
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    top_speed: TopSpeed | None = None
    is_smooth: bool = True
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
        """Draw hypotheses for every active agent; deterministic in the windows' seeds.

        The status of an agent is "guidance_diverged" where samples of the bank had to stand in, "infeasible" where no
        hypothesis could be brought within the limits: they are as they were. Where few could, more are drawn, and where
        few of these can be kept as well, it is "scarce".
        """
        found = self._drawn(windows, num_hypotheses)
        is_short = found.is_kept.double().mean(1) < _ENOUGH
        if bool(is_short.any()):
            found = self._drawn_anew(found, windows, is_short)
        is_scarce = (found.num_kept < _FEW * num_hypotheses) & (found.num_kept > 0)
        # Weights belong to one agent's tracks; a joint hypothesis of several has but one.
        seeds, are_all = active_rows(windows)[1], windows.num_agents > 1
        kept_m, is_even = redrawn(found.position_m, found.weight, found.is_kept, seeds, are_all)
        drawn = scatter_hypotheses(kept_m, windows)
        if windows.num_agents == 1:
            weight = drawn.weight.clone()
            weight[windows.is_active[:, 0]] = torch.where(is_even[:, None], 1.0 / num_hypotheses, found.weight)
            drawn = HypothesisSet(drawn.position_m, weight, drawn.status)
        words = {"guidance_diverged": ~found.is_finite, "infeasible": found.num_kept == 0, "scarce": is_scarce}
        return with_status(drawn, windows, words)

    def _drawn(self, windows: WindowBatch, num_hypotheses: int) -> "_Rows":
        """Tracks of the active agents as near to the limits as they can be brought."""
        plausible_mps = None if self.top_speed is None else self.top_speed.spread(num_hypotheses)
        limits = Feasibility.of(windows, self.guidance, plausible_mps)
        posterior = self.bank.posterior(windows, num_hypotheses)
        is_guided = self.guidance.mode == "clean" and limits.is_stated
        sample_m = self.denoised(posterior, windows, limits.guide if is_guided else None)
        is_finite = torch.isfinite(sample_m).flatten(1).all(1)
        sample_m = torch.where(is_finite[:, None, None, None], sample_m, posterior.sample_m)
        moved_m, weight, is_kept = limits.finish(sample_m, posterior.sigma_m, self.bank.length_m(windows.step_s))
        return _Rows(moved_m, weight, is_kept, is_finite, is_kept.sum(1))

    def _drawn_anew(self, found: "_Rows", windows: WindowBatch, is_short: Tensor) -> "_Rows":
        """The rows that are short of tracks [R], chosen from many more draws; where none of these can be kept, as they were."""
        window, num_hypotheses = windows.is_active.nonzero()[:, 0], found.weight.shape[1]
        chosen = torch.tensor(sorted(set(window[is_short].tolist())))
        more = self._drawn(windows[chosen], _MORE * num_hypotheses)
        place = torch.isin(window, chosen).nonzero()[:, 0]  # of the rows of `more` among all
        is_better = is_short[place] & (more.num_kept > 0)
        rows, chance = place[is_better], torch.where(more.is_kept, more.weight, 0.0)[is_better]
        seeds = active_rows(windows)[1][rows]
        anew = dataclasses.replace(found, **{name: value.clone() for name, value in vars(found).items()})
        chance = chance / chance.sum(1, keepdim=True)
        anew.position_m[rows] = resampled(more.position_m[is_better], chance, seeds, num_hypotheses)
        anew.weight[rows], anew.is_kept[rows] = 1.0 / num_hypotheses, True
        anew.is_finite[rows], anew.num_kept[rows] = more.is_finite[is_better], more.num_kept[is_better]
        return anew

    def denoised(self, posterior: BankPosterior, windows: WindowBatch, guide: CleanHook | None = None) -> Tensor:
        """The bank's samples as the network moves them [R, K, T, 2], clean estimates led by `guide`; no repair."""
        if self.network is None or len(posterior.sample_m) == 0 or self.share_past == self.share_future == 0.0:
            return posterior.sample_m
        rows, _ = active_rows(windows)
        length_m = self.bank.length_m(windows.step_s)
        context = build_context(posterior, rows, windows.time_s, windows.step_s, length_m)
        residual = self._denoise(posterior, context, guide)
        moved_m = posterior.mean_m[:, None] + posterior.sigma_m[:, None, :, None] * residual.double()
        if not self.is_smooth:
            return moved_m
        added_m = smoothed_displacement(moved_m - posterior.sample_m, posterior.sigma_m, bend_of(posterior.sample_m))
        smooth_m = posterior.sample_m + added_m
        # Smoothing takes back a part of what guidance did.
        return smooth_m if guide is None else guide(smooth_m, posterior.sigma_m, slice(None))

    @torch.inference_mode()
    def _denoise(self, posterior: BankPosterior, context: ResidualContext, guide: CleanHook | None) -> Tensor:
        noise = ((posterior.sample_m - posterior.mean_m[:, None]) / posterior.sigma_m[:, None, :, None]).float()
        num_rows, num_hypotheses = noise.shape[:2]
        chunk = max(1, _MAX_BATCH // num_hypotheses)
        parts = [
            self._denoise_rows(noise[begin : begin + chunk], context[begin : begin + chunk], posterior, begin, guide)
            for begin in range(0, num_rows, chunk)
        ]
        return torch.cat(parts)

    def _denoise_rows(
        self, noise: Tensor, context: ResidualContext, posterior: BankPosterior, begin: int, guide: CleanHook | None
    ) -> Tensor:
        network = self.network
        assert network is not None
        num_rows, num_hypotheses = noise.shape[:2]
        context = context.to(self.device)
        rows = slice(begin, begin + num_rows)
        mean, sigma = posterior.mean_m[rows, None], posterior.sigma_m[rows]
        part = self._part(num_hypotheses, context)
        is_moved = self.moves(num_hypotheses)  # the others stay samples of the bank: the network need not be asked
        num_moved = int(is_moved.sum())
        code = network.encode(context).repeat_interleave(num_moved, dim=0)
        wide, share = context.repeated(num_moved), part[is_moved].repeat(num_rows, 1, 1)

        def denoise(state: Tensor, angle: float) -> Tensor:
            level = torch.full((len(code),), angle, device=state.device)
            asked = state.view(num_rows, num_hypotheses, -1, 2)[:, is_moved]
            velocity = torch.zeros_like(state).view(num_rows, num_hypotheses, -1, 2)
            with torch.autocast(torch.device(self.device).type, dtype=torch.bfloat16, enabled=self.bf16):
                answer = network(asked.flatten(0, 1), level, wide, code).float()
            velocity[:, is_moved] = (share * answer).view(asked.shape)
            return clean_from("v", velocity.view(state.shape), state, torch.tensor(angle))

        def guided(clean: Tensor, angle: float) -> Tensor:
            if guide is None:
                return clean
            scale = sigma[:, None, :, None]
            position = mean + scale * clean.view(num_rows, num_hypotheses, -1, 2).cpu().double()
            moved = (guide(position, sigma, rows) - mean) / scale
            return moved.float().flatten(0, 1).to(clean.device)

        start = noise.flatten(0, 1).to(self.device)
        result = _SAMPLERS[self.sampler](denoise, start, even_angles(self.num_steps), guided)
        return result.cpu().view(num_rows, num_hypotheses, -1, 2)

    def with_shares(self, share: float) -> "GeneralModel":
        """The model whose network moves this share of the hypotheses, in past and future."""
        return dataclasses.replace(self, share_past=share, share_future=share)

    def moves(self, num_hypotheses: int) -> Tensor:
        """Which hypotheses [K] the network moves anywhere; the others are samples of the bank."""
        past, future = self._shared_out(num_hypotheses)
        return (past + future) > 0

    def _shared_out(self, num_hypotheses: int) -> tuple[Tensor, Tensor]:
        """One for the hypotheses that the network moves in the past, and in the future, else zero: [K] each."""
        number = torch.arange(num_hypotheses + 1, dtype=torch.float64)
        past, future = (torch.diff((number * share).floor()) for share in (self.share_past, self.share_future))
        return past, future

    def _part(self, num_hypotheses: int, context: ResidualContext) -> Tensor:
        """Factor of the network's answer [K, T, 1]: one for its share of the hypotheses, with a ramp at the origin."""
        steps = torch.arange(context.is_future.shape[1], device=context.mean.device) - (~context.is_future[0]).sum() + 0.5
        later = (0.5 + steps / _RAMP_STEPS).clamp(0.0, 1.0)
        past, future = (share.to(steps.device) for share in self._shared_out(num_hypotheses))
        return (past[:, None] * (1.0 - later) + future[:, None] * later)[..., None].float()
