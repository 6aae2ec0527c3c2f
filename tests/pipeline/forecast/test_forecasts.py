"""Evaluation of forecasts on folders of logs: the protocol, resuming, what is refused."""

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures.paper_checkpoint import checkpoint
from fixtures.small_logs import Row, detection, pose, write_log

import cli
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.settings import AbsoluteSampling
from cadence.errors import ConfigError, UsageError
from cadence.types import Context, Detections, HypothesisSet, WindowBatch
from pipeline.config import read_config
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.evaluate.stage import EvaluateConfig, evaluate_any
from pipeline.forecast import stage as forecasts
from pipeline.forecast.rivals import FORECAST_RIVALS, label_of
from pipeline.forecast.scores import EpisodeScores
from pipeline.forecast.stage import ForecastConfig, ForecastRun, evaluate_forecasts, forecast_windows, truth_scores
from pipeline.progress import Progress

QUIET = Progress(quiet=True)
FEW = AbsoluteSampling(sampler="dpmpp", num_steps=2)
SMALL = ForecastConfig(num_windows=30, num_hypotheses=4, num_resamples=50, rivals=(), paper=FEW)


def walk(num_steps: int, offset: float) -> list[Row]:
    rows = []
    for k in range(num_steps):
        rows.append(pose(60.0 * k, 50.0 * k + offset, offset, "/truth/fugitive"))
        if k % 5 == 1:
            rows.append(detection(60.0 * k, 50.0 * k + offset, offset))
    return rows


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    data = tmp_path / "logs"
    data.mkdir()
    for index in range(3):
        write_log(data / f"log_{index}.mcap", walk(20 + index, 100.0 * index))
    return data


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return checkpoint(tmp_path / "trained" / "checkpoint.safetensors")


class Straight:
    """Knows that targets go 50 m east a step, and errs by a constant."""

    name = "straight"

    def __init__(self, shift_m: float = 0.0) -> None:
        self.shift_m, self.num_calls = shift_m, 0

    def fit(self, tracks):
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        self.num_calls += 1
        found = windows.detections
        last = found.is_observed[:, 0].sum(dim=1) - 1
        rows = torch.arange(len(last))
        ahead = (windows.time_s - found.time_s[rows, 0, last][:, None]) / 60.0 * 50.0
        track = torch.stack([ahead, torch.full_like(ahead, self.shift_m)], dim=-1)
        track = track + found.position_m[rows, 0, last][:, None]
        position = track[:, None, None].expand(-1, num_hypotheses, -1, -1, -1)
        weight = torch.full((len(last), num_hypotheses), 1.0 / num_hypotheses, dtype=torch.float64)
        return HypothesisSet(position, weight, tuple(("ok",) for _ in rows))


def long_folder(tmp_path: Path) -> Path:
    """Episodes that outlast every window's first 30 steps for most of the time."""
    data = tmp_path / "long"
    data.mkdir()
    for index in range(4):
        write_log(data / f"log_{index}.mcap", walk(400 + index, 100.0 * index))
    return data


def run_on(data: Path, cache: Path | None, config: ForecastConfig = SMALL) -> ForecastRun:
    episodes = load_recordings(RecordingsConfig(data=data), data.parent / "read", QUIET)
    return ForecastRun(episodes, forecast_windows(episodes.recordings, config), config.num_hypotheses, cache, QUIET)


@pytest.mark.parametrize("known_start", [True, False])
def test_known_answers_through_the_whole_protocol(tmp_path: Path, known_start: bool) -> None:
    config = ForecastConfig(num_windows=200, num_hypotheses=3, known_start=known_start)
    run = run_on(long_folder(tmp_path), None, config)
    exact = run.score("exact", lambda: Straight(), [])
    shifted = run.score("shifted", lambda: Straight(70.0), [])
    assert exact.count.sum() == 200 and len(exact.episode) == 4
    # now, and before any episode ends
    assert exact.mean("displacement_error")[0] == pytest.approx(0.0, abs=1e-3)
    assert shifted.mean("energy_score")[0] == pytest.approx(70.0, rel=1e-5)
    # after its end the target stays: the error is what the forecast has gone on
    windows = run.windows
    left = torch.tensor([400 + e for e in windows.episode.tolist()]) - 1 - windows.step
    gone_on = (119 - left).clamp_min(0).double() * 50.0
    assert exact.mean("displacement_error")[-1] == pytest.approx(float(gone_on.mean()), rel=1e-4)
    truth = truth_scores(run.episodes, windows)
    assert truth.mean("ade").tolist() == [0.0] * 5
    if not known_start:
        assert windows.windows.is_active.all()


