"""The general preset, and the bank alone: fitted to every log anew, on any grid."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import torch

from cadence.bank.bank import Bank
from cadence.bank.plausible import TopSpeed
from cadence.diffusion.gate import gated
from cadence.diffusion.general import GeneralModel
from cadence.errors import ConfigError, DeviceError
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from pipeline.checkpoints import expect_preset, network_config
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.loaded import Fitted, Loaded
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig
from pipeline.weights import load_network


def load_general(weights: Path | None, samplings: Samplings) -> Loaded:
    """The estimator of a checkpoint, or without one the bank alone; `ConfigError` where it is of another preset."""
    device = _device(samplings.device)
    network = None
    if weights is not None:
        info = expect_preset(weights, "general")
        config: ResidualNetworkConfig = network_config(ResidualNetworkConfig, info, weights)
        network = load_network(weights, lambda: ResidualNetwork(config)).to(device)
    sampling = samplings.general
    model = GeneralModel(Bank(), network, sampling.sampler, sampling.num_steps, device=device)
    return Loaded(
        "bank" if network is None else "general",
        model,
        functools.partial(_checked_grid, network),
        lambda data: _fitted(model, samplings, data),
        is_apart=True,
    )


def fitted_model(model: GeneralModel, data: FittingData, is_gated: bool = True) -> GeneralModel:
    """The model fitted to the log's detections; settings of the bank and the network's part in it chosen by hindsight."""
    fitted = dataclasses.replace(model, bank=data.fitted_bank())
    return gated(fitted, *data.gate_tests) if is_gated else fitted


def _fitted(model: GeneralModel, samplings: Samplings, data: FittingData) -> Fitted:
    # The choices by hindsight are made without constraints: withheld detections obey them anyway.
    fitted = dataclasses.replace(
        fitted_model(model, data, samplings.general.is_gated),
        guidance=samplings.guidance,
        top_speed=TopSpeed.of_log(data.tracks, data.grid.step_s),
    )
    return Fitted(fitted, _about(fitted))


def _checked_grid(network: ResidualNetwork | None, grid: GridConfig) -> GridConfig:
    num_steps = grid.history_steps + grid.horizon_steps
    factor = 1 if network is None else 2 ** (len(network.config.multipliers) - 1)
    if num_steps % factor:
        raise ConfigError(
            f"infer.grid: history_steps + horizon_steps is {num_steps}; this checkpoint wants a multiple of {factor}"
        )
    return grid


def _about(model: GeneralModel) -> dict[str, Any]:
    bank = model.bank
    ratios = dataclasses.asdict(model.gate) if model.gate else {}
    return {
        "plausible_speed_mps": None if model.top_speed is None else model.top_speed.limit_mps,
        "sampler": model.sampler,
        "num_steps": model.num_steps if model.network is not None else 0,
        "network": {"share_past": model.share_past, "share_future": model.share_future, **ratios},
        "bank": bank.about(),
    }


def _device(name: str) -> str:
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise DeviceError(f"infer.device {name!r}: not to be had here ({str(error).splitlines()[0]}); use cpu") from error
    return name
