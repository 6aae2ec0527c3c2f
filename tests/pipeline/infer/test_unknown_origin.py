"""Detections of unknown origin through infer: associations, tracks under each, tables, known beside unknown."""

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from fixtures.mission import build_mission
from fixtures.paper_checkpoint import checkpoint
from fixtures.side_files import assert_near, read_hypotheses
from fixtures.unknown_origin import (
    CLUTTERED,
    CONFIG,
    GRID,
    START_NS,
    SWAPPED,
    TRUE,
    WEIGHT,
    detections,
    mission,
)

from cadence.association.types import AssociationConfig, AssociationHypotheses
from cadence.constraints.obstacles import Obstacles
from cadence.diffusion.settings import AbsoluteSampling
from cadence.errors import InputError
from cadence.evidence.settings import WeighingConfig
from cadence.types import Detections, HypothesisSet, WindowBatch
from pipeline import associations
from pipeline.associations import AssociatedWindows, DataAssociation, build_associated_windows, shared_out, tell_sources
from pipeline.export.config import ExportConfig
from pipeline.export.stage import export
from pipeline.grids import GridConfig
from pipeline.infer.config import InferConfig
from pipeline.infer.draws import draw_associations
from pipeline.infer.stage import infer
from pipeline.logs.reader import open_log
from pipeline.progress import Doing, Progress, RelayedProgress
from pipeline.report.config import ReportConfig
from pipeline.report.stage import report
from pipeline.results import read_hypothesis_tables
from pipeline.tables import Frame, read_table, write_table
from pipeline.tracks import UNKNOWN_AGENT
from schemas.channels import message_class
from schemas.tables import ASSOCIATIONS, LABELS

QUIET = Progress(quiet=True)


def three_associations(
    time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_
) -> list[AssociationHypotheses]:
    """The truth; one detection given to the other agent; one taken for clutter."""
    label = np.stack([TRUE, SWAPPED, CLUTTERED])[:, : len(time_s)]
    return [AssociationHypotheses(label[:, : int((time_s <= origin).sum())], WEIGHT, 2) for origin in origins_s]


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(associations, "associate", three_associations)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)


def associated(table: pa.Table, num_hypotheses: int = 8) -> AssociatedWindows:
    sources = tell_sources(table, GRID, AssociationConfig(), 0)
    return build_associated_windows(table, sources, 0, num_hypotheses)


def test_hypotheses_are_shared_out_by_weight() -> None:
    for seed in range(20):
        assert np.bincount(shared_out(WEIGHT, 8, seed), minlength=3).tolist() == [4, 3, 1]
        odd = np.bincount(shared_out(np.array([0.7, 0.3]), 15, seed), minlength=2)
        assert odd.sum() == 15 and abs(odd[0] - 10.5) < 1.0
    assert set(shared_out(np.array([1.0, 0.0]), 5, 0).tolist()) == {0}
    shares = np.mean([np.bincount(shared_out(np.array([0.9, 0.1]), 3, seed), minlength=2) for seed in range(2000)], axis=0)
    assert shares == pytest.approx([2.7, 0.3], abs=0.05)


@pytest.mark.usefixtures("stand_in")
def test_tracks_that_associations_share_are_drawn_once() -> None:
    found = associated(detections())
    assert found.windows.agent_ids == ("a0", "a1") and found.windows.batch.num_windows == 2
    windows, column = found.tracks(slice(0, 2))
    # at the first origin all associations agree; at the second a0 has two tracks (with and without detection 14) and a1 three
    # (with 14, without 15, and as it was)
    assert windows.batch.is_active.sum(1).tolist() == [2, 5]
    assert column.shape == (2, 8, 2) and bool((column >= 0).all())
    assert len(column[0].unique(dim=0)) == 1 and column[1].unique(dim=0, return_counts=True)[1].sum() == 8
    counts = sorted(column[1].unique(dim=0, return_counts=True)[1].tolist())
    assert counts == [1, 3, 4]
    assert sorted(windows.batch.detections.count[1].tolist()) == [3, 3, 4, 4, 5]


