"""The infer stage on small mission directories: tables, seeds, skipping, place and time, obstacles, what it refuses."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import torch

from cadence.constraints.checker import segments_in_collision, states_in_collision
from cadence.diffusion.settings import GuidanceConfig, PlaceSampling
from cadence.errors import CadenceError, ConfigError, DeviceError, InputError
from cadence.network.residual import ResidualNetwork, ResidualNetworkConfig
from pipeline.checkpoints import CheckpointInfo, checkpoint_hash
from pipeline.config import config_as_dict
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import load_estimator
from pipeline.estimators.samplings import GeneralSampling, Samplings
from pipeline.files import hash_file
from pipeline.grids import GridConfig, plan_grid
from pipeline.infer import draws, writing
from pipeline.infer.config import InferConfig
from pipeline.infer.draws import draw_windows
from pipeline.infer.stage import infer
from pipeline.manifest import StageResult, read_manifest
from pipeline.obstacle_file import read_obstacles
from pipeline.progress import Doing, Progress, RelayedProgress
from pipeline.tables import Frame, read_table, write_table
from pipeline.weights import save_checkpoint
from pipeline.windows import build_windows
from schemas.tables import DETECTIONS, WINDOWS, hypotheses_schema

QUIET = Progress(quiet=True)
FRAME = Frame("local_enu", 50.8, -1.2)
START_NS = 1_700_000_000_000_000_000
GRID = GridConfig(step_s=2.0, history_steps=16, horizon_steps=8, stride_steps=16)
CONFIG = InferConfig(num_hypotheses=3, checkpoint="none", device="cpu", grid=GRID)
SMALL = ResidualNetworkConfig(width=8, multipliers=(1, 2), encoder_size=8, level_size=8)
DETECTED_S = {"T0": [0, 2, 4, 30, 32, 60, 62, 90, 92, 94, 120, 122, 150, 152], "T1": [6, 8, 10, 28, 30]}


def detections(shift_ns: int = 0, shift_m: tuple[float, float] = (0.0, 0.0)) -> pa.Table:
    """T0 goes in a wide curve all the time, T1 is seen in the first half minute only."""
    rows = []
    for number, (agent, times) in enumerate(DETECTED_S.items()):
        for sequence, time in enumerate(times):
            x_m, y_m = 3.0 * time, 40.0 * np.sin(0.02 * time) + 500.0 * number
            row = {"log_id": "walk", "time_ns": START_NS + time * 10**9 + shift_ns, "sensor_id": "camera", "agent_id": agent}
            row |= {"x_m": x_m + shift_m[0], "y_m": y_m + shift_m[1], "cov_xx_m2": 0.25, "cov_xy_m2": 0.0, "cov_yy_m2": 0.25}
            row |= {"num_merged": 1, "topic": "/seen", "log_time_ns": 0, "sequence": sequence}
            rows.append(row)
    rows.sort(key=lambda row: (row["time_ns"], row["agent_id"]))
    return pa.Table.from_pylist(rows, schema=DETECTIONS)


def mission(parent: Path, table: pa.Table | None = None, obstacles: tuple[dict[str, object], ...] = ()) -> Path:
    directory = parent / "walk"
    directory.mkdir(parents=True)
    write_table(detections() if table is None else table, directory / "detections.parquet", "detections", FRAME)
    (directory / "obstacles.json").write_text(json.dumps({"version": 1, "obstacles": list(obstacles)}))
    return directory


def checkpoint(folder: Path, head_scale: float = 0.1, preset: str = "general") -> Path:
    with torch.random.fork_rng(devices=[]):
        torch.random.manual_seed(0)
        network = ResidualNetwork(SMALL)
        with torch.no_grad():
            network.unet.head.weight.copy_(head_scale * torch.randn(network.unet.head.weight.shape))
    path = folder / "small.safetensors"
    save_checkpoint(path, network, CheckpointInfo(preset, config_as_dict(SMALL)))
    return path


def run(directory: Path, config: InferConfig = CONFIG, **changes: object) -> StageResult:
    return infer(directory, dataclasses.replace(config, **changes), QUIET)  # type: ignore[arg-type]


def tracks(directory: Path) -> tuple[pa.Table, np.ndarray]:
    """The rows, and their positions [rows, T, 2] in the mission frame."""
    table, _ = read_table(directory / "hypotheses.parquet", "hypotheses")
    flat = table["position_m"].combine_chunks().flatten().flatten().to_numpy().astype(np.float64)
    datum = np.stack([table["datum_x_m"].to_numpy(), table["datum_y_m"].to_numpy()], -1)
    return table, flat.reshape(len(table), -1, 2) + datum[:, None]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StageResult]:
    """A mission inferred with the bank alone."""
    directory = mission(tmp_path_factory.mktemp("done"))
    return directory, run(directory)


def test_hypotheses_have_the_schema_and_the_counts(done: tuple[Path, StageResult]) -> None:
    directory, result = done
    table, position = tracks(directory)
    windows, frame = read_table(directory / "windows.parquet", "windows")
    assert frame == FRAME and windows.schema.equals(WINDOWS) and table.schema.equals(hypotheses_schema(24))
    assert result.status == "done" and {path.name for path in result.outputs} == {"hypotheses.parquet", "windows.parquet"}
    assert result.summary["num_windows"] == 5 and result.summary["num_agents"] == 2
    assert len(windows) == 10 and result.summary["num_tracks"] == len(table)
    ok = [(row["window"], row["agent_id"]) for row in windows.to_pylist() if row["status"] == "ok"]
    found = list(zip(table["window"].to_pylist(), table["agent_id"].to_pylist(), table["hypothesis"].to_pylist(), strict=True))
    assert sorted(found) == sorted((*pair, k) for pair in ok for k in range(3))
    assert np.isfinite(position).all() and set(table["log_id"].to_pylist()) == {"walk"}
    assert set(table["step_ns"].to_pylist()) == {2 * 10**9} and set(table["origin_index"].to_pylist()) == {15}
    origins = [START_NS + 32 * 10**9 * (window + 1) for window in table["window"].to_pylist()]
    assert table["origin_ns"].to_pylist() == origins


def test_weights_sum_to_one_for_every_window_and_agent(done: tuple[Path, StageResult]) -> None:
    table, _ = tracks(done[0])
    sums = table.group_by(["window", "agent_id"]).aggregate([("weight", "sum")])
    np.testing.assert_allclose(sums["weight_sum"].to_numpy(), 1.0, atol=1e-6)


def test_windows_say_what_is_known_and_what_to_do(done: tuple[Path, StageResult]) -> None:
    directory, result = done
    windows, _ = read_table(directory / "windows.parquet", "windows")
    rows = windows.to_pylist()
    lost = [row for row in rows if row["status"] == "no_detections"]
    assert [(row["window"], row["agent_id"]) for row in lost] == [(w, "T1") for w in (1, 2, 3, 4)]
    assert all("infer.grid.history_steps" in row["advice"] for row in lost)
    assert all((row["num_detections"], row["age_s"], row["spread_m"]) == (0, None, None) for row in lost)
    assert result.summary["status"] == {"ok": 6, "no_detections": 4}
    kept = [row for row in rows if row["status"] == "ok"]
    assert [row["age_s"] for row in kept if row["agent_id"] == "T0"] == pytest.approx([0.0, 2.0, 2.0, 6.0, 8.0])
    assert [row["num_detections"] for row in kept if row["agent_id"] == "T0"] == [4, 2, 3, 2, 2]  # after the start
    assert all(row["advice"] is None and row["spread_m"] > 0 for row in kept)


def test_hypotheses_go_through_what_was_seen(done: tuple[Path, StageResult]) -> None:
    table, position = tracks(done[0])
    for row, (window, agent) in enumerate(zip(table["window"].to_pylist(), table["agent_id"].to_pylist(), strict=True)):
        origin_s = 32 * (window + 1)
        for time in DETECTED_S[agent]:
            if origin_s - 30 <= time <= origin_s:
                where = [3.0 * time, 40.0 * np.sin(0.02 * time) + 500.0 * (agent == "T1")]
                np.testing.assert_allclose(position[row, 15 + (time - origin_s) // 2], where, atol=3.0)  # six sigmas


def test_a_second_call_skips_and_another_configuration_does_not(tmp_path: Path) -> None:
    directory = mission(tmp_path)
    assert run(directory).status == "done"
    first = (directory / "hypotheses.parquet").read_bytes()
    assert run(directory).status == "skipped"
    again = infer(directory, CONFIG, QUIET, force=True)
    assert again.status == "done" and (directory / "hypotheses.parquet").read_bytes() == first
    assert run(directory, seed=1).status == "done"
    assert (directory / "hypotheses.parquet").read_bytes() != first
    assert run(directory, num_hypotheses=2).summary["num_tracks"] == 12
    (directory / "obstacles.json").write_text('{"version": 1, "obstacles": [], "note": "new"}')
    assert run(directory, num_hypotheses=2).status == "done"


def test_the_checkpoint_is_in_the_manifest_and_its_change_is_seen(tmp_path: Path) -> None:
    directory, weights = mission(tmp_path), checkpoint(tmp_path)
    config = dataclasses.replace(CONFIG, checkpoint=str(weights), is_gated=False)
    result = infer(directory, config, QUIET)
    manifest = read_manifest("infer", directory)
    assert manifest is not None
    assert manifest["summary"]["checkpoint_sha256"] == checkpoint_hash(weights) == result.summary["checkpoint_sha256"]
    assert manifest["config"]["checkpoint"] == str(weights) and manifest["summary"]["network"]["share_past"] == 1.0
    assert infer(directory, config, QUIET).status == "skipped"
    before = (directory / "hypotheses.parquet").read_bytes()
    checkpoint(tmp_path, 0.2)
    assert infer(directory, config, QUIET).status == "done"
    assert (directory / "hypotheses.parquet").read_bytes() != before
    checkpoint(tmp_path, 0.0)  # answers zero: the bank alone, to single precision
    infer(directory, config, QUIET)
    _, zero = tracks(directory)
    result = run(directory)
    assert result.summary["checkpoint_sha256"] is None and result.summary["num_steps"] == 0
    np.testing.assert_allclose(zero, tracks(directory)[1], atol=1e-3)


def test_the_gate_is_in_the_summary(tmp_path: Path) -> None:
    directory, weights = mission(tmp_path), checkpoint(tmp_path, 30.0)
    result = run(directory, checkpoint=str(weights), grid=dataclasses.replace(GRID, stride_steps=5))
    about = result.summary["network"]
    assert {"share_past", "share_future", "past_network", "future_network"} <= about.keys()
    assert about["share_future"] == 0.0 and about["future_network"] > 1.0


def test_the_number_of_threads_changes_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draws, "_TRACKS_AT_ONCE", 3)
    weights, digests = checkpoint(tmp_path), set()
    config = dataclasses.replace(CONFIG, checkpoint=str(weights), is_gated=False)
    for num_threads in (1, 3):
        directory = mission(tmp_path / str(num_threads))
        infer(directory, config, QUIET, num_threads=num_threads)
        digests.add(tuple(hash_file(directory / name) for name in ("hypotheses.parquet", "windows.parquet")))
    assert len(digests) == 1


def drawn(table: pa.Table, weights: Path) -> torch.Tensor:
    loaded = load_estimator(str(weights), Samplings(general=GeneralSampling(is_gated=False)))
    grid = plan_grid(table, loaded.grid(GRID))
    windows = build_windows(table, grid, 5)
    estimator = loaded.fitted(FittingData.of(table, grid, windows)).estimator
    parts = [piece()[1].position_m for piece in draw_windows(estimator, windows, CONFIG.num_hypotheses, loaded.is_apart)]
    return torch.cat(parts) + torch.from_numpy(windows.datum_m)[:, None, None, None]


def test_elsewhere_and_at_another_time_the_same_happens(tmp_path: Path) -> None:
    weights = checkpoint(tmp_path)
    here = drawn(detections(), weights)
    later = drawn(detections(shift_ns=86_400_000_000_123), weights)
    torch.testing.assert_close(later, here, atol=1e-4, rtol=0, equal_nan=True)
    moved = drawn(detections(shift_m=(20_000.0, -512.5)), weights)
    torch.testing.assert_close(moved - torch.tensor([20_000.0, -512.5]), here, atol=1e-2, rtol=0, equal_nan=True)
    assert torch.isfinite(here).any() and here.isnan().any()


def in_the_way() -> tuple[dict[str, object], ...]:
    """On the way of T0 in two gaps, and on that of T1."""
    middle = [(3.0 * t, 40.0 * np.sin(0.02 * t) + high, 10.0) for t, high in ((46, 0.0), (107, 0.0), (19, 500.0))]
    return tuple({"kind": "circle", "x_m": x, "y_m": y, "radius_m": r} for x, y, r in middle)


@pytest.mark.parametrize("mode", ["clean", "repair", "none"])
def test_obstacles_are_kept_clear_of(tmp_path: Path, mode: str) -> None:
    directory = mission(tmp_path, obstacles=in_the_way())
    config = dataclasses.replace(CONFIG, checkpoint=str(checkpoint(tmp_path, 0.05)), is_gated=False)
    result = infer(directory, dataclasses.replace(config, guidance=GuidanceConfig(mode)), QUIET)  # type: ignore[arg-type]
    table, position = tracks(directory)
    obstacles = read_obstacles(directory / "obstacles.json")
    paths = torch.from_numpy(position)
    num_hits = int(segments_in_collision(paths, obstacles).sum() + states_in_collision(paths, obstacles).sum())
    assert result.summary["status"] == {"ok": 6, "no_detections": 4}
    assert (num_hits > 0) == (mode == "none")
    sums = table.group_by(["window", "agent_id"]).aggregate([("weight", "sum")])
    np.testing.assert_allclose(sums["weight_sum"].to_numpy(), 1.0, atol=1e-6)


def test_a_detection_inside_an_obstacle_is_infeasible_and_says_so(tmp_path: Path) -> None:
    table = detections().filter(pc.equal(detections()["agent_id"], "T0"))
    exact = [
        pa.array([1e-8] * len(table)) if name in ("cov_xx_m2", "cov_yy_m2") else table[name] for name in table.column_names
    ]
    table = pa.Table.from_arrays(exact, schema=DETECTIONS)
    # around the detections at 60 and 62 s
    circle = {"kind": "circle", "x_m": 183.0, "y_m": 40.0 * np.sin(1.22), "radius_m": 8.0}
    directory = mission(tmp_path, table, (circle,))
    run(directory, guidance=GuidanceConfig(max_speed_mps=500.0))  # which is not the reason
    windows, _ = read_table(directory / "windows.parquet", "windows")
    rows = {row["window"]: row for row in windows.to_pylist()}
    assert rows[1]["status"] == "infeasible" and "infer.guidance (margin_m" in rows[1]["advice"]
    assert rows[4]["status"] == "ok"
    found, position = tracks(directory)
    assert len(found) == 15 and np.isfinite(position).all()  # infeasible ones are written too


def test_detections_that_need_more_than_the_stated_speed_say_how_much(tmp_path: Path) -> None:
    directory = mission(tmp_path)
    run(directory, guidance=GuidanceConfig(max_speed_mps=0.5))
    windows, _ = read_table(directory / "windows.parquet", "windows")
    advice = {row["advice"] for row in windows.to_pylist() if row["status"] == "infeasible"}
    assert advice and all(
        re.fullmatch(r"two detections \S+ s apart need \S+ m/s, and infer\.guidance.*", line) for line in advice
    )
    run(directory, guidance=GuidanceConfig(max_speed_mps=500.0))
    windows, _ = read_table(directory / "windows.parquet", "windows")
    assert "infeasible" not in windows["status"].to_pylist()


def test_what_takes_long_says_how_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(writing, "_FIRST_S", -1.0)
    monkeypatch.setattr(writing, "_LONG_S", -1.0)
    infer(mission(tmp_path), CONFIG, Progress(), num_threads=1)
    assert "infer: 5 windows, about 0 min by the first ones" in capsys.readouterr().err


def test_fitting_is_a_part_of_what_is_shown(tmp_path: Path) -> None:
    told: list[object] = []
    weights = checkpoint(tmp_path)
    infer(mission(tmp_path), dataclasses.replace(CONFIG, checkpoint=str(weights)), RelayedProgress(tell=told.append))
    shares = [share for share in told if isinstance(share, float)]
    drawn = next(number for number, one in enumerate(told) if one == Doing("infer 5 of 5 windows"))
    fitted = [share for share in told[:drawn] if isinstance(share, float)]
    assert shares == sorted(shares) and shares[-1] == 1.0 and told[0] == Doing("infer: getting ready")
    # two agents in five windows: what is fitted is about as much as what is drawn
    assert len(fitted) >= 3 and 0.25 < fitted[2] < 0.5 and Doing("infer: testing on detections held back") in told


def test_samples_that_are_not_finite_are_replaced(tmp_path: Path) -> None:
    directory, weights = mission(tmp_path), checkpoint(tmp_path, float("nan"))
    result = run(directory, checkpoint=str(weights), is_gated=False)
    assert result.summary["status"] == {"guidance_diverged": 6, "no_detections": 4}
    table, position = tracks(directory)
    run(directory)
    np.testing.assert_allclose(position, tracks(directory)[1], atol=1e-6)
    assert len(table) == 18


def refused(directory: Path, **changes: object) -> CadenceError:
    before = sorted(path.name for path in directory.iterdir())
    with pytest.raises(CadenceError) as caught:
        run(directory, **changes)
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in directory.iterdir()) == before  # nothing half-written
    return caught.value


def test_checkpoints_that_cannot_be_used(tmp_path: Path) -> None:
    directory, weights = mission(tmp_path), checkpoint(tmp_path)
    assert isinstance(refused(directory, checkpoint="nonesuch"), ConfigError)
    uneven = dataclasses.replace(GRID, history_steps=15)
    error = refused(directory, checkpoint=str(weights), grid=uneven)
    assert isinstance(error, ConfigError) and "multiple of 2" in str(error)
    beside = weights.with_suffix(".json")
    whole = beside.read_text()
    content = json.loads(whole)
    wide = {**content, "network": {**content["network"], "width": 16}}
    for text in ("{", json.dumps(content | {"format": 99}), json.dumps(wide), json.dumps(content | {"preset": "paper"})):
        beside.write_text(text)
        assert isinstance(refused(directory, checkpoint=str(weights)), ConfigError)
    beside.unlink()
    assert isinstance(refused(directory, checkpoint=str(weights)), ConfigError)
    beside.write_text(whole)
    weights.write_bytes(weights.read_bytes()[:100])
    assert isinstance(refused(directory, checkpoint=str(weights)), ConfigError)


def test_devices_and_inputs_that_are_not_there(tmp_path: Path) -> None:
    directory = mission(tmp_path)
    error = refused(directory, device="cuda:99")
    assert isinstance(error, DeviceError) and "cuda:99" in str(error)
    (directory / "obstacles.json").unlink()
    assert isinstance(refused(directory), InputError)
    (directory / "detections.parquet").write_bytes(b"PAR1")
    assert isinstance(refused(directory), InputError)
    (directory / "detections.parquet").unlink()
    assert isinstance(refused(directory), InputError)
    empty = mission(tmp_path / "empty", DETECTIONS.empty_table())
    assert isinstance(refused(empty), InputError)


def test_settings_that_the_preset_does_not_read_are_refused(tmp_path: Path) -> None:
    """They would change nothing, and nobody would notice."""
    directory = mission(tmp_path)
    for changes, setting in (
        ({"checkpoint": "prison", "num_steps": 6}, "infer.num_steps"),
        ({"checkpoint": "prison", "grid": GridConfig(step_s=5.0)}, "infer.grid.step_s"),
        ({"checkpoint": "none", "sampler": "ddim"}, "infer.sampler"),
        ({"checkpoint": "none", "place": PlaceSampling(num_steps=3)}, "infer.place.num_steps"),
    ):
        config = dataclasses.replace(InferConfig(), **changes)
        with pytest.raises(ConfigError, match=f"^{setting}: .* does not read it.* Read are: ") as caught:
            infer(directory, config, QUIET)
        assert caught.value.exit_code == 4 and "\n" not in str(caught.value)
    for checkpoint_name, changes in (("none", {"num_steps": None}), ("none", {"grid": GridConfig(stride_steps=32)})):
        config = dataclasses.replace(CONFIG, checkpoint=checkpoint_name, **changes)
        assert infer(directory, config, QUIET).status == "done"


def test_settings_that_mean_nothing() -> None:
    for changes in ({"num_hypotheses": 0}, {"num_steps": 0}, {"default_sigma_m": -1.0}):
        with pytest.raises(ValueError):
            dataclasses.replace(CONFIG, **changes)
    for guidance in ({"margin_m": -1.0}, {"max_speed_mps": 0.0}, {"max_speed_mps": float("nan")}):
        with pytest.raises(ValueError):
            GuidanceConfig(**guidance)  # type: ignore[arg-type]
