"""Recordings and the windows cut out of them, against loops written the plain way."""

import numpy as np
import pytest
from fixtures.recordings import random_recordings

from cadence.recordings import NUM_STEPS, Recordings, choose_windows, cut_windows


def recordings(seed: int = 0, lengths: tuple[int, ...] = (40, 7, 200)) -> Recordings:
    return random_recordings(seed, lengths, 0.3)


@pytest.mark.parametrize("known_start", [True, False])
@pytest.mark.parametrize("keep", [3, 512])
def test_windows_hold_the_last_detections_and_the_parked_future(known_start: bool, keep: int) -> None:
    rec = recordings()
    episode, step = choose_windows(rec, 50, np.random.default_rng(1), known_start)
    found = cut_windows(rec, episode, step, known_start=known_start, num_detections=keep, num_tracker_steps=5)
    for row, (e, t) in enumerate(zip(episode, step, strict=True)):
        first, end = rec.offset[e], rec.offset[e + 1]
        track, seen = rec.position_m[first:end].astype(float), rec.is_detected[first : first + t + 1].copy()
        seen[0] |= known_start
        at = np.flatnonzero(seen)[-keep:]
        datum = track[at[-1]]
        detections = found.windows.detections
        mask = detections.is_observed[row, 0].numpy()
        assert mask.sum() == len(at) and mask[: len(at)].all()
        assert np.allclose(detections.time_s[row, 0, : len(at)].numpy(), (at - t) * 60.0)
        assert np.allclose(detections.position_m[row, 0, : len(at)].numpy(), track[at] - datum)
        assert np.allclose(found.context.datum_m[row].numpy(), datum)
        future = track[np.minimum(t + np.arange(NUM_STEPS), len(track) - 1)]
        assert np.allclose(found.truth_m[row, 0].numpy(), future - datum)
        assert found.context.elapsed_s is not None and found.context.elapsed_s[row] == 60.0 * t
        trackers = found.context.tracker_m
        assert trackers is not None
        assert np.allclose(trackers[row, -1].numpy(), rec.tracker_m[first + t])
        assert (
            np.isnan(trackers[row, : max(0, 4 - t)].numpy()).all() and np.isfinite(trackers[row, max(0, 4 - t) :].numpy()).all()
        )
    assert len(np.unique(found.windows.seeds.numpy())) == len({*zip(episode.tolist(), step.tolist(), strict=True)})


def test_a_window_without_detections_is_not_active() -> None:
    rec = recordings()
    rec.is_detected[:] = False
    found = cut_windows(rec, np.array([0]), np.array([10]), known_start=False)
    assert not found.windows.is_active.any()
    assert np.allclose(found.truth_m[0, 0, 0].numpy(), rec.position_m[10])


def test_selection_and_concatenation_are_inverse() -> None:
    rec = recordings()
    again = Recordings.concatenate([rec.select([0]), rec.select(slice(1, 3))])
    for name in ("offset", "position_m", "is_detected", "tracker_m", "known_goal_m"):
        assert np.array_equal(getattr(again, name), getattr(rec, name)), name
    swapped = rec.select([2, 0])
    assert np.array_equal(swapped.position_m[200:], rec.position_m[:40])
    assert np.allclose(swapped.rates(), rec.rates()[[2, 0]])


def test_shapes_are_checked() -> None:
    rec = recordings()
    with pytest.raises(ValueError, match="offset"):
        Recordings(60.0, rec.offset + 1, rec.position_m, rec.is_detected, rec.tracker_m, rec.known_goal_m)
    with pytest.raises(ValueError, match="known_goal_m"):
        Recordings(60.0, rec.offset, rec.position_m, rec.is_detected, rec.tracker_m, rec.known_goal_m[:1])
    with pytest.raises(ValueError, match="outside its episode"):
        cut_windows(rec, np.array([1]), np.array([7]))