@pytest.mark.usefixtures("stand_in")
def test_every_association_is_a_window_for_estimators_of_several_agents() -> None:
    found = associated(detections())
    windows, window, count = found.by_association(slice(0, 2))
    assert window.tolist() == [0, 0, 0, 1, 1, 1] and count.tolist() == [4, 3, 1, 4, 3, 1]
    assert windows.batch.detections.count[3:].tolist() == [[4, 4], [3, 5], [4, 3]]
    assert len(set(windows.batch.seeds.tolist())) == 6

    class Counting:
        """Every agent stands at its number of detections; x is the time since the mission began."""

        name = "counting"

        def fit(self, tracks: Detections) -> "Counting":
            return self

        def sample(self, batch: WindowBatch, size: int) -> HypothesisSet:
            elapsed_s = batch.required_context(self.name).elapsed_s
            assert elapsed_s is not None
            position = torch.zeros(batch.num_windows, size, 2, batch.num_steps, 2)
            position[..., 0] = elapsed_s[:, None, None, None]
            position[..., 1] = batch.detections.count[:, None, :, None]
            weight = torch.full((batch.num_windows, size), 1.0 / size)
            return HypothesisSet(position, weight, (("ok", "ok"),) * batch.num_windows)

    start_ns = int(found.windows.origins_ns[1]) - 10**9
    located = found.located(start_ns, Obstacles.none())
    (piece,) = draw_associations(Counting(), located, 8, WeighingConfig())
    part, found_set = piece()
    position, weight = found_set.position_m, found_set.weight
    assert part.tolist() == [0, 1] and found_set.status == (("ok", "ok"), ("ok", "ok"))
    torch.testing.assert_close(weight, torch.full((2, 8), 0.125, dtype=torch.float64))
    assert position[1, :, 0, 0, 0].tolist() == [1.0] * 8
    assert position[1, :, 0, 0, 1].tolist() == [4] * 4 + [3] * 3 + [4]
    assert position[1, :, 1, 0, 1].tolist() == [4] * 4 + [5] * 3 + [3]


@pytest.mark.usefixtures("stand_in")
def test_hypotheses_pass_through_the_detections_of_their_association(tmp_path: Path) -> None:
    directory = mission(tmp_path, detections())
    result = infer(directory, CONFIG, QUIET)
    found = result.summary["association"]
    assert (found["num_detections"], found["num_agents"], found["mean_num_associations"]) == (16, 2, 3.0)
    assert found["counts"]["num_agents"] == 2 and found["counts"]["clutter"]["value"] < 0.05
    assert any(line.startswith("detections without identity: 2 agents") for line in result.summary["remarks"])
    last = read_hypothesis_tables(directory).windows[-1]
    assert [agent.agent_id for agent in last.agents] == ["a0", "a1"] and last.weight.sum() == pytest.approx(1.0)
    # detection 14 lies at 58 s, y = 0 m; the origin of the second window at 64 s, three steps later
    step = last.origin_index - 3
    south, north = (agent.position_m[:, step, 1] + agent.datum_m[1] for agent in last.agents)
    assert np.abs(south).max() < 200.0  # a0 is there whether it was seen or not
    assert sorted((north < 100.0).tolist()) == [False] * 5 + [True] * 3  # three of eight hypotheses took it for a1
    assert [agent.probability for agent in last.agents] == [1.0, 1.0]
    # detection 14: 0.375 bits of doubt between two; detection 15: 0.125 that it is clutter
    doubt = [-(p * np.log2(p) + (1 - p) * np.log2(1 - p)) for p in (0.375, 0.125)]
    expected = 0.625 * doubt[0] / 3.625, (0.375 * doubt[0] + 0.875 * doubt[1]) / (3 + 0.375 + 0.875)
    assert [agent.association_entropy_bits for agent in last.agents] == pytest.approx(expected)


@pytest.mark.usefixtures("stand_in")
def test_that_many_detections_have_no_name_is_said_before_one_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    for most in (16, 15):
        monkeypatch.setattr("pipeline.infer.writing._MANY_NAMELESS", most)
        infer(mission(tmp_path / str(most), detections()), CONFIG, RelayedProgress(tell=told.append))
    (note,) = [line for line in told if isinstance(line, str) and "do not say whose they are" in line]
    assert note.startswith("infer: 16 detections") and 'agent = "NAME"' in note


def test_how_far_telling_apart_is_comes_before_the_windows(tmp_path: Path) -> None:
    told: list[object] = []
    config = dataclasses.replace(CONFIG, association=AssociationConfig(num_particles=8))
    infer(mission(tmp_path, detections()), config, RelayedProgress(tell=told.append))
    shares = [share for share in told if isinstance(share, float)]
    assert shares == sorted(shares) and shares[-1] == 1.0
    apart = next(number for number, one in enumerate(told) if isinstance(one, Doing) and "tell apart" in one)
    windows = next(number for number, one in enumerate(told) if isinstance(one, Doing) and one.startswith("infer: fit"))
    assert apart < windows
    before = [share for share in told[:windows] if isinstance(share, float)]
    assert len(before) > 10 and before[-1] == pytest.approx(0.4)


