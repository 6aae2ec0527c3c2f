"""Silence from the tables of extract to weighed windows: files, exponent, gate, checkpoints that know standing sensors."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from test_infer import CONFIG, FRAME, START_NS, mission, run
from test_infer import detections as walk

from cadence.constraints.obstacles import Obstacles
from cadence.evidence.exponents import CANDIDATES, SAFE, choose_exponent
from cadence.evidence.footprints import DetectionCurve
from cadence.evidence.settings import WeighingConfig
from cadence.evidence.silence import Looks, Silence
from cadence.types import Context, Detections, HypothesisSet, WindowBatch
from pipeline.infer.silence import hear_silence
from pipeline.looks import Footprint, LookRows, write_looks
from pipeline.manifest import read_manifest
from pipeline.results import read_hypothesis_tables
from pipeline.tables import read_table
from pipeline.windows import MissionWindows

NUM = 60


def with_looks(directory: Path, place_m: tuple[float, float], probability: float = 0.9, is_standing: bool = True) -> Path:
    """A sensor that looks every 2 s from 96 to 118 s, while nobody sees T0."""
    time_ns = START_NS + np.arange(96, 120, 2) * 10**9
    num = len(time_ns)
    rows = LookRows(
        time_ns, ["mast"] * num, np.zeros(num, np.int64), np.zeros(num, np.int64), np.tile(place_m, (num, 1)), np.zeros(num),
        [frozenset()] * num,
    )  # fmt: skip
    curve = ((0.0, probability), (12.0, probability), (13.0, 0.0))
    write_looks(directory, "walk", rows, [Footprint("mast", (curve,), is_standing=is_standing)], FRAME)
    return directory


def weighed(directory: Path, **changes: object) -> tuple[list[dict], dict]:
    run(directory, dataclasses.replace(CONFIG, num_hypotheses=NUM), **changes)
    manifest = read_manifest("infer", directory)
    assert manifest is not None
    return read_table(directory / "windows.parquet", "windows")[0].to_pylist(), manifest["summary"]


def test_windows_are_weighed_by_silence_and_all_tell(tmp_path: Path) -> None:
    plain, _ = weighed(mission(tmp_path / "plain"))
    directory = with_looks(mission(tmp_path / "heard"), (330.0, 40.0 * np.sin(2.2)))
    rows, summary = weighed(directory, evidence=WeighingConfig(exponent=0.6))
    assert summary["silence"] == {"exponent": 0.6, "num_tests": 0, "ratios": {}, "num_looks": 12, "sensors": ["mast"]}
    told = {(row["window"], row["agent_id"]): row for row in rows}
    changed = [key for key, row in told.items() if row["num_effective"] is not None and row["num_effective"] < NUM - 1]
    assert (changed and all(agent == "T0" for _, agent in changed)) or {agent for _, agent in changed} == {"T0", "T1"}
    found = read_hypothesis_tables(directory)
    weight = [window.weight for window in found.windows if any(key[0] == window.window for key in changed)]
    assert all(np.ptp(some) > 0 for some in weight)
    agent = next(agent for window in found.windows for agent in window.agents if (window.window, agent.agent_id) in changed)
    assert agent.num_effective is not None
    before = [row for row in rows if row["origin_ns"] < START_NS + 96 * 10**9]
    same = [row for row in plain if row["origin_ns"] < START_NS + 96 * 10**9]
    assert [row | {"num_effective": None} for row in same] == before and before


def test_without_files_there_is_no_column_and_switched_off_no_byte_differs(tmp_path: Path) -> None:
    plain = mission(tmp_path / "plain")
    weighed(plain)
    off = with_looks(mission(tmp_path / "off"), (330.0, 0.0))
    weighed(off, evidence=WeighingConfig(is_used=False))
    zero = with_looks(mission(tmp_path / "zero"), (330.0, 0.0))
    _, summary = weighed(zero, evidence=WeighingConfig(exponent=0.0))
    assert any("not used: it is set so" in line for line in summary["remarks"])
    for other in (off, zero):
        for name in ("windows.parquet", "hypotheses.parquet"):
            assert (other / name).read_bytes() == (plain / name).read_bytes()


def test_where_hardly_anything_can_be_tested_the_exponent_is_safe(tmp_path: Path) -> None:
    _, summary = weighed(with_looks(mission(tmp_path), (330.0, 0.0)))
    assert summary["silence"]["exponent"] == SAFE and summary["silence"]["num_tests"] < 8


def looks(time_s: list[float], place_m: tuple[float, float]) -> Looks:
    num = len(time_s)
    curve = DetectionCurve(np.array([0.0, 100.0, 101.0]), np.array([0.5, 0.5, 0.0]))
    return Looks(np.array(time_s), np.tile(place_m, (num, 1)), np.ones(num), np.zeros(num), curve)


class TwoWays:
    """Half of the hypotheses go north, half south, by 200 m, and come back; the first and last steps are known."""

    name = "two ways"

    def fit(self, tracks: Detections) -> "TwoWays":
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        side = torch.where(torch.arange(num_hypotheses) % 2 == 0, 200.0, -200.0).double()
        way = torch.sin(torch.linspace(0.0, np.pi, windows.num_steps).double())
        wander = torch.randn(num_hypotheses, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        position = torch.zeros(windows.num_windows, num_hypotheses, 1, windows.num_steps, 2, dtype=torch.float64)
        position[..., 1] = ((side + 9.0 * wander)[:, None] * way)[None, :, None]
        weight = torch.full((windows.num_windows, num_hypotheses), 1.0 / num_hypotheses, dtype=torch.float64)
        return HypothesisSet(position, weight, (("ok",),) * windows.num_windows)


def two_ways(num: int, is_north: np.ndarray) -> tuple[WindowBatch, Detections]:
    """Windows of 21 steps, and a withheld detection in the middle of each, north or south."""
    time_s = torch.arange(-20.0, 1.0)
    ones = torch.ones(num, 1, 1)
    seen = Detections(0.0 * ones, torch.zeros(num, 1, 1, 2), torch.eye(2).expand(num, 1, 1, 2, 2), ones.bool())
    place = torch.zeros(num, 1, 1, 2)
    place[:, 0, 0, 1] = torch.from_numpy(np.where(is_north, 200.0, -200.0))
    withheld = Detections(-10.0 * ones, place, torch.eye(2).expand(num, 1, 1, 2, 2), ones.bool())
    context = Context(torch.zeros(num, 2).double(), torch.arange(num) * 100.0 + 50.0)
    return WindowBatch(time_s, seen, torch.arange(num), 20, context), withheld


@pytest.mark.parametrize(("share", "expected"), [(1.0, (0.6, 1.0)), (0.0, (0.0,)), (0.5, (0.0, SAFE))])
def test_the_exponent_is_what_withheld_detections_tell(share: float, expected: tuple[float, ...]) -> None:
    """A sensor watches the south and never sees anybody; targets go north, or south none the less."""
    num = 24
    is_north = np.arange(num) < share * num
    batch, withheld = two_ways(num, np.random.default_rng(0).permutation(is_north))
    times = [100.0 * window + 40.0 + i for window in range(num) for i in (-1.0, 0.0, 1.0)]
    chosen = choose_exponent(TwoWays(), batch, withheld, (Silence((looks(times, (0.0, -200.0)),)),))
    assert chosen.exponent in expected and chosen.num_tests == num and set(chosen.ratios) == set(CANDIDATES)
    assert (chosen.ratios[1.0] < 1) == (share == 1.0)


def test_standing_sensors_that_a_checkpoint_has_learned_do_not_count_twice() -> None:
    batch, _ = two_ways(3, np.ones(3, dtype=bool))
    windows = MissionWindows(batch, START_NS + np.arange(3) * 10**9, 10**9, ("T0",), np.zeros((3, 2)))
    curve = ((0.0, 0.5), (9.0, 0.0))
    mast, plane = Footprint("mast", (curve,), is_standing=True), Footprint("plane", (curve,), is_hidden=True)
    some = looks([1.0, 2.0], (0.0, 0.0))
    given = (Obstacles.none(), WeighingConfig(exponent=1.0), TwoWays(), windows, START_NS)
    heard = hear_silence([(mast, some), (plane, some)], *given, knows_standing=True)
    assert heard.about["silence"]["sensors"] == ["plane"] and len(heard.evidence) == 1
    assert heard.remarks == ("silence of sensors that stand is left out: this checkpoint has learned it with its tracks",)
    alone = hear_silence([(mast, some)], *given, knows_standing=True)
    assert alone.evidence == () and alone.about == {} and len(alone.remarks) == 1
    both = hear_silence([(mast, some), (plane, some)], *given, knows_standing=False)
    assert len(both.evidence) == 2 and both.remarks == ()


def test_the_ground_lies_between_sensors_and_sightings() -> None:
    batch, _ = two_ways(3, np.ones(3, dtype=bool))
    windows = MissionWindows(
        batch, START_NS + (np.arange(3) * 100 + 50) * 10**9, 10**9, ("T0",), np.array([[0.0, 0], [7, 0], [9, 0]])
    )
    plane = Footprint("plane", (((0.0, 0.5), (9.0, 0.0)),))
    given = (Obstacles.none(), WeighingConfig(exponent=1.0), TwoWays(), windows, START_NS)
    (silence,) = hear_silence([(plane, looks([60.0, 160.0], (0.0, -200.0)))], *given, knows_standing=False).evidence
    assert isinstance(silence, Silence) and silence.ground is not None
    assert silence.ground.time_s.tolist() == pytest.approx([50.0, 60.0, 150.0, 160.0, 250.0])
    assert silence.ground.position_m.tolist() == [[0.0, 0.0], [0.0, -200.0], [7.0, 0.0], [0.0, -200.0], [9.0, 0.0]]


def test_a_log_in_which_silence_misleads_is_gated(monkeypatch: pytest.MonkeyPatch) -> None:
    num = 24
    batch, withheld = two_ways(num, np.zeros(num, dtype=bool))
    monkeypatch.setattr("pipeline.infer.silence.withhold", lambda windows, seed: (windows, withheld))
    origins = START_NS + ((np.arange(num) * 100 + 50) * 10**9)
    windows = MissionWindows(batch, origins, 10**9, ("T0",), np.zeros((num, 2)))
    times = [100.0 * window + 40.0 for window in range(num)]
    plane = Footprint("plane", (((0.0, 0.5), (9.0, 0.0)),))
    heard = hear_silence(
        [(plane, looks(times, (0.0, -200.0)))], Obstacles.none(), WeighingConfig(), TwoWays(), windows, START_NS, False
    )
    assert heard.evidence == () and heard.about["silence"]["exponent"] == 0.0
    assert "foresee withheld detections worse" in heard.remarks[0]


def test_walk_is_the_log_of_the_other_tests() -> None:
    assert walk().num_rows == 19