@dataclass
class InOrder:
    """Sees two targets in every window and answers with straight ways, those of the second 300 m beside the truth."""

    draws_together = True
    name = "in order"

    def fit(self, tracks: Detections) -> "InOrder":
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        assert windows.num_agents == 2
        parts = []
        for agent, shift_m in ((0, 0.0), (1, 300.0)):
            columns = {
                name: value[:, agent : agent + 1] for name, value in vars(windows.detections).items() if value is not None
            }
            alone = dataclasses.replace(windows, detections=Detections(**columns))
            parts.append(Straight(shift_m).sample(alone, num_hypotheses).position_m)
        weight = torch.full((windows.num_windows, num_hypotheses), 1.0 / num_hypotheses, dtype=torch.float64)
        return HypothesisSet(torch.cat(parts, dim=2), weight, (("ok", "ok"),) * windows.num_windows)


def test_targets_are_drawn_together_or_alone_and_scored_one_by_one(tmp_path: Path) -> None:
    data = tmp_path / "pairs"
    data.mkdir()
    for index in range(3):
        rows = [*of(walk(300, 100.0 * index), "A"), *of(walk(300, 100.0 * index + 1000.0), "B")]
        write_log(data / f"log_{index}.mcap", sorted(rows, key=lambda row: row.time_s))
    episodes = load_recordings(RecordingsConfig(data=data), tmp_path / "read", QUIET, together=True)
    assert episodes.recordings.num_episodes == 3 and episodes.recordings.num_agents == 2
    windows = forecast_windows(episodes.recordings, SMALL)
    run = ForecastRun(episodes, windows, 4, None, QUIET)
    together = run.score("together", InOrder, [])
    assert together.count.sum() == 60 and len(together.episode) == 3
    assert together.mean("displacement_error")[0] == pytest.approx(150.0, rel=1e-5)
    alone = run.score("alone", lambda: Straight(300.0), [])
    assert alone.mean("displacement_error")[0] == pytest.approx(300.0, rel=1e-5)
    assert truth_scores(episodes, windows).mean("ade").tolist() == [0.0] * 5


def of(rows: list[Row], agent_id: str) -> list[Row]:
    """A walk with a name of its own."""
    is_truth = [row.topic.startswith("/truth") for row in rows]
    return [
        dataclasses.replace(row, topic=f"/truth/{agent_id}")
        if true
        else dataclasses.replace(row, message=row.message | {"agent_id": agent_id})
        for row, true in zip(rows, is_truth, strict=True)
    ]


def test_obstacles_are_told_and_differ_by_episode(tmp_path: Path) -> None:
    run = run_on(long_folder(tmp_path), None)
    walls = [Obstacles(torch.tensor([[5000.0, 0.0, radius]], dtype=torch.float64)) for radius in (1.0, 2.0)]
    episodes = dataclasses.replace(run.episodes, obstacles=tuple(walls[index % 2] for index in range(4)))
    told: list[tuple[Obstacles, set[int]]] = []
    episode_of = dict(zip(run.windows.windows.seeds.tolist(), run.windows.episode.tolist(), strict=True))

    class Careful(Straight):
        def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
            told.append((windows.required_context(self.name).obstacles, {episode_of[seed] for seed in windows.seeds.tolist()}))
            return super().sample(windows, num_hypotheses)

    both = dataclasses.replace(run, episodes=episodes)
    found = both.score("careful", Careful, [])
    assert {(wall, episode % 2) for wall, numbers in told for episode in numbers} == {(walls[0], 0), (walls[1], 1)}
    assert np.array_equal(found.sums, run.score("careful", Careful, []).sums)
    told.clear()
    dataclasses.replace(both, tells_obstacles=False).score("careful", Careful, [])
    assert [wall.count for wall, _ in told] == [0] * len(told)


