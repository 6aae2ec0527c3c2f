"""Tracks of agents to the stories of a mission: drawn in pieces that know nothing of one another, and joined."""

import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Float64s, Int64s
from cadence.bank.pool import BankPool
from cadence.bank.smoother import Nodes
from cadence.retrospect.draw import draw_tracks
from cadence.retrospect.filtering import Tracks
from cadence.retrospect.limits import MissionLimits
from cadence.retrospect.timeline import Timeline
from cadence.seeds import derived_seed, derived_seeds
from pipeline.retrospect.sources import Share
from pipeline.retrospect.timing import Timing
from pipeline.threads import in_order
from pipeline.tracks import DetectionTrack

_ROWS_AT_ONCE = 1500
"""Track hypotheses of a piece: enough that their number and not the interpreter takes the time."""
_MOST_WASTE = 1.5
"""How much longer than its tracks a piece may be."""


@dataclass(frozen=True, eq=False)
class MissionDraw:
    """What stories are drawn from.

    datum_m  [2] of the positions inside
    """

    pool: BankPool
    timing: Timing
    timeline: Timeline
    datum_m: Float64s
    limits: MissionLimits
    before_s: float
    after_s: float
    seed: int

    def tracks(
        self, shares: Sequence[Share], num_threads: int, on_share: Callable[[float], object]
    ) -> Iterator[tuple[Share, Float64s, int]]:
        """Each share with its tracks [K', T, 2] in the mission frame, and how many of them the limits asked to mend.

        `on_share` hears of what is done, half a share when it is drawn and half when it is mended, from one thread at a time.
        """
        lock = threading.Lock()

        def heard(share: float) -> None:
            with lock:
                on_share(share)

        pieces = [functools.partial(self._piece, shares, part, heard) for part in _parts(shares, self.timing)]
        for piece in in_order(pieces, num_threads):
            yield from piece

    def _piece(
        self, shares: Sequence[Share], part: Int64s, heard: Callable[[float], object]
    ) -> list[tuple[Share, Float64s, int]]:
        chosen = [shares[index] for index in part.tolist()]
        num = max(len(share.stories) for share in chosen)
        seeds = derived_seeds(self.seed, "track", part)
        tracks = self._tracks([share.track for share in chosen], seeds)
        # what is only implausible is mended: to draw until nothing is would take what is known for certain
        stated = dataclasses.replace(self.limits, plausible_speed_mps=None)
        keeps = stated.keeps if stated.is_limited else None
        drawn = draw_tracks(self.pool, tracks, self.timeline, num, keeps)
        heard(0.5 * len(chosen))
        out = []
        for share, position, seed in zip(chosen, drawn, seeds.tolist(), strict=True):
            position, is_mended = self.limits.mended(
                position[: len(share.stories)], self.timeline.time_s, derived_seed(seed, "limits")
            )
            out.append((share, position.numpy() + self.datum_m, int(is_mended.sum())))
            heard(0.5)
        return out

    def _tracks(self, tracks: Sequence[DetectionTrack], seeds: Int64s) -> Tracks:
        start_ns = int(self.timing.time_ns[0])
        rows = _rows([_kept(track, self.timing) for track in tracks], start_ns, self.datum_m)
        first_s = [(int(track.time_ns[0]) - start_ns) * 1e-9 - self.before_s for track in tracks]
        last_s = [(int(track.time_ns[-1]) - start_ns) * 1e-9 + self.after_s for track in tracks]
        return Tracks(rows, torch.tensor(first_s).double(), torch.tensor(last_s).double(), torch.from_numpy(seeds))


def _parts(shares: Sequence[Share], timing: Timing) -> list[Int64s]:
    """Numbers of the shares in pieces, those together that need as many tracks at about the same time.

    All tracks of a piece are followed from the beginning of its first to the end of its last.
    """
    count = np.array([len(share.stories) for share in shares])
    spans = np.array([[share.track.time_ns[0], share.track.time_ns[-1]] for share in shares])
    first, last = np.searchsorted(timing.time_ns, spans).T
    parts: list[list[int]] = []
    for index in np.lexsort(np.stack([first, -count])).tolist():
        joined = [*parts[-1], index] if parts else [index]
        length = last[joined].max() - first[joined].min() + 1
        is_wide = length > _MOST_WASTE * (last[joined] - first[joined] + 1).mean()
        if parts and count[parts[-1][0]] == count[index] and count[joined].sum() <= _ROWS_AT_ONCE and not is_wide:
            parts[-1] = joined
        else:
            parts.append([index])
    return [np.array(part, dtype=np.int64) for part in parts]


def _kept(track: DetectionTrack, timing: Timing) -> DetectionTrack:
    """Of the detections within one step the first and the last: they hold position and velocity."""
    is_next = np.diff((track.time_ns - timing.time_ns[0]) // timing.step_ns) > 0
    return track[np.append(True, is_next) | np.append(is_next, True)]


def _rows(tracks: Sequence[DetectionTrack], start_ns: int, datum_m: Float64s) -> Nodes:
    """Tracks as rows, padded behind with their last time."""
    num = max(len(track) for track in tracks)
    place = [np.minimum(np.arange(num), len(track) - 1) for track in tracks]
    is_observed = np.stack([np.arange(num) < len(track) for track in tracks])

    def stacked(values: list[Float64s]) -> Tensor:
        return torch.from_numpy(np.stack([value[rows] for value, rows in zip(values, place, strict=True)]))

    return Nodes(
        stacked([np.asarray((track.time_ns - start_ns) * 1e-9) for track in tracks]),
        stacked([track.position_m - datum_m for track in tracks]),
        stacked([track.covariance_m2 for track in tracks]),
        torch.from_numpy(is_observed),
    )
