"""GrAMMI: graph-based adversarial modeling with mutual information, with and without the mutual information.

Ye et al., "Learning Models of Adversarial Agent Behavior under Partial Observability" (IROS 2023): an LSTM over the detections,
an LSTM over every tracker's track with two graph convolutions over the complete graph of trackers, and a mixture of Gaussians
whose components are one network's answers to a one-hot code. The mutual information is bounded from below by a posterior
that has to name the component from its parameters.
"""

import itertools
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

from cadence.baselines.mixture import HORIZONS, HistoryConfig, MixtureInputs, RawMixture, encode_sequences
from cadence.network.encoder import DetectionEncoder

_NUM_FEATURES = 3
_NUM_PARAMETERS = 5
"""Of a component: logit, mean x and y, sigma x and y."""
_MIN_LOG_SIGMA = -9.0
"""Exact detections would let a sigma fall without end."""


@dataclass(frozen=True)
class GrammiNetworkConfig:
    """Sizes and switches; the defaults are the published ones, except that one trunk serves all horizons.

    horizons       steps after the origin with a mixture each
    hidden_size    state of the LSTMs, and width of the decoder
    graph_size     width after the first graph convolution
    tracker_size   width after the second, averaged over the trackers
    num_gaussians  components of a mixture
    shared_trunk   one encoder for all horizons; off: one for each, which makes a model a horizon, as published
    mutual_information  the posterior belongs to the network
    posterior_size      its width
    history        what is read
    """

    horizons: tuple[int, ...] = HORIZONS
    hidden_size: int = 32
    graph_size: int = 16
    tracker_size: int = 8
    num_gaussians: int = 4
    shared_trunk: bool = True
    mutual_information: bool = False
    posterior_size: int = 16
    history: HistoryConfig = field(default_factory=HistoryConfig)

    def __post_init__(self) -> None:
        check_horizons(self.horizons)
        if min(self.hidden_size, self.graph_size, self.tracker_size, self.num_gaussians, self.posterior_size) < 1:
            raise ValueError("hidden_size, graph_size, tracker_size, num_gaussians and posterior_size must be positive")


def check_horizons(horizons: tuple[int, ...]) -> None:
    """Raises ValueError unless the horizons rise from zero or later."""
    if not horizons or horizons[0] < 0 or any(b <= a for a, b in itertools.pairwise(horizons)):
        raise ValueError(f"horizons are {horizons}, expected rising steps after the origin")