@pytest.mark.usefixtures("stand_in")
def test_table_of_associations(tmp_path: Path) -> None:
    directory = mission(tmp_path, detections())
    infer(directory, CONFIG, QUIET)
    table, frame = read_table(directory / "associations.parquet", "associations")
    assert table.schema.equals(ASSOCIATIONS) and frame == Frame("map")
    found = {(row["sequence"], row["agent_id"]): row for row in table.to_pylist()}
    assert len(found) == 16 + 2 and found[0, "a0"]["probability"] == 1.0
    assert found[14, "a0"]["probability"] == 0.625 and found[14, "a1"]["probability"] == 0.375
    assert found[15, None]["first_probability"] == 0.125 and found[15, "a1"]["first_probability"] == 0.875
    assert [found[number, "a0"]["first_window"] for number in (0, 6, 8, 14)] == [0, 0, 1, 1]
    infer(directory, dataclasses.replace(CONFIG, is_associated=False), QUIET)
    assert not (directory / "associations.parquet").exists() and not (directory / "labels.parquet").exists()
    assert read_hypothesis_tables(directory).agent_ids == (UNKNOWN_AGENT,)


def test_an_agent_may_be_missing_from_a_hypothesis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def associate(time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_) -> list[AssociationHypotheses]:
        label = np.stack([TRUE, np.where(TRUE == 1, -1, 0)])
        return [AssociationHypotheses(label[:, : int((time_s <= o).sum())], np.array([0.75, 0.25]), 3) for o in origins_s]

    monkeypatch.setattr(associations, "associate", associate)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    directory = mission(tmp_path, detections())
    infer(directory, CONFIG, QUIET)
    for window in read_hypothesis_tables(directory).windows:
        first, second = window.agents  # the third is nowhere
        assert (first.probability, second.probability) == (1.0, 0.75) and np.isfinite(first.position_m).all()
        is_there = np.isfinite(second.position_m).all(axis=(1, 2))
        assert is_there.sum() == 6 and np.isnan(second.position_m[~is_there]).all()
        assert second.spread_m is not None and np.isfinite(second.spread_m) and second.num_detections == 4


@pytest.mark.usefixtures("stand_in")
def test_named_agents_stay_what_they_are(tmp_path: Path) -> None:
    """The first eight detections are of unknown origin, the others have names, one of them a name that would be ours."""
    names: list[str | None] = [None] * 8 + ["a0" if number % 2 else "wolf" for number in range(8)]
    directory = mission(tmp_path, detections(names))
    infer(directory, CONFIG, QUIET)
    found = read_hypothesis_tables(directory)
    assert found.agent_ids == ("a0", "a1", "a2", "wolf")
    by_name = {agent.agent_id: agent for agent in found.windows[-1].agents}
    assert by_name["wolf"].probability is None and by_name["wolf"].num_detections == 4
    assert by_name["a1"].probability == 0.0 or by_name["a1"].num_detections < 4
    table, _ = read_table(directory / "associations.parquet", "associations")
    assert set(table["sequence"].to_pylist()) == set(range(8)) and set(table["agent_id"].to_pylist()) == {"a1", "a2"}


def test_all_of_it_clutter_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def associate(time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_) -> list[AssociationHypotheses]:
        return [AssociationHypotheses(np.full((1, int((time_s <= o).sum())), -1), np.ones(1), 0) for o in origins_s]

    monkeypatch.setattr(associations, "associate", associate)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    with pytest.raises(InputError, match="clutter_share"):
        infer(mission(tmp_path, detections()), CONFIG, QUIET)


def test_the_real_filter_finds_both_agents_and_repeats_itself(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, association=AssociationConfig(num_particles=20))
    tables = []
    for name in ("one", "two"):
        directory = mission(tmp_path / name, detections())
        infer(directory, config, QUIET)
        tables.append([read_table(directory / f"{t}.parquet", t)[0] for t in ("hypotheses", "windows", "associations")])
    assert all(one.equals(two) for one, two in zip(*tables, strict=True))
    rows = [row for row in tables[0][2].to_pylist() if row["probability"] > 0.5]
    south = {row["agent_id"] for row in rows if row["sequence"] % 2 == 0}
    north = {row["agent_id"] for row in rows if row["sequence"] % 2 == 1}
    assert len(south) == len(north) == 1 and south != north


