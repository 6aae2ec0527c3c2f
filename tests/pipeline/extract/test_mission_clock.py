"""Times of whole logs: every source on one clock, whatever its stamps say; and silence where nothing is amiss."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.small_logs import START_NS, Row, write_log
from test_extract import Extracted, run

S = 10**9
DAY_S = 86400.0


def row(topic: str, log_s: float, stamp_ns: int, x: float, y: float = 0.0, schema: str = "foxglove.PoseInFrame") -> Row:
    """A pose logged at `log_s`, whose stamp is anything."""
    message: dict[str, Any] = {"timestamp": {"sec": stamp_ns // S, "nsec": stamp_ns % S}, "frame_id": "map"}
    return Row(topic, schema, log_s, message | {"pose": {"position": {"x": x, "y": y, "z": 0.0}}})


def contacts(name: str, ahead_s: float = 0.0, num: int = 30, late_s: float = 0.05) -> list[Row]:
    """One a second, moving at 5 m/s."""
    return [row(f"/contacts/{name}", i + late_s, START_NS + i * S + round(ahead_s * 1e9), 5.0 * i) for i in range(num)]


def seconds(found: Extracted, name: str = "A", table: str = "detections") -> list[float]:
    rows = found.table(table)
    times = (rows["time_ns"].to_numpy() - START_NS) * 1e-9
    return np.round(times[np.array(rows["agent_id"].to_pylist(), dtype=object) == name], 3).tolist()


def suspected(found: Extracted) -> list[str]:
    return [f"{record['kind']} {record['subject']}: {record['done']}" for record in found.summary["suspicions"]]


def test_stamps_count_where_one_clock_is_shared(tmp_path: Path) -> None:
    for ahead_s in (0.0, -DAY_S, 7200.0):  # a log, a recording that is played again, a clock that is simply wrong
        both = [*contacts("A", ahead_s), *contacts("B", ahead_s, late_s=0.4)]
        found = run(tmp_path, both)
        assert suspected(found) == [] and seconds(found) == [i + ahead_s for i in range(30)] == seconds(found, "B")


def test_a_source_on_another_clock_is_shifted_to_the_logs(tmp_path: Path) -> None:
    found = run(tmp_path, [*contacts("A"), *contacts("B", -7200.0)])
    assert seconds(found) == [float(i) for i in range(30)] and seconds(found, "B") == [i + 0.05 for i in range(30)]
    assert suspected(found) == ["time /contacts/B: its stamps are shifted by +7200.05 s"]


def test_a_second_receiver_that_says_the_same_later_is_late_and_not_on_another_clock(tmp_path: Path) -> None:
    prompt = [dataclasses.replace(each, topic="/south/contacts/A") for each in contacts("A")]
    late = [dataclasses.replace(each, topic="/north/contacts/A", time_s=each.time_s + 45.0) for each in prompt]
    found = run(tmp_path, [*prompt, *late])
    assert suspected(found) == [] and seconds(found) == [float(i) for i in range(30)]


def test_truth_on_another_clock_is_shifted_too(tmp_path: Path) -> None:
    truth = [dataclasses.replace(each, topic="/truth/A") for each in contacts("A", 315_964_800.0, 60)]
    found = run(tmp_path, [*contacts("A"), *truth])
    assert seconds(found, table="truth") == [i + 0.05 for i in range(60)] and "/truth/A" in suspected(found)[0]


def test_seconds_since_boot_read_as_they_are_written(tmp_path: Path) -> None:
    boot = [
        Row("/fmu/position", "", float(i), {"timestamp": 90_000_000 + 10**6 * i, "x": 2.0 * i, "y": 0.0}) for i in range(40)
    ]
    source = {"topic": "/fmu/position", "x": "x", "y": "y", "agent": "A"}
    found = run(tmp_path, boot, detections=[source])
    assert seconds(found) == [float(i) for i in range(40)] and found.summary["span_s"] == pytest.approx(39.0)
    (told,) = found.summary["suspicions"]
    assert "stamps run over 3.9e+07 s while the log runs over 39 s" in told["seen"] and 'time = "log_time"' in told["setting"]
    assert suspected(run(tmp_path, boot, detections=[source | {"time": "log_time"}])) == []
    assert run(tmp_path, boot, detections=[source], trusted=["time"]).summary["span_s"] == pytest.approx(39e6)


def test_frozen_and_coarse_stamps_give_way_to_the_log(tmp_path: Path) -> None:
    frozen = [row("/target/detections", float(i), START_NS, 5.0 * i) for i in range(30)]
    found = run(tmp_path, frozen)
    assert found.summary["span_s"] == pytest.approx(29.0) and suspected(found) == [
        "time /target/detections: 30 times are those of the log"
    ]
    for unit in (0, 1, 1000):  # only seconds, and nanoseconds that hold milli- or microseconds
        coarse = [row("/contacts/A", i / 10, START_NS + i // 10 * S + i % 10 * 100 * unit, 2.0 * i) for i in range(300)]
        found = run(tmp_path, coarse)
        assert seconds(found) == [i / 10 for i in range(300)] and len(suspected(found)) == 1


def test_unset_stamps_are_of_the_clock_of_the_others(tmp_path: Path) -> None:
    on_log = run(tmp_path, [row("/contacts/A", float(i), (START_NS + i * S) * (i >= 2), 5.0 * i) for i in range(30)])
    assert seconds(on_log) == [float(i) for i in range(30)] and suspected(on_log) == []
    simulated = [row("/contacts/A", float(i), (100 + i) * S * (i >= 5), 5.0 * i) for i in range(30)]
    found = run(tmp_path, simulated)
    assert found.summary["span_s"] == pytest.approx(29.0) and found.detections["time_ns"][0].as_py() == 100 * S
    assert suspected(found) == ["time /contacts/A: 5 times are those of the log"]


def test_a_recording_that_is_played_in_a_loop_counts_once(tmp_path: Path) -> None:
    loops = [row("/contacts/A", 30.0 * loop + i, START_NS + i * S, 5.0 * i + loop) for loop in range(3) for i in range(30)]
    found = run(tmp_path, loops)
    assert seconds(found) == [float(i) for i in range(30)]
    assert found.detections["x_m"].to_pylist() == [5.0 * i for i in range(30)]
    assert suspected(found) == ["time /contacts/A: the first time counts, 60 positions of the others are left out"]


def shifted(rows: list[Row], shift_s: float) -> list[Row]:
    """The same rows, stamped and logged at another time."""
    found = []
    for each in rows:
        assert isinstance(each.message, dict)
        at_ns = each.message["timestamp"]["sec"] * S + each.message["timestamp"]["nsec"] + round(shift_s * S)
        message = each.message | {"timestamp": {"sec": at_ns // S, "nsec": at_ns % S}}
        found.append(dataclasses.replace(each, time_s=each.time_s + shift_s, message=message))
    return found


def test_parts_between_which_the_clock_was_set_are_not_joined(tmp_path: Path) -> None:
    rows = contacts("A", num=40, late_s=0.0)
    found = run(tmp_path, [*shifted(rows[:10], -1.6e9), *rows[10:]])
    assert seconds(found) == [float(i) for i in range(10, 40)] and found.summary["span_s"] == pytest.approx(29.0)
    (told,) = found.summary["suspicions"]
    assert told["subject"] == "the whole log" and "2 stretches of 10, 30 detections" in told["seen"]
    assert "10 positions outside are left out" in told["done"] and "extract.start" in told["setting"]
    assert suspected(run(tmp_path, [*shifted(rows[:10], -1.6e9), *rows[10:]], start="2020-01-01T00:00:00Z")) == []


def test_a_clock_that_is_set_back_leaves_two_parts(tmp_path: Path) -> None:
    rows = contacts("A", num=40, late_s=0.0)
    for back_s in (3600.0, 3.5):
        found = run(tmp_path, [*shifted(rows[:10], back_s), *rows[10:]])
        assert seconds(found) == [float(i) for i in range(10, 40)]
        assert suspected(found) == ["time /contacts/A: only 30 positions between two steps are used, 10 are left out"]


@pytest.mark.parametrize("ahead_s", [60.0, 3600.0, 5 * DAY_S])
def test_a_clock_that_is_set_forward_leaves_two_parts(ahead_s: float, tmp_path: Path) -> None:
    """Of two targets, which are where one more second takes them when an hour has passed."""
    both = sorted([*contacts("A", num=40, late_s=0.0), *contacts("B", num=40, late_s=0.0)], key=lambda each: each.time_s)
    found = run(tmp_path, [*both[:20], *shifted(both[20:], ahead_s)])
    assert seconds(found) == [i + ahead_s for i in range(10, 40)] == seconds(found, "B")
    (told,) = found.summary["suspicions"]
    assert told["subject"] == "the whole log" and "2 stretches of 20, 60 detections" in told["seen"]


@pytest.mark.parametrize("further_m", [0.0, 300.0])
def test_a_silence_after_which_targets_are_elsewhere_or_had_stopped_is_none(further_m: float, tmp_path: Path) -> None:
    slow = np.minimum(np.arange(40), np.maximum(9.5 - 0.5 ** np.arange(40), np.arange(40) - 20.0))  # brakes, waits, goes on
    places = 5.0 * (slow if not further_m else np.arange(40)) + further_m * (np.arange(40) >= 20)
    rows = [row("/contacts/A", float(i), START_NS + i * S, x) for i, x in enumerate(places)]
    assert suspected(run(tmp_path, [*rows[:20], *shifted(rows[20:], 3600.0)])) == []


def test_a_silence_of_one_source_is_none(tmp_path: Path) -> None:
    """Whatever its target does: others went on."""
    rows = contacts("A", num=40, late_s=0.0)
    pose = [row("/ownship/pose", 0.5 * i, START_NS + i * S // 2, 0.0) for i in range(400)]
    seen = sorted([*rows[:20], *shifted(rows[20:], 100.0), *pose], key=lambda each: each.time_s)
    assert suspected(run(tmp_path, seen)) == []


def test_passes_days_apart_are_one_mission(tmp_path: Path) -> None:
    rows = [dataclasses.replace(each, topic="/contacts/A") for each in contacts("A", num=30, late_s=0.0)]
    week = [each for day in range(8) for each in shifted(rows, 600.0 * day)]
    assert suspected(run(tmp_path, week)) == []
    sparse = [each for day in range(8) for each in shifted(rows[:1], 2 * DAY_S * day)]
    assert suspected(run(tmp_path, sparse)) == []


def _transform(log_s: float, stamp_ns: int, x: float) -> Row:
    message = {
        "timestamp": {"sec": stamp_ns // S, "nsec": stamp_ns % S}, "parent_frame_id": "map", "child_frame_id": "boat",
        "translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }  # fmt: skip
    return Row("/tf", "foxglove.FrameTransform", log_s, message)


@pytest.mark.parametrize(("detections_s", "transforms_s"), [(0.0, 0.0), (-DAY_S, -DAY_S), (-DAY_S, 0.0), (0.0, -DAY_S)])
def test_transforms_are_brought_to_the_same_clock(detections_s: float, transforms_s: float, tmp_path: Path) -> None:
    rows = contacts("A", detections_s, num=20, late_s=0.0)
    for each in rows:
        assert isinstance(each.message, dict)
        each.message["frame_id"] = "boat"
        each.message["pose"]["position"]["x"] = 100.0 - 5 * each.time_s  # a target that stands, seen from a boat at 5 m/s
    moving = [_transform(i / 2, START_NS + i * S // 2 + round(transforms_s * S), 2.5 * i) for i in range(41)]
    found = run(tmp_path, sorted([*rows, *moving], key=lambda each: each.time_s))
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 100.0, atol=1e-6)
    assert len(suspected(found)) == (detections_s != transforms_s)


def test_twenty_channels_are_judged_by_themselves(tmp_path: Path) -> None:
    rows = [each for i in range(20) for each in contacts(f"A{i}", -7200.0 if i == 7 else 0.0, num=5)]
    found = run(tmp_path, write_log(tmp_path / "many.mcap", sorted(rows, key=lambda each: each.time_s)))
    assert len(suspected(found)) == 1 and "/contacts/A7" in suspected(found)[0]


@pytest.mark.parametrize("chunk_bytes", [500, 16_384])
@pytest.mark.parametrize("back_s", [3600.0, 3.5])
def test_a_clock_that_is_set_back_where_messages_are_not_numbered(tmp_path: Path, back_s: float, chunk_bytes: int) -> None:
    """The order in which they were written tells, as rosbag2 numbers nothing."""
    both = sorted([*contacts("A", num=40, late_s=0.0), *contacts("B", num=40, late_s=0.0)], key=lambda each: each.time_s)
    log = write_log(tmp_path / "log.mcap", [*shifted(both[:20], back_s), *both[20:]], False, chunk_bytes)
    found = run(tmp_path, log)
    assert seconds(found) == [float(i) for i in range(10, 40)] == seconds(found, "B")
    (told,) = found.summary["suspicions"]
    assert f"step back 1 time in the order in which messages were written, by {back_s - 1:.3g} s" in told["seen"]
    assert "20 positions in others are left out" in told["done"] and "extract.start" in told["setting"]
    assert suspected(run(tmp_path, log, trusted=["time"])) == []


def test_messages_that_are_sorted_in_another_way_were_not_set_back(tmp_path: Path) -> None:
    """One target after the other, one of them in two halves, and every message a little late."""
    targets = {name: contacts(name, num=40, late_s=0.0) for name in "AB"}
    for rows in (
        [*targets["A"], *targets["B"]],
        [*targets["A"][20:], *targets["A"][:20], *targets["B"]],
        [each for pair in zip(targets["A"], targets["B"], strict=True) for each in shifted(list(pair), 0.0)[::-1]],
    ):
        assert suspected(run(tmp_path, write_log(tmp_path / "log.mcap", rows, False))) == []