def test_a_killed_evaluation_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts, "BLOCK", 8)
    cache = tmp_path / "kept"
    run = run_on(long_folder(tmp_path), cache)
    estimator = Straight(5.0)
    whole = run.score("straight", lambda: estimator, ["version 1"])
    kept = sorted(cache.glob("*.json"))
    assert len(kept) == 4 and estimator.num_calls == 4
    kept[1].unlink()
    kept[2].write_text(kept[2].read_text()[:100])  # half a file
    again = run.score("straight", lambda: estimator, ["version 1"])
    assert estimator.num_calls == 6
    assert np.array_equal(again.sums, whole.sums) and np.array_equal(again.steps, whole.steps)

    def never():
        raise AssertionError("built")

    run.score("straight", never, ["version 1"])
    with pytest.raises(AssertionError, match="built"):
        run.score("straight", never, ["version 2"])
    other = run_on(tmp_path / "long", cache, ForecastConfig(num_windows=30, num_hypotheses=4, seed=1))
    with pytest.raises(AssertionError, match="built"):
        other.score("straight", never, ["version 1"])


def test_what_is_not_to_be_known_is_hidden(folder: Path) -> None:
    rec = load_recordings(RecordingsConfig(data=folder), folder.parent / "read", QUIET).recordings
    rec.known_goal_m[:] = 7.0
    seen: Context = forecast_windows(rec, SMALL).context
    hidden: Context = forecast_windows(rec, ForecastConfig(num_windows=30, known_goal=False, trackers=False)).context
    assert seen.known_goal_m is not None and (seen.known_goal_m == 7.0).all()
    assert hidden.known_goal_m is not None and hidden.known_goal_m.isnan().all()
    assert hidden.known_goal_m.shape == seen.known_goal_m.shape


