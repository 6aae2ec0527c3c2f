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

_NUM_FEATURES = 3
_MIN_SIGMA = 1e-4


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
        drawn = None if noise is None else pack_padded_sequence(noise[order], count[order], batch_first=True).data
        sizes = packed.batch_sizes.tolist()
        code, moments, before = self._run(self.of_detection(packed.data), drawn, sizes)
        divergence = _divergence(moments, self.prior(before))
        row = torch.cat([torch.arange(size) for size in sizes])
        summed = divergence.new_zeros(len(inputs)).index_add(0, row, divergence)
        code = torch.cat([code[back], inputs.extra(self.history)], dim=-1)
        return self.decoder(code[:, None].expand(-1, len(self.horizons), -1)), summed[back]

    def _run(self, features: Tensor, noise: Tensor | None, sizes: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Through all detections, packed: step by step, the rows that still have one.

        Returns:
            (last latent feature, last state) of every row [R, 2 h]; the posterior's moments at every detection [P, 2 z]; the
            state before it [P, h].
        """
        h, z = self.config.hidden_size, self.config.latent_size
        of_features = functional.linear(features, self.posterior_in.weight[:, :h], self.posterior_in.bias)
        gates_of_features = functional.linear(features, self.recurrence_in.weight[:, :h])
        from_state = torch.cat([self.posterior_in.weight[:, h:], self.recurrence.weight]).t()
        from_latent = self.recurrence_in.weight[:, h:].t()
        out_weight, out_bias = self.posterior_out.weight.t(), self.posterior_out.bias
        state = features.new_zeros(sizes[0], h)
        before, moments, ended = [], [], []
        noises = [None] * len(sizes) if noise is None else list(torch.split(noise, sizes))
        steps = zip(
            torch.split(of_features, sizes), torch.split(gates_of_features, sizes), noises, [*sizes[1:], 0], strict=True
        )
        for of_feature, of_gates, drawn, left in steps:
            to_posterior, to_gates = torch.split(state @ from_state, [h, 3 * h], dim=1)
            hidden = functional.relu(self.posterior(functional.relu(of_feature + to_posterior)))
            moment = torch.addmm(out_bias, hidden, out_weight)
            latent = moment[:, :z]
            if drawn is not None:
                latent = latent + (functional.softplus(moment[:, z:]) + _MIN_SIGMA) * drawn
            feature = functional.relu(self.of_latent(latent))
            gates = torch.addmm(of_gates, feature, from_latent)
            reset, update = torch.sigmoid(gates[:, : 2 * h] + to_gates[:, : 2 * h]).chunk(2, dim=1)
            proposed = torch.tanh(gates[:, 2 * h :] + reset * to_gates[:, 2 * h :])
            before.append(state)
            moments.append(moment)
            state = torch.lerp(proposed, state, update)
            if left < len(state):
                ended.append(torch.cat([feature[left:], state[left:]], dim=1))
                state = state[:left]
        return torch.cat(ended[::-1]), torch.cat(moments), torch.cat(before)


def _divergence(posterior: Tensor, prior: Tensor) -> Tensor:
    """Of Gaussians given as (mean, sigma before the softplus) [P, 2 z], summed over z: [P]."""
    mean, raw = posterior.chunk(2, dim=-1)
    other_mean, other_raw = prior.chunk(2, dim=-1)
    sigma, other = functional.softplus(raw) + _MIN_SIGMA, functional.softplus(other_raw) + _MIN_SIGMA
    terms = 2.0 * (other / sigma).log() + (sigma.square() + (mean - other_mean).square()) / other.square() - 1.0
    return 0.5 * terms.sum(dim=-1)
