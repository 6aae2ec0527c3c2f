"""The Kalman rivals for forecasting windows: fitted once to recorded episodes instead of to a log.

Targets that walk on a grid waver by a cell around their course, and exact detections at every step make a filter believe that
waver to be velocity. So detections are taken a few steps apart and are as exact as the waver, in the fit and in the windows.
"""

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from cadence.arrays import Int64s
from cadence.baselines.kalman import ConstantVelocityKalman, OrnsteinUhlenbeckKalman
from cadence.recordings import Recordings
from cadence.types import Detections, HypothesisSet, WindowBatch

_MAX_STRETCHES = 400


@dataclass(frozen=True, eq=False)
class RecordedKalman:
    """A fitted Kalman rival and how detections are brought to it.

    kalman          the filter
    spacing         steps between detections, at least; counted back from the last one
    num_detections  at most so many of a window, the last ones
    waver_m         standard deviation an axis of detections around the course
    """

    kalman: ConstantVelocityKalman | OrnsteinUhlenbeckKalman
    spacing: int = 16
    num_detections: int = 12
    waver_m: float = 0.0

    @staticmethod
    def from_recordings(
        recordings: Recordings,
        kalman: ConstantVelocityKalman | OrnsteinUhlenbeckKalman,
        spacing: int = 16,
        num_detections: int = 12,
    ) -> "RecordedKalman":
        """The filter of greatest likelihood for the detections of (at most 400 evenly chosen stretches of) recordings.

        Raises ValueError where no two detections lie far enough apart.
        """
        tracks = detection_stretches(recordings, spacing, num_detections)
        if not bool((tracks.count > 1).any()):
            raise ValueError(f"RecordedKalman: no two detections of one episode lie {spacing} steps apart")
        model = RecordedKalman(kalman, spacing, num_detections, waver(recordings, spacing))
        fitted = kalman.fit(model._with_waver(tracks), recordings.step_s)
        return dataclasses.replace(model, kalman=fitted)

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.kalman.name

    def fit(self, tracks: Detections) -> Self:
        """The filter itself: it was fitted to recordings."""
        return self

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint samples of past and future; deterministic in the windows' seeds.

        Windows with equally many detections are drawn together: padding would move the samples by the smoother's jitter.
        """
        thinned = self._with_waver(thin(windows.detections, self.spacing * windows.step_s, self.num_detections))
        batch = WindowBatch(windows.time_s, thinned, windows.seeds, windows.origin_index)
        longest = thinned.count.amax(dim=1)
        order = longest.argsort(stable=True)
        groups = torch.split(order, longest.bincount().tolist()) if len(order) else (order,)
        parts = [self.kalman.sample(batch[group], num_hypotheses) for group in groups if len(group) or not len(order)]
        back = order.argsort()
        status = [words for part in parts for words in part.status]
        return HypothesisSet(
            torch.cat([part.position_m for part in parts])[back],
            torch.cat([part.weight for part in parts])[back],
            tuple(status[place] for place in back.tolist()),
        )

    def _with_waver(self, detections: Detections) -> Detections:
        wider = detections.covariance_m2 + self.waver_m**2 * torch.eye(2, dtype=detections.covariance_m2.dtype)
        return dataclasses.replace(detections, covariance_m2=wider)


def thin(detections: Detections, spacing_s: float, num_detections: int) -> Detections:
    """The last detection, before it those at least `spacing_s` older than the one kept after them, oldest first.

    Where that leaves a single one, the oldest is kept too: it is all there is to tell the velocity from.
    """
    b, a, n = detections.time_s.shape
    observed, time_s = detections.is_observed, detections.time_s.double()
    is_kept = torch.zeros_like(observed)
    count, newer_s = torch.zeros(b, a, dtype=torch.int64), torch.full((b, a), torch.inf, dtype=torch.float64)
    for i in range(n - 1, -1, -1):
        # half a millisecond forgives times that are not quite multiples of a step
        keep = observed[..., i] & (newer_s - time_s[..., i] >= spacing_s - 5e-4) & (count < num_detections)
        is_kept[..., i] = keep
        newer_s = torch.where(keep, time_s[..., i], newer_s)
        count += keep
    if n:
        is_kept[..., 0] |= observed[..., 0] & (count == 1)
    order = _packed(is_kept)
    return Detections(
        detections.time_s.gather(2, order),
        detections.position_m.gather(2, order[..., None].expand(*order.shape, 2)),
        detections.covariance_m2.gather(2, order[..., None, None].expand(*order.shape, 2, 2)),
        is_kept.gather(2, order),
    )


def _packed(is_kept: torch.Tensor) -> torch.Tensor:
    """Indices [B, A, N'] that bring the kept ones to the front in their order, N' as many as any agent keeps."""
    width = max(1, int(is_kept.sum(dim=-1).max())) if is_kept.numel() else is_kept.shape[2]
    return torch.argsort((~is_kept).to(torch.int8), dim=-1, stable=True)[..., :width]


def detection_stretches(recordings: Recordings, spacing: int, num_detections: int) -> Detections:
    """Detections [R, 1, N] of the episodes, thinned to `spacing` steps from the beginning on and cut into stretches.

    The beginning counts as a detection. Positions are relative to each stretch's first, exact; at most 400 stretches, evenly
    chosen.
    """
    stretches: list[Int64s] = []
    for begin, end in zip(recordings.offset[:-1], recordings.offset[1:], strict=True):
        found = np.unique(np.concatenate([[0], np.flatnonzero(recordings.is_detected[begin:end])]))
        kept = [0]
        for step in found.tolist():
            if step - kept[-1] >= spacing:
                kept.append(step)
        for first in range(0, len(kept), num_detections):
            stretches.append(begin + np.array(kept[first : first + num_detections]))
    chosen = np.unique(np.linspace(0, len(stretches) - 1, min(_MAX_STRETCHES, len(stretches))).round().astype(int))
    rows = np.zeros((len(chosen), num_detections), dtype=np.int64)
    is_observed = np.zeros(rows.shape, dtype=bool)
    for place, index in enumerate(chosen):
        stretch = stretches[index]
        rows[place] = np.pad(stretch, (0, num_detections - len(stretch)), mode="edge")
        is_observed[place, : len(stretch)] = True
    place_m = recordings.position_m[rows].astype(np.float64)
    return Detections(
        torch.from_numpy((rows - rows[:, :1]) * recordings.step_s)[:, None],
        torch.from_numpy(place_m - place_m[:, :1])[:, None],
        torch.eye(2, dtype=torch.float64).expand(len(rows), 1, num_detections, 2, 2),
        torch.from_numpy(is_observed)[:, None],
    )


def waver(recordings: Recordings, spacing: int) -> float:
    """Median distance from the middle of the chord over `spacing` steps to the track there, as a sigma an axis, metres."""
    half = max(1, spacing // 2)
    episode = np.repeat(np.arange(len(recordings)), recordings.length)
    middle = np.arange(half, len(episode) - half)
    middle = middle[episode[middle - half] == episode[middle + half]]
    if not len(middle):
        return 0.0
    place_m = recordings.position_m.astype(np.float64)
    offset_m = place_m[middle] - 0.5 * (place_m[middle - half] + place_m[middle + half])
    # of a round normal law the median distance is 1.177 sigma; the median leaves real turns out
    return float(np.median(np.linalg.norm(offset_m, axis=1)) / 1.1774)