def test_a_folder_of_logs_and_a_checkpoint_make_three_files(folder: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "scores"
    config = ForecastConfig(
        30, 4, rivals=("library",), num_resamples=50, paper=FEW, training=RecordingsConfig(data=folder, pattern="log_0.mcap")
    )
    result = evaluate_forecasts(folder, str(weights), out, config, QUIET)
    assert [path.name for path in result.outputs] == ["forecast.csv", "forecast.json", "forecast.md"]
    report = json.loads((out / "forecast.json").read_text())
    assert report["facts"]["num_windows"] == 30 and report["facts"]["num_episodes"] == 3 and report["facts"]["known_start"]
    names = {row["estimator"] for row in report["rows"]}
    assert names == {"trained", "library", "truth"}
    assert {item["step"] for item in report["comparisons"]} == {0, 29, 59, 89, 119, None}
    assert "the true start counts as a detection" in (out / "forecast.md").read_text()
    assert evaluate_forecasts(folder, str(weights), out, config, QUIET).status == "skipped"
    first = (out / "forecast.csv").read_text()
    again = evaluate_forecasts(folder, str(weights), tmp_path / "elsewhere", config, QUIET)
    assert again.status == "done" and (tmp_path / "elsewhere" / "forecast.csv").read_text() == first
    write_log(folder / "log_3.mcap", walk(30, 900.0))
    assert evaluate_forecasts(folder, str(weights), out, config, QUIET).summary["num_episodes"] == 4


def test_a_checkpoint_beside_another(folder: Path, weights: Path, tmp_path: Path) -> None:
    other = checkpoint(tmp_path / "other.safetensors", seed=1)
    config = ForecastConfig(30, 4, rivals=(), num_resamples=20, paper=FEW, checkpoints=(str(other),))
    result = evaluate_forecasts(folder, str(weights), tmp_path / "out", config, QUIET)
    assert {score["estimator"] for score in result.summary["scores"]} == {"trained", "other"}
    same = tmp_path / "copy" / "trained" / "checkpoint.safetensors"
    shutil.copytree(weights.parent, same.parent)
    with pytest.raises(ConfigError, match="same name"):
        evaluate_forecasts(folder, str(weights), tmp_path / "out", ForecastConfig(checkpoints=(str(same),)), QUIET)
    assert [label_of(name) for name in ("prison", "a/b.safetensors", "x/run/checkpoint.safetensors")] == ["prison", "b", "run"]


def test_an_estimator_without_an_answer_is_an_error_and_not_a_score(tmp_path: Path) -> None:
    class Silent(Straight):
        def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
            found = super().sample(windows, num_hypotheses)
            return HypothesisSet(torch.full_like(found.position_m, torch.nan), found.weight, found.status)

    with pytest.raises(ConfigError, match="straight: no position for 30 of 30 windows"):
        run_on(long_folder(tmp_path), None).score("silent", lambda: Silent(), [])


@pytest.mark.parametrize("name", FORECAST_RIVALS)
def test_every_rival_forecasts(tmp_path: Path, name: str) -> None:
    run = run_on(long_folder(tmp_path), None)
    found = run.score(name, lambda: FORECAST_RIVALS[name](run.episodes.recordings), [])
    assert found.count.sum() == 30 and np.isfinite(found.sums).all()
    assert found.mean("mean_error")[0] < 400.0  # at most four steps of 50 m since the last detection


@pytest.mark.parametrize(
    "wrong",
    [
        {"rivals": ["nobody"]},
        {"rivals": ["library"]},
        {"num_windows": 0},
        {"recordings": {"num_episodes": 0}},
        {"paper": {"num_steps": 0}},
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        read_config(ForecastConfig, wrong)


def call(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str]:
    code = cli.main(["evaluate", *map(str, arguments), "-q"])
    return code, capsys.readouterr().err.strip()


def test_failures_are_one_line_and_a_code(folder: Path, weights: Path, tmp_path: Path, capsys) -> None:
    empty, blind = tmp_path / "empty", tmp_path / "blind"
    empty.mkdir()
    blind.mkdir()
    write_log(blind / "a.mcap", [detection(60.0 * k, 0.0, 0.0) for k in range(3)])
    wrong_kind = checkpoint(tmp_path / "wrong.safetensors", preset="general")
    cases = [
        ((empty, "--checkpoint", weights), 3, "holds no log"),
        ((tmp_path / "nowhere", "--checkpoint", weights), 3, "not a folder"),
        ((blind, "--checkpoint", weights, "--out", tmp_path / "o"), 3, "has no truth"),
        ((folder, "--checkpoint", "no_such_name"), 4, "checkpoint 'no_such_name': not found"),
        ((folder, "--checkpoint", wrong_kind), 4, "which does not forecast"),
        ((folder, "--checkpoint", "general"), 4, "which does not forecast"),
        ((folder,), 2, "--checkpoint"),
        ((folder / "log_0.mcap", "--checkpoint", weights), 2, "give the folder"),
        ((folder, "--out", tmp_path), 2, "--out is for --checkpoint"),
    ]
    for arguments, code, words in cases:
        got, text = call(capsys, *arguments)
        last = text.splitlines()[-1]
        assert (got, words in last) == (code, True), (arguments, text)
        assert last.startswith("cadence: error: ")
    assert not list(empty.iterdir()) and not (folder / "forecast.json").exists()


def test_the_command_prints_the_scores(folder: Path, weights: Path, tmp_path: Path, capsys) -> None:
    settings = ["num_windows=12", "num_hypotheses=3", "rivals=[]", 'paper.sampler="dpmpp"', "paper.num_steps=2"]
    sets = [word for setting in settings for word in ("--set", f"evaluate.forecast.{setting}")]
    code = cli.main(["evaluate", str(folder), "--checkpoint", str(weights), "--out", str(tmp_path / "out"), *sets, "-q"])
    printed = capsys.readouterr().out
    assert code == 0 and "forecast: done" in printed and "trained" in printed
    assert "120 min" in printed and "energy score" in printed


def test_missions_are_scored_as_before(tmp_path: Path) -> None:
    (tmp_path / "mission").mkdir()
    (tmp_path / "mission" / "catalogue.json").write_text("{}")
    with pytest.raises(UsageError, match="folder of logs"):
        evaluate_any(tmp_path / "mission", "general", None, EvaluateConfig(), QUIET)


def test_blocks_that_cannot_be_read_are_made_again(tmp_path: Path) -> None:
    path = tmp_path / "block.json"
    path.write_text('{"measures": []}')
    assert forecasts._kept(path) is None and forecasts._kept(tmp_path / "none.json") is None
    with pytest.raises(LookupError):
        EpisodeScores.from_json("{}")
