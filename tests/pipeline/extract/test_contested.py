"""Transforms that contradict themselves are named; those of a vehicle that jerks, or is seen with noise, are not."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fixtures.small_logs import Row
from scipy.spatial.transform import Rotation
from test_extract import run
from test_sensor_frames import json_transform_row, ros2_row, seen_row

STILL = Rotation.identity()


def drive(place_m: Callable[[int], complex]) -> list[Row]:
    """What is seen of places where a vehicle is said to be, ten times a second, with detections about it."""
    poses = [
        json_transform_row(0.1 * i, "map", "ship", (STILL, np.array([place_m(i).real, place_m(i).imag, 0.0])))
        for i in range(100)
    ]
    return [*poses, *(seen_row(0.5 * i, "ship") for i in range(18))]


NOISE = np.random.default_rng(2).normal(0.0, 1.5, (100, 2)) @ [1, 1j]


@pytest.mark.parametrize(
    ("place_m", "is_told"),
    [
        (lambda i: 0.2 * i + 15.0 * (i % 2), True),  # wheels and filter, in turn
        (lambda i: 0.2 * i + 15.0 * (i % 5 == 0), True),  # one of them seldom
        (lambda i: 0.2 * i + 0.1 * (i % 2), False),
        (lambda i: 0.2 * i + NOISE[i], False),
        (lambda i: 0.2 * i + 20.0 * (i > 50), False),  # a correction
        (lambda i: 0.2 * i, False),
    ],
)
def test_two_nodes_that_publish_one_transform(tmp_path: Path, place_m: Callable[[int], complex], is_told: bool) -> None:
    found = run(tmp_path, drive(place_m))
    told = [suspicion["seen"] for suspicion in found.summary["suspicions"] if "transform" in suspicion["subject"]]
    assert len(told) == is_told and all("as where two nodes publish it" in seen for seen in told)


@pytest.mark.parametrize(("moved_m", "is_told"), [(500.0, True), (0.01, False)])
def test_a_static_transform_that_changes(tmp_path: Path, moved_m: float, is_told: bool) -> None:
    masts = [ros2_row(float(i), "map", "radar", (STILL, np.array([moved_m * i, 0.0, 0.0]))) for i in (0, 1)]
    found = run(tmp_path, [*masts, *(seen_row(float(i)) for i in range(8))])
    (told,) = [*found.summary["suspicions"]] if is_told else [None]
    assert told is None or f"several values, {moved_m:.3g} m apart" in told["seen"]
    assert len(found.summary["suspicions"]) == is_told
