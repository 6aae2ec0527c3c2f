"""Kalman rivals fitted to recordings."""

import numpy as np
import pytest
import torch

from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.baselines.recorded_kalman import RecordedKalman, detection_stretches, thin, waver
from cadence.recordings import Recordings, choose_windows, cut_windows
from cadence.types import Estimator

RIVALS = [ConstantVelocityKalman(), OrnsteinUhlenbeckKalman()]


def recorded(num: int = 8, length: int = 300, noise_m: float = 0.0, turn: float = 0.0) -> Recordings:
    """Tracks of 100 m a step whose heading drifts by `turn` radians a step, seen with white waver."""
    rng = np.random.default_rng(4)
    heading = rng.uniform(-3, 3, (num, 1)) + np.cumsum(turn * rng.standard_normal((num, length)), axis=1)
    place = np.cumsum(100.0 * np.stack([np.cos(heading), np.sin(heading)], axis=2), axis=1)
    place += noise_m * rng.standard_normal(place.shape)
    total = num * length
    return Recordings(
        60.0,
        np.arange(num + 1) * length,
        place.reshape(-1, 2).astype(np.float32),
        rng.random(total) < 0.2,
        np.zeros((total, 0, 2), dtype=np.float32),
        np.full((num, 2), np.nan, dtype=np.float32),
    )


@pytest.mark.parametrize("kalman", RIVALS, ids=lambda kalman: kalman.name)
def test_straight_tracks_are_continued(kalman: ConstantVelocityKalman) -> None:
    rec = recorded(noise_m=20.0)
    rival = RecordedKalman.from_recordings(rec, kalman)
    windows = cut_windows(rec, np.arange(8), np.full(8, 150))
    found = rival.sample(windows.windows, 60)
    error = torch.linalg.vector_norm(found.position_m.mean(1) - windows.truth_m, dim=-1)
    assert float(error[..., 30].mean()) < 0.05 * 100.0 * 150
    assert rival.waver_m == pytest.approx(20.0 * np.sqrt(1.5), rel=0.1)


@pytest.mark.parametrize("kalman", RIVALS, ids=lambda kalman: kalman.name)
def test_the_call_is_that_of_every_estimator(kalman: ConstantVelocityKalman) -> None:
    rec = recorded(turn=0.1)
    fitted = RecordedKalman.from_recordings(rec, kalman)
    rival: Estimator = fitted
    assert rival.name == kalman.name and rival.fit(detection_stretches(rec, 16, 4)) is fitted
    windows = cut_windows(rec, *choose_windows(rec, 10, np.random.default_rng(0)))
    found = rival.sample(windows.windows, 5)
    assert tuple(found.position_m.shape) == (10, 5, 1, 120, 2) and torch.isfinite(found.position_m).all()
    assert torch.allclose(found.weight.sum(1), torch.ones(10, dtype=found.weight.dtype))
    alone = torch.cat([rival.sample(windows[i : i + 1].windows, 5).position_m for i in range(10)])
    torch.testing.assert_close(alone, found.position_m, rtol=1e-6, atol=1e-3)


def test_thinning_is_that_of_a_loop() -> None:
    rec = recorded()
    windows = cut_windows(rec, *choose_windows(rec, 30, np.random.default_rng(1)), known_start=False)
    detections = windows.windows.detections
    found = thin(detections, 16 * 60.0, 5)
    for row in range(30):
        mask = detections.is_observed[row, 0]
        step = np.rint(detections.time_s[row, 0, mask].numpy() / 60.0).astype(int)
        kept: list[int] = []
        for place in range(len(step) - 1, -1, -1):
            if (not kept or step[kept[0]] - step[place] >= 16) and len(kept) < 5:
                kept.insert(0, place)
        if len(kept) == 1 and len(step) > 1:
            kept = [0, *kept]
        got = found.is_observed[row, 0]
        assert int(got.sum()) == len(kept) and bool(got[: len(kept)].all())
        torch.testing.assert_close(found.position_m[row, 0, got], detections.position_m[row, 0, mask][kept])
        torch.testing.assert_close(found.time_s[row, 0, got], detections.time_s[row, 0, mask][kept])


def test_stretches_are_spaced_and_cover_the_detections() -> None:
    rec = recorded(3, 120)
    found = detection_stretches(rec, 10, 4)
    gaps = torch.diff(found.time_s[:, 0], dim=1)[found.is_observed[:, 0, 1:]]
    assert float(gaps.min()) >= 600.0
    assert not found.position_m[:, 0, 0].any() and found.time_s.shape[2] == 4
    assert bool((found.is_observed.to(torch.int8).diff(dim=-1) <= 0).all())


def test_straight_tracks_do_not_waver() -> None:
    assert waver(recorded(), 16) < 1e-2
    assert waver(recorded(2, 3), 16) == 0.0


def test_too_few_detections_are_refused() -> None:
    with pytest.raises(ValueError, match="16 steps apart"):
        RecordedKalman.from_recordings(recorded(4, 10), ConstantVelocityKalman())
