"""Random numbers by counting: each is a function of its address, so that episodes drawn together do not touch one another.

The generator is the finaliser of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
OOPSLA 2014), applied once a coordinate of the address.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cadence.arrays import Float64s, Int64s

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)


def _fold(key: NDArray[np.uint64], counter: ArrayLike) -> NDArray[np.uint64]:
    """The key of `counter` under `key`: both broadcast."""
    count = np.atleast_1d(np.asarray(counter, dtype=np.int64)).astype(np.uint64)
    word = key + (count + np.uint64(1)) * _GOLDEN
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    mixed: NDArray[np.uint64] = word ^ (word >> np.uint64(31))
    return mixed


class Draws:
    """Uniform numbers of a batch of episodes [B], addressed by (seed, episode, stream, step, index).

    The same address gives the same number whatever else is in the batch. Streams keep purposes apart: give each its own.
    """

    def __init__(self, seed: int, episodes: ArrayLike) -> None:
        if seed < 0:
            raise ValueError(f"seed is {seed}; it must not be negative")
        self._keys = _fold(_fold(np.zeros(1, dtype=np.uint64), seed), episodes)

    def __len__(self) -> int:
        return len(self._keys)

    def uniform(self, rows: Int64s, stream: int, step: int, index: ArrayLike = 0) -> Float64s:
        """Numbers in [0, 1) for the batch's `rows` [N]; `index` is a number or one a row."""
        word = _fold(_fold(_fold(self._keys[rows], stream), step), index)
        share: Float64s = (word >> np.uint64(11)).astype(np.float64) * 2.0**-53
        return share

    def point(self, rows: Int64s, stream: int, step: int, index: ArrayLike = 0) -> Float64s:
        """Points [N, 2] of the unit square."""
        index = np.asarray(index, dtype=np.int64) * 2
        x, y = self.uniform(rows, stream, step, index), self.uniform(rows, stream, step, index + 1)
        return np.stack([x, y], axis=-1)