class GrammiNetwork(nn.Module):
    """Inputs to mixtures; see the module."""

    def __init__(self, config: GrammiNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.horizons, self.history = config.horizons, config.history
        self.trunks = nn.ModuleList(_Trunk(config) for _ in range(1 if config.shared_trunk else len(config.horizons)))
        size = config.hidden_size + config.tracker_size * (config.history.tracker_steps > 0) + config.history.num_extra
        self.decoder = MixtureDecoder(size, config.hidden_size, config.num_gaussians, len(config.horizons))
        self.posterior: _Posterior | None = None
        if config.mutual_information:
            self.posterior = _Posterior(size, config)

    @property
    def latent_size(self) -> int:
        """No latent variables."""
        return 0

    def forward(self, inputs: MixtureInputs, noise: Tensor | None = None) -> RawMixture:
        """The mixtures [R, H, G]."""
        raw: RawMixture = self.decoder(self.code(inputs))
        return raw

    def code(self, inputs: MixtureInputs) -> Tensor:
        """What the decoders read, z in the paper: [R, H, Z]."""
        codes = torch.stack([trunk(inputs) for trunk in self.trunks], dim=1)
        return codes.expand(-1, len(self.horizons), -1)

    def forward_with_posterior(self, inputs: MixtureInputs) -> tuple[RawMixture, Tensor]:
        """The mixtures, and for every component the posterior's log probabilities [R, H, G, G] of which one it is."""
        if self.posterior is None:
            raise ValueError("GrammiNetwork: mutual_information is off, there is no posterior")
        code = self.code(inputs)
        raw = self.decoder(code)
        return raw, self.posterior(code, raw)


class _Trunk(nn.Module):
    """Detections, trackers and further inputs to one code a window."""

    def __init__(self, config: GrammiNetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.detections = DetectionEncoder(_NUM_FEATURES, config.hidden_size)
        if config.history.tracker_steps > 0:
            self.trackers = DetectionEncoder(_NUM_FEATURES, config.hidden_size)
            self.first = PoolingConvolution(config.hidden_size, config.graph_size)
            self.second = PoolingConvolution(config.graph_size, config.tracker_size)

    def forward(self, inputs: MixtureInputs) -> Tensor:
        """[R, Z]."""
        columns = [encode_sequences(self.detections, inputs.rows, inputs.is_observed)]
        if self.config.history.tracker_steps > 0:
            columns.append(self._of_trackers(inputs))
        return torch.cat([*columns, inputs.extra(self.config.history)], dim=-1)

    def _of_trackers(self, inputs: MixtureInputs) -> Tensor:
        """[R, tracker_size], zero where there is no tracker; the order of the trackers does not matter."""
        is_present = inputs.is_tracked.any(dim=-1)
        states = inputs.tracker_rows.new_zeros(*is_present.shape, self.config.hidden_size)
        if is_present.any():
            rows, is_tracked = inputs.tracker_rows[is_present], inputs.is_tracked[is_present]
            states = states.masked_scatter(is_present[..., None], encode_sequences(self.trackers, rows, is_tracked))
        states = functional.leaky_relu(self.first(states, is_present))
        states = self.second(states, is_present) * is_present[..., None]
        mean: Tensor = states.sum(dim=1) / is_present.sum(dim=1, keepdim=True).clamp_min(1)
        return mean


class PoolingConvolution(nn.Module):
    """GraphSAGE with the pooling aggregator (Hamilton et al. 2017, eq. 3) on the complete graph of the nodes present."""

    def __init__(self, size: int, out_size: int) -> None:
        super().__init__()
        self.pool = nn.Linear(size, size)
        self.own = nn.Linear(size, out_size)
        self.others = nn.Linear(size, out_size, bias=False)

    def forward(self, states: Tensor, is_present: Tensor) -> Tensor:
        """[R, M, out_size] from states [R, M, size] and is_present [R, M]; a node alone hears zero."""
        m = states.shape[1]
        # after the rectifier nothing lies below zero, which therefore stands for "nobody"
        messages = functional.relu(self.pool(states)) * is_present[..., None]
        is_other = ~torch.eye(m, dtype=torch.bool, device=states.device)
        heard = (messages[:, None] * is_other[..., None]).amax(dim=2) if m else messages
        result: Tensor = self.own(states) + self.others(heard)
        return result


class MixtureDecoder(nn.Module):
    """Codes [R, H, Z] to mixtures, one decoder a horizon.

    Each component is the answer of the same layers to (z, one-hot code of the component).
    """

    def __init__(self, size: int, width: int, num_gaussians: int, num_horizons: int) -> None:
        super().__init__()
        self.inward = nn.Parameter(torch.empty(num_horizons, size + num_gaussians, width))
        self.inward_bias = nn.Parameter(torch.zeros(num_horizons, width))
        self.outward = nn.Parameter(torch.empty(num_horizons, width, _NUM_PARAMETERS))
        self.outward_bias = nn.Parameter(torch.zeros(num_horizons, _NUM_PARAMETERS))
        self.num_gaussians = num_gaussians
        for horizon in range(num_horizons):
            nn.init.kaiming_uniform_(self.inward[horizon].mT, a=5**0.5)
            nn.init.xavier_normal_(self.outward[horizon])

    def forward(self, code: Tensor) -> RawMixture:
        """The mixtures [R, H, G]."""
        size = code.shape[-1]
        common = torch.einsum("rhz,hzw->rhw", code, self.inward[:, :size]) + self.inward_bias
        hidden = functional.relu(common[:, :, None] + self.inward[:, size:])
        answer = torch.einsum("rhgw,hwp->rhgp", hidden, self.outward) + self.outward_bias[:, None]
        logit, mean, log_sigma = torch.split(answer, [1, 2, 2], dim=-1)
        return RawMixture(logit[..., 0], mean, log_sigma.clamp_min(_MIN_LOG_SIGMA))


class _Posterior(nn.Module):
    """Which component is it? From (z, its logit, mean and sigma), one network a horizon."""

    def __init__(self, size: int, config: GrammiNetworkConfig) -> None:
        super().__init__()
        h, g, width = len(config.horizons), config.num_gaussians, config.posterior_size
        sizes = (size + _NUM_PARAMETERS, width, width, g)
        pairs = list(itertools.pairwise(sizes))
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(h, a, b)) for a, b in pairs)
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(h, 1, b)) for _, b in pairs)
        for weight in self.weights:
            for horizon in range(h):
                nn.init.xavier_uniform_(weight[horizon])

    def forward(self, code: Tensor, raw: RawMixture) -> Tensor:
        """Log probabilities [R, H, G, G]."""
        g = raw.logits.shape[-1]
        state = torch.cat(
            [code[:, :, None].expand(-1, -1, g, -1), raw.logits[..., None], raw.mean, raw.log_sigma.exp()], dim=-1
        )
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            state = torch.einsum("rhgi,hio->rhgo", state, weight) + bias
            state = functional.leaky_relu(state) if index < last else state
        return torch.log_softmax(state, dim=-1)
