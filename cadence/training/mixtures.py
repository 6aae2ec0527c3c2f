"""Losses of the rivals that answer with mixtures: likelihood, with the bound on the mutual information or the divergence."""

from dataclasses import dataclass

import torch
from torch import Tensor

from cadence.baselines.grammi import GrammiNetwork
from cadence.baselines.mixture import HistoryConfig, MixtureFrame, MixtureInputs, mixture_inputs
from cadence.baselines.vrnn import VrnnNetwork
from cadence.recordings import ForecastWindows


@dataclass(frozen=True, eq=False)
class MixtureWindows:
    """Training windows: inputs of R rows, and the true positions target [R, H, 2] in normalised coordinates, float32."""

    inputs: MixtureInputs
    target: Tensor

    def __len__(self) -> int:
        return len(self.target)

    def __getitem__(self, pick: slice | Tensor) -> "MixtureWindows":
        """A selection of windows."""
        return MixtureWindows(self.inputs[pick], self.target[pick])


def mixture_windows(
    windows: ForecastWindows, frame: MixtureFrame, history: HistoryConfig, horizons: tuple[int, ...]
) -> MixtureWindows:
    """Forecasting windows as a network sees them."""
    centre = torch.tensor(frame.centre_m, dtype=torch.float64)
    place_m = windows.truth_m[:, 0, list(horizons)] + windows.context.datum_m[:, None]
    inputs = mixture_inputs(windows.windows, frame, history)
    return MixtureWindows(inputs, ((place_m - centre) / frame.scale_m).float())


def grammi_loss(network: GrammiNetwork, windows: MixtureWindows, weight: float = 2.0) -> Tensor:
    """Negative log likelihood, mean over windows and horizons; with a posterior, `weight` times its cross-entropy besides.

    The cross-entropy of the components' names is the variational bound on the mutual information (Ye et al. 2023, eq. 5).
    """
    if network.posterior is None:
        plain: Tensor = network(windows.inputs).negative_log_likelihood(windows.target).mean()
        return plain
    raw, log_probability = network.forward_with_posterior(windows.inputs)
    entropy = -log_probability.diagonal(dim1=-2, dim2=-1).mean()
    return raw.negative_log_likelihood(windows.target).mean() + weight * entropy


def vrnn_loss(network: VrnnNetwork, windows: MixtureWindows, generator: torch.Generator, weight: float = 0.01) -> Tensor:
    """Negative log likelihood as for `grammi_loss`, plus `weight` times a window's divergence; latents drawn once."""
    shape = (*windows.inputs.is_observed.shape, network.latent_size)
    raw, divergence = network.forward_with_divergence(windows.inputs, torch.randn(shape, generator=generator))
    return raw.negative_log_likelihood(windows.target).mean() + weight * divergence.mean()


def hidden_goals(windows: MixtureWindows, share: float, generator: torch.Generator) -> MixtureWindows:
    """The windows with the goal hidden in a random `share` of them, so that one network learns to do with and without."""
    is_hidden = torch.rand(len(windows), generator=generator) < share
    return MixtureWindows(windows.inputs.without_goal(is_hidden), windows.target)
