"""Evidence on the way through the stage: every kind of draw is weighed, the tables tell, without it nothing changes."""

import dataclasses

import numpy as np
import pytest
import torch
from test_infer import CONFIG, GRID, START_NS, detections

from cadence.constraints.obstacles import Obstacles
from cadence.evidence.estimator import WithEvidence
from cadence.evidence.settings import WeighingConfig
from cadence.types import Tracks
from pipeline.associations import build_associated_windows, tell_sources
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import Samplings
from pipeline.grids import plan_grid
from pipeline.infer.draws import draw_associations, draw_tracks, draw_windows
from pipeline.infer.rows import ADVICE, window_rows, with_effective
from pipeline.windows import build_windows


@dataclasses.dataclass(frozen=True)
class NorthOf:
    """T0 was north of a line at a time, or south of it by so many metres at most, as a statement would say it."""

    y_m: float
    sigma_m: float
    at_s: float
    name: str = "statement"

    def touches(self, time_s: torch.Tensor) -> torch.Tensor:
        return (time_s - self.at_s).abs() <= 1.0

    def log_likelihood(self, tracks: Tracks) -> torch.Tensor:
        south_m = (self.y_m - tracks.position_m[..., 1]).clamp_min(0.0) / self.sigma_m
        is_at = self.touches(tracks.time_s)[:, None, None]
        is_meant = torch.tensor([name == "T0" for name in tracks.agent_ids])
        return torch.where(is_at & is_meant[:, None], -0.5 * south_m.nan_to_num() ** 2, 0.0).sum(-1)

    def contradicts(self, tracks: Tracks, log_likelihood: torch.Tensor) -> torch.Tensor:
        return log_likelihood.amax(1) < -10.0


def case(is_named=True):
    table = detections()
    if not is_named:
        names = table["agent_id"].to_pylist()
        index = table.schema.get_field_index("agent_id")
        nobody = [None if i % 2 else name for i, name in enumerate(names)]
        import pyarrow as pa

        table = table.set_column(index, table.schema.field(index), pa.array(nobody, pa.string()))
    loaded = load_estimator("none", Samplings(device="cpu"))
    config = loaded.grid(GRID)
    return table, loaded, config


def test_windows_are_weighed_and_the_table_tells():
    # T0 is not seen between 94 and 120 s; the window at 110 s or so does not know the way on
    table, loaded, config = case()
    grid = plan_grid(table, config)
    windows = build_windows(table, grid, 5)
    estimator = loaded.fitted(FittingData.of(table, grid, windows)).estimator
    statement = NorthOf(90.0, 2.0, 114.0)
    located = windows.located(START_NS, Obstacles.none(), (statement,))
    weighed = WithEvidence(estimator, WeighingConfig(), loaded.is_apart)
    plain = [piece()[1] for piece in draw_windows(estimator, windows.located(START_NS, Obstacles.none()), 30, True)]
    (piece,) = draw_windows(weighed, located, 30, loaded.is_apart)
    part, drawn = piece()
    rows = with_effective(window_rows(windows, part, drawn), drawn)
    told = {(row["window"], row["agent_id"]): row for row in rows.to_pylist()}
    elapsed_s = (windows.origins_ns - START_NS) * 1e-9
    is_touched = (elapsed_s >= 114.0) & (elapsed_s - 114.0 <= 2.0 * grid.origin_index)
    assert is_touched.any() and not is_touched.all()
    for window, touched in enumerate(is_touched):
        assert (told[window, "T0"]["num_effective"] is not None) == touched
        same = torch.equal(drawn.weight[window], plain[0].weight[window])
        assert same != touched or told[window, "T0"]["num_effective"] > 29
    assert rows.schema.names[-1] == "num_effective" and "num_effective" not in window_rows(windows, part, plain[0]).schema.names
    assert np.nan not in rows["num_effective"].to_pylist()


def test_associated_draws_are_weighed_after_they_were_joined():
    table, loaded, config = case(is_named=False)
    sources = tell_sources(table, config, dataclasses.replace(CONFIG).association, 3)
    associated = build_associated_windows(table, sources, 3, 40)
    named = build_windows(sources.named, sources.grid, 3)
    estimator = loaded.fitted(FittingData.of(sources.named, sources.grid, named)).estimator
    statement = NorthOf(60.0, 20.0, 40.0)
    located = associated.located(START_NS, Obstacles.none(), (statement,))
    for draw in (draw_tracks, draw_associations):
        pieces = [piece() for piece in draw(estimator, located, 40, WeighingConfig())]
        assert any(drawn.num_effective is not None for _, drawn in pieces)
        plain = [piece() for piece in draw(estimator, associated.located(START_NS, Obstacles.none()), 40, WeighingConfig())]
        for (_, weighed), (_, other) in zip(pieces, plain, strict=True):
            torch.testing.assert_close(weighed.position_m, other.position_m, equal_nan=True)
            assert other.num_effective is None
            torch.testing.assert_close(weighed.weight.sum(1), torch.ones(len(weighed.weight)).double())


@pytest.mark.parametrize("word", ["contradicted", "few_fit"])
def test_new_statuses_have_advice(word):
    assert "track" in ADVICE[word]