def test_side_file_and_page_tell_of_agents_and_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = build_mission(tmp_path)
    table, frame = read_table(directory / "detections.parquet", "detections")
    true = np.array([int(name[1:]) for name in table["agent_id"].to_pylist()])
    column = table.schema.get_field_index("agent_id")
    table = table.set_column(column, table.schema.field(column), pa.nulls(len(true), pa.string()))
    write_table(table, directory / "detections.parquet", "detections", frame)

    def associate(time_s, position_m, covariance_m2, origins_s, config, seed, habits=None, **_) -> list[AssociationHypotheses]:
        label = np.stack([true, np.where(np.arange(len(true)) % 5 == 0, -1, true), np.where(true == 1, -1, true)])
        return [AssociationHypotheses(label[:, : int((time_s <= o).sum())], np.array([0.5, 0.25, 0.25]), 2) for o in origins_s]

    monkeypatch.setattr(associations, "associate", associate)
    monkeypatch.setattr(associations, "fit_habits", lambda *_: None)
    infer(directory, CONFIG, QUIET)
    written = read_hypothesis_tables(directory)
    export(directory, ExportConfig(), QUIET)
    back = read_hypotheses(directory / "patrol.cadence.mcap")
    assert back.agent_ids == ("a0", "a1")
    for ours, theirs in zip(back.windows, written.windows, strict=True):
        for agent, expected in zip(ours.agents, theirs.agents, strict=True):
            assert_near(agent.position_m, expected.position_m, theirs.weight)
            assert (agent.probability, agent.association_entropy_bits) == (
                expected.probability,
                expected.association_entropy_bits,
            )
    log = open_log(directory / "patrol.cadence.mcap")
    kind, states = message_class("cadence.Detection"), message_class("cadence.Agents")
    found = [kind.FromString(raw.data) for raw in log.messages({"/cadence/detections"})]
    assert len(found) == len(true) and all(message.agent_id == "" for message in found)
    for number, message in enumerate(found):
        chance = {agent.id: agent.probability for agent in message.association.agents}
        clutter = 0.25 * (number % 5 == 0) + 0.25 * (true[number] == 1)
        assert chance == {f"a{true[number]}": 1.0 - clutter} and message.association.clutter_probability == clutter
        bits = -sum(p * np.log2(p) for p in (clutter, 1.0 - clutter) if p > 0)
        assert message.association.entropy_bits == pytest.approx(bits)
    ticks = [states.FromString(raw.data) for raw in log.messages({"/cadence/agents"})]
    assert {(a.id, a.probability) for tick in ticks for a in tick.agents} == {("a0", 1.0), ("a1", 0.75)}
    layout = (directory / "patrol.layout.json").read_text()
    for series in ("/cadence/detections.association.agents[:]", "probability", "association_entropy_bits"):
        assert series in layout
    report(directory, ReportConfig(), QUIET)
    page = (directory / "report.html").read_text()
    assert "Agents that were found" in page and f"{int((true == 0).sum())} of {len(true)}" in page


def slow(table: pa.Table) -> pa.Table:
    """The same with a minute for every second: the paper's and the place preset's steps are minutes."""
    time_ns = (table["time_ns"].to_numpy() - START_NS) * 60 + START_NS
    return table.set_column(table.schema.get_field_index("time_ns"), table.schema.field("time_ns"), pa.array(time_ns))


@pytest.mark.usefixtures("stand_in")
@pytest.mark.parametrize("preset", ["paper", "place"])
def test_presets_that_know_a_place_draw_every_association(tmp_path: Path, preset: str) -> None:
    directory = mission(tmp_path, slow(detections()))
    weights = "prison" if preset == "place" else str(checkpoint(tmp_path / "small.safetensors"))
    grid = GridConfig(stride_steps=32)
    config = InferConfig(num_hypotheses=8, checkpoint=weights, device="cpu", is_tested=False, grid=grid)
    if preset == "paper":
        config = dataclasses.replace(config, paper=AbsoluteSampling(sampler="dpmpp", num_steps=2))
    result = infer(directory, config, QUIET)
    assert result.summary["preset"] == preset and result.summary["association"]["num_agents"] == 2
    for window in read_hypothesis_tables(directory).windows:
        assert window.weight.sum() == pytest.approx(1.0) and [agent.agent_id for agent in window.agents] == ["a0", "a1"]
        assert all(len(agent.position_m) == 8 and np.isfinite(agent.position_m).all() for agent in window.agents)


@pytest.mark.usefixtures("stand_in")
def test_labels_bring_the_likeliest_association_back(tmp_path: Path) -> None:
    names: list[str | None] = [None] * 12 + ["wolf"] * 4
    table = detections(names)
    directory = mission(tmp_path, table)
    infer(directory, CONFIG, QUIET)
    labels, _ = read_table(directory / "labels.parquet", "labels")
    # the first window begins at 0 s, and a detection at its beginning is none of its; the last one tells of all
    assert labels["window"].to_pylist() == [0] * 7 + [1] * 12 and labels.schema.equals(LABELS)
    sources = tell_sources(table, GRID, AssociationConfig(), 0)
    assert sources.association is not None
    back = DataAssociation.of_labels(table, labels, sources.grid)
    assert back.named(table).equals(sources.named) and back.agent_ids == ("a0", "a1")
    for ours, theirs in zip(back.at_origins, sources.association.at_origins, strict=True):
        held = ours.label[0] != -1
        assert held.any() and np.array_equal(ours.label[0, held], theirs.label[0, held])
