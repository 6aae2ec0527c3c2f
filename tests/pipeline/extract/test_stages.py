"""The same objects on several channels count once; different objects, and sensors of their own, all count."""

from typing import Any

import numpy as np
from fixtures.detection_rows import rows, together

from pipeline.extract.positions import Positions
from pipeline.extract.stages import without_other_stages
from pipeline.suspicions import Suspicions

NAN = float("nan")


def cars(topic: str, named: bool, seed: int, noise_m: float = 0.3, shift_s: float = 0.0, y: float = 0.0) -> Positions:
    """Two cars that drive past each other, once a second."""
    rng = np.random.default_rng(seed)
    items: list[Any] = []
    for i in range(60):
        for name, x, line in (("a", 8.0 * i, y), ("b", 300 - 6.0 * i, y + 7)):
            moved = x + shift_s * (8.0 if name == "a" else -6.0)
            place = (moved + rng.normal(0, noise_m), line + rng.normal(0, noise_m))
            items.append((i, i + shift_s, *place, name if named else None))
    return rows(*items, topic=topic, sigma_m=NAN)


def kept(*parts: Positions, schemas: dict[str, str] | None = None) -> tuple[dict[str, int], list[str]]:
    """Rows that are left by topic, and what was said."""
    suspicions = Suspicions()
    known = {str(part.topic[0]): "my.Type" for part in parts} if schemas is None else schemas
    left = without_other_stages(together(*parts), known, suspicions)
    names, counts = np.unique(left.topic.astype(np.str_), return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True)), suspicions.lines()


def test_of_detected_tracked_and_predicted_objects_those_with_names_and_least_work_count() -> None:
    topics = {"/perception/detection/objects": "DetectedObjects", "/perception/tracking/objects": "TrackedObjects"}
    topics |= {"/perception/objects": "autoware_perception_msgs/msg/PredictedObjects"}
    parts = [cars(topic, place > 0, place) for place, topic in enumerate(topics)]
    counts, (line,) = kept(*parts, schemas=topics)
    assert counts == {"/perception/tracking/objects": 120}
    assert "/perception/tracking/objects is used, which says who was seen; 240 detections of" in line
    assert "[[extract.detections]]" in line


def test_without_names_the_rawest_counts() -> None:
    counts, (line,) = kept(cars("/target/filtered", False, 1, 0.1), cars("/target/detections", False, 2))
    assert counts == {"/target/detections": 120} and "of which least was made; 120 detections of /target/filtered" in line


def test_a_tracker_with_a_clock_of_its_own_that_confirms_late() -> None:
    late = cars("/radar/tracks", True, 1, shift_s=0.3)
    assert kept(cars("/radar/detections", False, 2), late[late.time_ns > 12e9])[0] == {"/radar/tracks": 96}


def test_what_the_user_named_and_what_nobody_else_holds_counts() -> None:
    raw, tracked = cars("/radar/detections", False, 1), cars("/radar/tracks", True, 2)
    assert kept(raw, tracked, schemas={"/radar/tracks": "my.Type"})[1] == []
    for other in (
        cars("/lidar/detections", False, 2),  # another sensor, at the same moments
        cars("/radar/tracks", True, 2, y=500.0),  # other cars
        cars("/radar/tracks", True, 2)[:4],  # hardly anything
    ):
        assert kept(raw, other) == ({"/radar/detections": 120, str(other.topic[0]): len(other)}, [])


def test_names_of_a_few_do_not_outweigh_the_others() -> None:
    assert kept(cars("/radar/detections", False, 1), cars("/radar/tracks", True, 2)[:40])[0] == {"/radar/detections": 120}


def test_kinds_that_are_trusted_are_not_looked_for() -> None:
    both = together(cars("/target/raw", False, 1), cars("/target/filtered", False, 2))
    assert len(without_other_stages(both, {"/target/raw": "", "/target/filtered": ""}, Suspicions(["stage"]))) == 240
