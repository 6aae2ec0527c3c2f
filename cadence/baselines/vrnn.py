"""VRNN: a variational recurrent network over the detections, with a mixture of Gaussians for what is asked.

Chung et al., "A Recurrent Latent Variable Model for Sequential Data" (NeurIPS 2015), a rival in Ye et al. (GrAMMI, IROS
2023): at every detection a latent variable is drawn from a posterior that sees the detection, and its divergence from a prior
that does not is part of the loss.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import pack_padded_sequence

from cadence.baselines.grammi import MixtureDecoder, check_horizons
from cadence.baselines.mixture import HORIZONS, HistoryConfig, MixtureInputs, RawMixture
from cadence.baselines.recurrence import previous_rows, run_recurrence, spread

_NUM_FEATURES = 3


def _without_trackers() -> HistoryConfig:
    return HistoryConfig(tracker_steps=0)


@dataclass(frozen=True)
class VrnnNetworkConfig:
    """Sizes and switches; the defaults are the published ones, except that one trunk serves all horizons.

    horizons       steps after the origin with a mixture each
    hidden_size    width of all layers, and state of the recurrence
    latent_size    latent variable of a detection
    num_gaussians  components of a mixture
    history        what is read; trackers never are
    """

    horizons: tuple[int, ...] = HORIZONS
    hidden_size: int = 32
    latent_size: int = 8
    num_gaussians: int = 4
    history: HistoryConfig = field(default_factory=_without_trackers)

    def __post_init__(self) -> None:
        check_horizons(self.horizons)
        if min(self.hidden_size, self.latent_size, self.num_gaussians) < 1:
            raise ValueError("hidden_size, latent_size and num_gaussians must be positive")
        if self.history.tracker_steps:
            raise ValueError("history.tracker_steps: the VRNN reads no trackers; set it to 0")


class VrnnNetwork(nn.Module):
    """Inputs to mixtures; see the module."""

    def __init__(self, config: VrnnNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.horizons, self.history = config.horizons, config.history
        h, z = config.hidden_size, config.latent_size
        self.of_detection = nn.Sequential(nn.Linear(_NUM_FEATURES, h), nn.ReLU(), nn.Linear(h, h), nn.ReLU())
        self.of_latent = nn.Linear(z, h)
        self.posterior_in = nn.Linear(2 * h, h)
        self.posterior = nn.Linear(h, h)
        self.posterior_out = nn.Linear(h, 2 * z)
        self.prior = nn.Sequential(nn.Linear(h, h), nn.ReLU(), nn.Linear(h, 2 * z))
        self.recurrence_in = nn.Linear(2 * h, 3 * h, bias=False)
        self.recurrence = nn.Linear(h, 3 * h, bias=False)
        self.decoder = MixtureDecoder(2 * h + config.history.num_extra, h, config.num_gaussians, len(config.horizons))

    @property
    def latent_size(self) -> int:
        """Numbers of noise that a detection takes."""
        return self.config.latent_size

    def forward(self, inputs: MixtureInputs, noise: Tensor | None = None) -> RawMixture:
        """The mixtures [R, H, G]; noise [R, N, latent_size] standard normal, None: latent variables at their mean."""
        return self.forward_with_divergence(inputs, noise)[0]

    def forward_with_divergence(self, inputs: MixtureInputs, noise: Tensor | None = None) -> tuple[RawMixture, Tensor]:
        """The mixtures, and the divergence of posterior from prior summed over a window's detections [R], nats."""
        count = inputs.is_observed.sum(dim=1)
        order = torch.argsort(count, descending=True, stable=True)
        back = torch.argsort(order)
        packed = pack_padded_sequence(inputs.rows[order], count[order], batch_first=True)
        sizes = packed.batch_sizes.tolist()
        drawn = packed.data.new_zeros(len(packed.data), self.latent_size)
        if noise is not None:
            drawn = pack_padded_sequence(noise[order], count[order], batch_first=True).data
        moments, features, states = self._run(self.of_detection(packed.data), drawn, sizes)
        before = torch.cat([states.new_zeros(sizes[0], states.shape[1]), states[previous_rows(sizes)]])
        divergence = _divergence(moments, self.prior(before))
        row = torch.cat([torch.arange(size) for size in sizes])
        summed = divergence.new_zeros(len(inputs)).index_add(0, row, divergence)
        begin = torch.tensor([0, *sizes]).cumsum(0)
        last = (begin[count[order] - 1] + torch.arange(len(inputs)))[back]
        code = torch.cat([features[last], states[last], inputs.extra(self.history)], dim=-1)
        return self.decoder(code[:, None].expand(-1, len(self.horizons), -1)), summed[back]

    def _run(self, features: Tensor, noise: Tensor, sizes: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Through all detections, packed: the posterior's moments [P, 2 z], features of latents [P, h], states after [P, h]."""
        h = self.config.hidden_size
        of_features = functional.linear(features, self.posterior_in.weight[:, :h], self.posterior_in.bias)
        gates_of_features = functional.linear(features, self.recurrence_in.weight[:, :h])
        weights = (
            torch.cat([self.posterior_in.weight[:, h:], self.recurrence.weight]).t(),
            self.posterior.weight.t(),
            self.posterior.bias,
            self.posterior_out.weight.t(),
            self.posterior_out.bias,
            self.of_latent.weight.t(),
            self.of_latent.bias,
            self.recurrence_in.weight[:, h:].t(),
        )
        return run_recurrence(of_features, gates_of_features, noise, weights, sizes)


def _divergence(posterior: Tensor, prior: Tensor) -> Tensor:
    """Of Gaussians given as (mean, sigma before the softplus) [P, 2 z], summed over z: [P]."""
    mean, raw = posterior.chunk(2, dim=-1)
    other_mean, other_raw = prior.chunk(2, dim=-1)
    sigma, other = spread(raw), spread(other_raw)
    terms = 2.0 * (other / sigma).log() + (sigma.square() + (mean - other_mean).square()) / other.square() - 1.0
    return 0.5 * terms.sum(dim=-1)
