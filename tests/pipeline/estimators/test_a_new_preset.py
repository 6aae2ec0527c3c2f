"""A preset of one's own: one module and one entry, and every stage can use its checkpoints."""

import dataclasses
from pathlib import Path
from typing import Self

import pytest
import torch
from fixtures.unknown_origin import GRID, detections, mission
from torch import nn

from cadence.bank.rows import scatter_hypotheses
from cadence.errors import ConfigError, DeviceError
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.checkpoints import CheckpointInfo
from pipeline.estimators import presets
from pipeline.estimators.loaded import Loaded
from pipeline.estimators.presets import Preset, load_estimator, load_forecaster, refuse_unread
from pipeline.estimators.samplings import Samplings
from pipeline.grids import GridConfig
from pipeline.infer.config import InferConfig
from pipeline.infer.stage import infer
from pipeline.progress import Progress
from pipeline.results import read_hypothesis_tables
from pipeline.weights import save_checkpoint


@dataclasses.dataclass(frozen=True)
class Parked:
    """A toy: every agent stays within a metre of where it was seen last."""

    name: str = "parked"

    def fit(self, tracks: Detections) -> Self:
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        seen = windows.detections
        last = (seen.count - 1).clamp_min(0)[..., None, None].expand(-1, -1, 1, 2)
        place_m = seen.position_m.gather(2, last)[windows.is_active]  # [R, 1, 2]
        ring = torch.linspace(0.0, 2.0 * torch.pi, num_hypotheses, dtype=torch.float64)
        around_m = torch.stack([ring.cos(), ring.sin()], dim=-1)[:, None]
        track_m = place_m[:, None] + around_m + torch.zeros(windows.num_steps, 2, dtype=torch.float64)
        return scatter_hypotheses(track_m, windows)


def load_parked(weights: Path, samplings: Samplings) -> Loaded:
    return Loaded("parked", Parked(), lambda grid: grid)


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint of the toy preset, which is registered."""
    monkeypatch.setattr(presets, "PRESETS", {**presets.PRESETS, "parked": Preset(load_parked, ("grid.",))})
    path = tmp_path / "parked.safetensors"
    save_checkpoint(path, nn.Linear(1, 1), CheckpointInfo("parked", {}))
    return path


def test_infer_draws_with_it(tmp_path: Path, weights: Path) -> None:
    directory = mission(tmp_path, detections(["south", "north"] * 8))
    result = infer(directory, InferConfig(num_hypotheses=4, checkpoint=str(weights), grid=GRID), Progress(quiet=True))
    assert result.summary["preset"] == "parked" and result.summary["num_agents"] == 2
    window = read_hypothesis_tables(directory).windows[-1]
    north, south = (agent.position_m + agent.datum_m for agent in window.agents)
    assert abs(north[..., 1] - 800.0).max() <= 1.001 and abs(south[..., 1]).max() <= 1.001


def test_forecasts_are_scored_with_it_and_it_names_the_settings_that_it_reads(weights: Path) -> None:
    assert load_forecaster(str(weights)).name == "parked"
    refuse_unread(str(weights), InferConfig(checkpoint=str(weights), grid=GridConfig(step_s=3.0)))
    with pytest.raises(ConfigError, match=r"infer\.num_steps: .* \(preset parked\) .* Read are: infer\.grid,"):
        refuse_unread(str(weights), InferConfig(checkpoint=str(weights), num_steps=2))


def test_a_device_on_which_the_preset_does_not_run_is_refused(weights: Path) -> None:
    assert load_estimator(str(weights), Samplings(device="cpu")).preset == "parked"
    with pytest.raises(DeviceError, match=r"infer\.device 'cuda': parked does not run there; use auto, or one of: cpu"):
        load_estimator(str(weights), Samplings(device="cuda"))


def test_a_preset_serves_the_stages_that_it_says(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only = {**presets.PRESETS, "parked": Preset(load_parked, infers=False)}
    monkeypatch.setattr(presets, "PRESETS", only)
    with pytest.raises(ConfigError, match=r"'parked', which does not draw hypotheses .* one of general, place, paper$"):
        load_estimator(str(weights), Samplings())
    with pytest.raises(ConfigError, match="'general', which does not forecast; give one of place, paper, vrnn"):
        load_forecaster("general")
