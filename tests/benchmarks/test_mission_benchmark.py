"""The benchmark of mission hypotheses: ratios and regions by gap, and steps at borders against the same ones inside."""

import numpy as np
import pytest

from benchmarks.mission import KEPT, MISSION, WINDOWS, borders, rows_of, section
from benchmarks.publishing import Measurement
from cadence.stories import Stories
from pipeline.stories import Block, MissionStories
from pipeline.tables import Frame


def result(energy: float, held: float, num: int = 40) -> dict[str, object]:
    value = {metric: [energy if metric == "energy_score_fair_m" else held] * num for metric in KEPT}
    gap = [8.0] * (num // 2) + [20.0] * (num - num // 2)
    laws = {f"border_{law}{end}": 0.1 for law in ("speed", "acceleration", "turn") for end in ("", "_p")}
    motion = {"speed_w1_mps": energy}
    return {
        "group": list(range(num)), "gap": gap, **value, "motion": motion, "cost_s": energy, "share_drawn": 0.5, **laws
    }  # fmt: skip


def test_rows_are_ratios_over_the_same_cells_by_gap() -> None:
    runs = [{MISSION: result(4.0, 0.8), WINDOWS: result(5.0, 0.9)}, {MISSION: result(2.0, 1.0), WINDOWS: result(3.0, 0.7)}]
    rows = rows_of({("ships", 5): runs})
    every, long = rows
    assert every["ratio"] == pytest.approx(6.0 / 8.0) and every["num_cells"] == 80
    assert every["mission_in_90"] == pytest.approx(0.9) and every["windows_in_90"] == pytest.approx(0.8)
    assert (long["gaps"], long["num_cells"]) == ("over 16 steps", 40)
    # windows that were scored are half of all
    assert every["cost_ratio"] == pytest.approx(6.0 / 16.0) and long["cost_ratio"] is None
    text = section(Measurement("mission", {}, {"mission": rows}))
    assert "0.75 [" in text and text.count("ships") == 2


def walk(seed: int, jump_m: float, at: int) -> MissionStories:
    """Forty random walks of 96 steps, all of which jump aside at a step."""
    step = np.random.default_rng(seed).normal(0.0, 1.0, (40, 1, 95, 2)) + 3.0
    step[:, :, at] += jump_m
    way = np.concatenate([np.zeros((40, 1, 1, 2)), step.cumsum(axis=2)], axis=2)
    stories = Stories(np.arange(96.0), way, np.full(40, 1 / 40), ("a",))
    return MissionStories(Frame("map"), "log", 0, stories, (Block(0, 96, 0, 10**9),))


def test_a_jump_at_a_border_is_seen_and_none_where_there_is_none() -> None:
    smooth, other = walk(1, 0.0, 40), walk(2, 0.0, 40)
    assert min(value for name, value in borders(smooth, other, 40, 30).items() if name.endswith("_p")) > 0.01
    assert borders(walk(1, 20.0, 40), other, 40, 30)["border_acceleration"] > 0.4
