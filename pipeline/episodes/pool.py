"""Where presets that learn one place take their windows from: recorded or simulated episodes, in shares."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cadence.arrays import Int64s
from cadence.errors import ConfigError
from cadence.recordings import Recordings
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.progress import Progress


@dataclass(frozen=True)
class EpisodeSource:
    """Episodes to learn from.

    share     of the windows of a batch, relative to the other sources
    episodes  where they come from
    """

    share: float = 1.0
    episodes: RecordingsConfig = field(default_factory=RecordingsConfig)

    def __post_init__(self) -> None:
        if not self.share > 0:
            raise ValueError("share must be positive")


@dataclass(frozen=True, eq=False)
class EpisodePool:
    """The episodes of several sources, and the share of each."""

    parts: tuple[Recordings, ...]
    shares: tuple[float, ...]

    def rows(self, num: int, rng: np.random.Generator) -> Iterator[tuple[Recordings, Int64s]]:
        """`num` random rows, all rows of a source equally likely, the sources by their shares.

        Each source's rows are drawn when they are asked for, so that its user may draw from `rng` in between.
        """
        shares = np.array(self.shares)
        counts = rng.multinomial(num, shares / shares.sum())
        for part, count in zip(self.parts, counts, strict=True):
            if count:
                yield part, rng.integers(0, len(part.position_m), int(count))

    def rows_of_each(self, num: int, rng: np.random.Generator) -> Iterator[tuple[Recordings, Int64s]]:
        """`num` random rows of every source, drawn when they are asked for."""
        for part in self.parts:
            yield part, rng.integers(0, len(part.position_m), num)

    def split(self, share: float) -> tuple["EpisodePool", "EpisodePool"]:
        """Whole episodes apart: the first ones of every source, and the last `share` of them (at least one each).

        `ConfigError` for a source with a single episode.
        """
        if any(part.num_episodes < 2 for part in self.parts):
            raise ConfigError(
                "sources: one of them has a single episode; two are needed, or episodes for validation of their own"
            )
        numbers = [min(max(1, round(share * part.num_episodes)), part.num_episodes - 1) for part in self.parts]
        first = [part.select(slice(0, part.num_episodes - num)) for part, num in zip(self.parts, numbers, strict=True)]
        last = [part.select(slice(part.num_episodes - num, None)) for part, num in zip(self.parts, numbers, strict=True)]
        return EpisodePool(tuple(first), self.shares), EpisodePool(tuple(last), self.shares)


def load_pool(
    sources: Sequence[EpisodeSource], cache: Path, step_s: float, where: str, progress: Progress, together: bool = False
) -> EpisodePool:
    """The episodes of the sources, by way of the folder `cache`; `together` see `load_recordings`.

    `ConfigError` names the key `where` if steps differ.
    """
    parts = tuple(load_recordings(source.episodes, cache, progress, together).recordings for source in sources)
    if any(part.step_s != step_s for part in parts):
        raise ConfigError(f"{where}.step_s is {step_s:g} s; the episodes have another step")
    return EpisodePool(parts, tuple(source.share for source in sources))
