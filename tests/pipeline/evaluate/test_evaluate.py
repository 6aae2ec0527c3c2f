"""Scoring missions: cells against hand-made windows, the stage on a small mission, pooling, and what must be refused."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from fixtures.mission import AGENT_IDS, NUM_WINDOWS, ORIGIN_INDEX, build_mission

from cadence.baselines.interpolation import GapLaw, Hold
from cadence.errors import ConfigError, InputError
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline.config import read_config
from pipeline.evaluate.stage import EvaluateConfig, _told_bank, evaluate, evaluate_folder, score_mission
from pipeline.grids import GridConfig
from pipeline.infer.config import InferConfig
from pipeline.infer.stage import infer
from pipeline.progress import Progress
from pipeline.scoring.scores import METRICS, Cells, compare, energy_ratio, groups_of, score_cells, score_in_chunks, summarise
from pipeline.tables import Frame, read_table, write_table

QUIET = Progress(quiet=True)
pytestmark = pytest.mark.usefixtures("few_map_cells")
SIMPLE = EvaluateConfig(rivals=("linear", "hold"), num_resamples=50)


def make_windows(num_windows: int = 3) -> WindowBatch:
    """Two agents on the x axis, seen at -4 and -1 s (agent 0) and never (agent 1); steps of 1 s from -5 to 4 s."""
    time_s = torch.tensor([-4.0, -1.0, 0.0], dtype=torch.float64).expand(num_windows, 2, 3).clone()
    position = torch.stack([time_s, torch.zeros_like(time_s)], dim=-1)
    covariance = 1e-6 * torch.eye(2, dtype=torch.float64).expand(num_windows, 2, 3, 2, 2).clone()
    is_observed = torch.tensor([[True, True, False], [False, False, False]]).expand(num_windows, 2, 3).clone()
    grid = torch.arange(-5, 5, dtype=torch.float64)
    return WindowBatch(grid, Detections(time_s, position, covariance, is_observed), torch.arange(num_windows), 5)


def truth_of(windows: WindowBatch) -> tuple[torch.Tensor, torch.Tensor]:
    line = torch.stack([windows.time_s, torch.zeros_like(windows.time_s)], dim=-1)
    shape = (windows.num_windows, windows.num_agents, windows.num_steps)
    return line.expand(*shape, 2).clone(), torch.ones(shape, dtype=torch.bool)


def offset_set(windows: WindowBatch, offset_m: float) -> HypothesisSet:
    """Two hypotheses: the truth (weight 3/4) and the truth moved sideways."""
    truth, _ = truth_of(windows)
    position = torch.stack([truth, truth + torch.tensor([0.0, offset_m])], dim=1)
    position = position.masked_fill(~windows.is_active[:, None, :, None, None], torch.nan)
    status = (("ok", "no_detections"),) * windows.num_windows
    return HypothesisSet(position, torch.tensor([[0.75, 0.25]]).repeat(windows.num_windows, 1).double(), status)


def test_cells_by_hand() -> None:
    windows = make_windows()
    cells = score_cells(offset_set(windows, 8.0), windows, *truth_of(windows))
    # Agent 1 has no detections, step -5 lies before the first one.
    assert len(cells) == 3 * 9 and set(cells.agent) == {0}
    first = cells.window == 0
    assert cells.step[first].tolist() == list(range(-4, 5))
    assert cells.age[first] == pytest.approx([0, 1, 2, 0, 1, 2, 3, 4, 5], abs=1e-5)
    assert cells.gap[first] == pytest.approx([3, 3, 3] + [np.inf] * 6)
    assert cells.nearest[first] == pytest.approx([0, 1, 1, 0, 1, 2, 3, 4, 5], abs=1e-5)
    assert cells.column("ade_m") == pytest.approx(2.0)
    assert cells.column("mean_error_m") == pytest.approx(2.0)
    assert cells.column("min_ade_m") == pytest.approx(0.0)
    assert cells.column("energy_score_m") == pytest.approx(2.0 - 8.0 * 0.75 * 0.25)
    assert cells.column("energy_score_fair_m") == pytest.approx(2.0 - 8.0 * 0.75 * 0.25 / (1 - 0.75**2 - 0.25**2))
    assert np.nanmax(cells.column("step_length_m")) == pytest.approx(1.0)
    trajectory = cells.column("trajectory_energy_score_m")[first]
    assert np.flatnonzero(~np.isnan(trajectory)).tolist() == [0, 5]  # once per side of the origin
    assert trajectory[5] == pytest.approx(0.5)
    counts = {part: int(cells.is_in(part)[first].sum()) for part in ("past", "between", "future", "final")}
    assert counts == {"past": 5, "between": 3, "future": 4, "final": 1}


def test_cells_where_truth_is_known_only() -> None:
    windows = make_windows()
    truth, is_known = truth_of(windows)
    is_known[0] = False
    is_known[1, :, 7:] = False
    truth[~is_known] = torch.nan
    cells = score_cells(offset_set(windows, 8.0), windows, truth, is_known)
    assert set(cells.window) == {1, 2} and cells.step[cells.window == 1].max() == 1
    assert not np.isnan(cells.column("energy_score_m")).any()


def test_collisions_are_weighted() -> None:
    windows = make_windows()
    found = offset_set(windows, 8.0)
    cells = score_cells(found, windows, *truth_of(windows), found.position_m[..., 1] > 4.0)
    assert cells.column("collision_share") == pytest.approx(0.25)


def test_chunks_do_not_change_the_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    windows = make_windows(5)
    truth, is_known = truth_of(windows)
    estimator = Hold(law=GapLaw(1.0, 0.5))
    whole = compare({"hold": estimator}, windows, truth, is_known, 6)["hold"]
    monkeypatch.setattr("pipeline.scoring.scores._MAX_STATES", 1)
    seen: list[int] = []
    single = compare({"hold": estimator}, windows, truth, is_known, 6, after_chunk=seen.append)["hold"]
    assert seen == [1] * 5
    np.testing.assert_array_equal(single.value, whole.value)
    np.testing.assert_array_equal(single.window, whole.window)
    assert len(score_in_chunks(lambda index: estimator.sample(windows[index], 6), windows, truth, is_known & False, 6)) == 0


def test_an_estimator_may_not_leave_out_agents() -> None:
    class Shy(Hold):
        def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
            found = super().sample(windows, num_hypotheses)
            found.position_m[windows.seeds == 1] = torch.nan
            return found

    windows = make_windows()
    with pytest.raises(ValueError, match="shy scored 18 cells where hold scored 27"):
        compare({"hold": Hold(), "shy": Shy()}, windows, *truth_of(windows), 4)


def test_rows_and_ratio() -> None:
    windows = make_windows(20)
    near, far = (score_cells(offset_set(windows, offset), windows, *truth_of(windows)) for offset in (4.0, 8.0))
    groups = groups_of(near, 20)
    assert len(np.unique(groups)) == 10  # one agent: blocks of time
    ratio = energy_ratio(near, far, "past", groups)
    assert (ratio.value, ratio.low, ratio.high) == pytest.approx((0.5, 0.5, 0.5))
    rows = summarise("near", near, groups, num_resamples=20)
    by_horizon = [row for row in rows if row.by == "horizon" and row.metric == "ade_m"]
    assert [(row.above_steps, row.up_to_steps, row.num_cells) for row in by_horizon] == [(-1, 1, 20), (1, 2, 20), (2, 4, 40)]
    gaps = [row for row in rows if row.by == "gap" and row.metric == "ade_m"]
    assert [(row.above_steps, row.up_to_steps, row.num_cells) for row in gaps] == [(2, 4, 60)]


def test_groups_are_agents_where_there_are_enough() -> None:
    agent = np.repeat(np.arange(7, dtype=np.int32), 2)
    zero = np.zeros(14)
    cells = Cells(np.zeros(14, np.int32), agent, agent, zero, zero, zero, np.zeros((14, len(METRICS))))
    assert groups_of(cells, 3).tolist() == agent.tolist()


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_mission(tmp_path_factory.mktemp("missions"))


def test_stage_writes_scores_and_skips(mission: Path) -> None:
    result = evaluate(mission, SIMPLE, QUIET)
    assert result.status == "done"
    assert sorted(path.name for path in result.outputs) == ["scores.csv", "scores.json", "scores.md"]
    scores = json.loads((mission / "scores.json").read_text(), parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    assert scores["version"] == 1 and scores["grouped_by"] == "block"
    rows = {(r["estimator"], r["part"], r["metric"]): r for r in scores["rows"] if r["by"] == "part"}
    for name in ("cadence", "linear", "hold"):
        assert rows[name, "past", "energy_score_m"]["num_cells"] == rows["cadence", "past", "energy_score_m"]["num_cells"] > 300
    # The fixture draws its hypotheses around the truth with a standard deviation of 6 m a coordinate, constant in time.
    past = rows["cadence", "past", "mean_error_m"]["value"]
    assert 1.0 < past < 6.0
    assert rows["cadence", "past", "coverage_90"]["value"] > 0.9  # the truth is their centre
    assert rows["cadence", "future", "energy_score_m"]["low"] <= rows["cadence", "future", "energy_score_m"]["value"]
    assert {(r["rival"], r["part"]) for r in scores["ratios"]} >= {("linear", "past"), ("hold", "future")}
    text = (mission / "scores.md").read_text()
    assert "## Future, by horizon" in text and "| hold |" in text and "nan" not in text.lower()
    assert len((mission / "scores.csv").read_text().splitlines()) == len(scores["rows"]) + 1
    assert evaluate(mission, SIMPLE, QUIET).status == "skipped"


def test_collisions_are_those_of_the_stated_obstacles(tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    config = EvaluateConfig(rivals=("hold",))

    def shares(obstacles: list[dict[str, object]]) -> list[float]:
        (mission / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": obstacles}))
        return [cells.column("collision_share").mean() for cells in score_mission(mission, config, QUIET).cells.values()]

    assert np.isnan(shares([])).all()
    assert shares([{"kind": "circle", "x_m": 1600.0, "y_m": -200.0, "radius_m": 1e5}]) == pytest.approx([1.0, 1.0])
    assert shares([{"kind": "circle", "x_m": 1e7, "y_m": 1e7, "radius_m": 1.0}]) == [0.0, 0.0]
    some = shares([{"kind": "circle", "x_m": 1700.0, "y_m": -100.0, "radius_m": 40.0}])
    assert all(0.0 < share < 0.5 for share in some)


def test_truth_that_enters_an_obstacle_is_told(tmp_path: Path) -> None:
    mission, config = build_mission(tmp_path, num_hypotheses=3), EvaluateConfig(rivals=(), num_resamples=20)

    def line(radius_m: float, x_m: float = 1700.0) -> list[str]:
        circle = {"kind": "circle", "x_m": x_m, "y_m": -100.0, "radius_m": radius_m}
        (mission / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": [circle]}))
        return [words for words in evaluate(mission, config, QUIET).summary["verdict"] if words.startswith("Obstacles:")]

    assert line(1e5) == [
        "Obstacles: 100 % of the true steps of patrol lie in one, and hypotheses keep out of them; check where they lie, or "
        'set infer.guidance.mode = "none".'
    ]
    assert re.match(r"Obstacles: \d{1,2}(\.\d+)? % of", line(300.0)[0])
    assert line(40.0, 1e7) == []


def test_agents_without_hypotheses_are_counted(tmp_path: Path) -> None:
    mission = build_mission(tmp_path, num_hypotheses=3)
    scored = score_mission(mission, EvaluateConfig(rivals=()), QUIET)
    # T1 has detections in the last window but no hypotheses there.
    assert scored.num_unscored == 1
    own = scored.cells["cadence"]
    assert not ((own.agent == AGENT_IDS.index("T1")) & (own.window == NUM_WINDOWS - 1)).any()


def test_scores_do_not_depend_on_where_the_frame_lies(tmp_path: Path) -> None:
    (tmp_path / "moved").mkdir()
    mission, moved = (build_mission(parent, num_hypotheses=4) for parent in (tmp_path, tmp_path / "moved"))

    def shift(name: str, x: str, y: str, move: Callable[[str, np.ndarray], np.ndarray]) -> None:
        table, frame = read_table(moved / f"{name}.parquet", name)
        for column in (x, y):
            values = move(column, table[column].to_numpy())
            table = table.set_column(table.schema.get_field_index(column), table.schema.field(column), [values])
        write_table(table, moved / f"{name}.parquet", name, frame)

    for name in ("detections", "truth"):
        shift(name, "x_m", "y_m", lambda column, values: values + (512.0 if column.startswith("x") else -2048.0))
    shift("hypotheses", "datum_x_m", "datum_y_m", lambda column, values: values + (512.0 if "x_m" in column else -2048.0))
    circle = {"kind": "circle", "x_m": 1700.0, "y_m": -100.0, "radius_m": 40.0}
    far = circle | {"x_m": 1700.0 + 512.0, "y_m": -100.0 - 2048.0}
    for path, obstacle in ((mission, circle), (moved, far)):
        (path / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": [obstacle]}))
    one, two = (score_mission(path, SIMPLE, QUIET).cells for path in (mission, moved))
    for name in one:
        np.testing.assert_allclose(two[name].value, one[name].value, atol=1e-6)


def test_folder_pools_missions(tmp_path: Path) -> None:
    first = build_mission(tmp_path, num_hypotheses=3)
    folder = tmp_path / "missions"
    for index in range(6):
        (folder / f"m{index}").parent.mkdir(exist_ok=True)
        (folder / f"m{index}").symlink_to(first)
    result = evaluate_folder(folder, EvaluateConfig(rivals=(), num_resamples=20), QUIET)
    scores = json.loads((folder / "scores.json").read_text())
    assert result.summary["num_logs"] == 6 and scores["grouped_by"] == "log"
    row = next(r for r in scores["rows"] if r["metric"] == "ade_m" and r["part"] == "past" and r["by"] == "part")
    assert row["num_groups"] == 6 and row["low"] == pytest.approx(row["high"])  # six times the same log
    for index in range(1, 6):
        (folder / f"m{index}").unlink()
    delay_truth(build_mission(folder, num_hypotheses=3))
    assert evaluate_folder(folder, EvaluateConfig(rivals=(), num_resamples=20), QUIET).summary["num_failed"] == 1
    with pytest.raises(InputError, match="no mission directory"):
        evaluate_folder(tmp_path / "missions" / "m0", SIMPLE, QUIET)


def test_a_folder_shows_one_bar_and_a_line_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "missions"
    folder.mkdir()
    for index in range(2):
        (folder / f"m{index}").symlink_to(build_mission(tmp_path, num_hypotheses=3) if not index else folder / "m0")
    config = EvaluateConfig(rivals=("hold",), num_resamples=20)
    evaluate_folder(folder, config, Progress())
    assert capsys.readouterr().err == "[1/2] m0: scored\n[2/2] m1: scored\n"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    evaluate_folder(folder, config, Progress())
    shown = capsys.readouterr().err
    assert " 50%|" in shown and "1 of 2" in shown and "window" not in shown and "\x1b[A" not in shown
    evaluate_folder(folder, config, QUIET)
    assert capsys.readouterr().err == ""


def test_detections_of_unknown_origin_take_the_only_truth(tmp_path: Path) -> None:
    mission = build_mission(tmp_path)
    for name in ("detections", "hypotheses", "windows", "truth"):
        path = mission / f"{name}.parquet"
        table = pq.read_table(path)
        names = np.array(table["agent_id"].to_pylist())
        table = table.filter(names == "T0")
        new = {"detections": None, "truth": "ship"}.get(name, "unknown")
        column = table.schema.get_field_index("agent_id")
        table = table.set_column(column, table.schema.field("agent_id"), pa.array([new] * table.num_rows, pa.string()))
        write_table(table, path, name, Frame("map"))
    scored = score_mission(mission, SIMPLE, QUIET)
    assert scored.agent_ids == ("unknown",) and len(scored.cells["cadence"]) == len(scored.cells["hold"]) > 300


def rename_truth(mission: Path) -> None:
    table, frame = read_table(mission / "truth.parquet", "truth")
    names = [f"ship {name}" for name in table["agent_id"].to_pylist()]
    table = table.set_column(table.schema.get_field_index("agent_id"), table.schema.field("agent_id"), [names])
    write_table(table, mission / "truth.parquet", "truth", frame)


def delay_truth(mission: Path) -> None:
    table, frame = read_table(mission / "truth.parquet", "truth")
    late = [table["time_ns"].to_numpy() + 10**15]
    table = table.set_column(table.schema.get_field_index("time_ns"), table.schema.field("time_ns"), late)
    write_table(table, mission / "truth.parquet", "truth", frame)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda mission: (mission / "truth.parquet").unlink(), "nothing to score against"),
        (rename_truth, "give both the same names"),
        (delay_truth, "no step has both hypotheses and truth"),
        (lambda mission: (mission / "hypotheses.parquet").unlink(), "not found"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, spoil: Callable[[Path], None], message: str) -> None:
    mission = build_mission(tmp_path)
    spoil(mission)
    before = sorted(mission.iterdir())
    with pytest.raises(InputError, match=message) as caught:
        evaluate(mission, SIMPLE, QUIET)
    assert "\n" not in str(caught.value)
    assert sorted(mission.iterdir()) == before


def test_config_names_the_known_rivals() -> None:
    with pytest.raises(ConfigError, match=r"known rivals: .*hold"):
        read_config(EvaluateConfig, {"rivals": ["oracle"]}, "evaluate")
    with pytest.raises(ConfigError, match="max_truth_gap_s"):
        read_config(EvaluateConfig, {"max_truth_gap_s": -1.0}, "evaluate")


def test_fixture_has_its_origin_where_the_tables_say(mission: Path) -> None:
    cells = score_mission(mission, EvaluateConfig(rivals=()), QUIET).cells["cadence"]
    assert cells.step.min() >= -ORIGIN_INDEX and cells.step.max() == 32


def test_the_bank_that_infer_fitted_is_the_rival_and_is_not_fitted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = build_mission(tmp_path)
    grid = GridConfig(step_s=1.0, history_steps=16, horizon_steps=8, stride_steps=32)
    infer(directory, InferConfig(num_hypotheses=4, checkpoint="none", grid=grid), QUIET)
    config = EvaluateConfig(rivals=("bank",))
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.evaluate.stage._told_bank", lambda *_: None)
        anew = score_mission(directory, config, QUIET).cells["bank"]
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.estimators.fitting.pool_by_hindsight", lambda *_: pytest.fail("fitted again"))
        np.testing.assert_array_equal(score_mission(directory, config, QUIET).cells["bank"].value, anew.value)
    # another seed has other windows, and another program may find another bank
    assert _told_bank(directory, 0) is not None and _told_bank(directory, 1) is None
    monkeypatch.setattr("pipeline.evaluate.stage.versions", lambda: {"cadence": "another"})
    assert _told_bank(directory, 0) is None
