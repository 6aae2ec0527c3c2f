"""Random numbers by counting: each is a function of its address, so that episodes drawn together do not touch one another.

The generator is the hash of `cadence.seeds`, applied once a coordinate of the address.
"""

import numpy as np
from numpy.typing import ArrayLike

from cadence.arrays import Float64s, Int64s
from cadence.seeds import fold


class Draws:
    """Uniform numbers of a batch of episodes [B], addressed by (seed, episode, stream, step, index).

    The same address gives the same number whatever else is in the batch. Streams keep purposes apart: give each its own.
    """

    def __init__(self, seed: int, episodes: ArrayLike) -> None:
        if seed < 0:
            raise ValueError(f"seed is {seed}; it must not be negative")
        self._keys = fold(fold(np.zeros(1, dtype=np.uint64), seed), episodes)

    def __len__(self) -> int:
        return len(self._keys)

    def uniform(self, rows: Int64s, stream: int, step: int, index: ArrayLike = 0) -> Float64s:
        """Numbers in [0, 1) for the batch's `rows` [N]; `index` is a number or one a row."""
        word = fold(fold(fold(self._keys[rows], stream), step), index)
        share: Float64s = (word >> np.uint64(11)).astype(np.float64) * 2.0**-53
        return share

    def point(self, rows: Int64s, stream: int, step: int, index: ArrayLike = 0) -> Float64s:
        """Points [N, 2] of the unit square."""
        index = np.asarray(index, dtype=np.int64) * 2
        x, y = self.uniform(rows, stream, step, index), self.uniform(rows, stream, step, index + 1)
        return np.stack([x, y], axis=-1)
