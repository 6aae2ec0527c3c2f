"""Random numbers for the parts of a work, from one seed: a part's are a hash of the seed and of what the part is for.

Sums and products of seeds and numbers meet: with 7919 times the seed plus the step, seed 0 reaches the first step of seed 1.
Hashes do not. The hash is the finaliser of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators",
OOPSLA 2014), applied once a word.
"""

import hashlib

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from cadence.arrays import Int64s

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)


def fold(key: NDArray[np.uint64], number: ArrayLike) -> NDArray[np.uint64]:
    """The key of `number` under `key`, one axis at least: both broadcast. No two numbers share a key."""
    count = np.atleast_1d(np.asarray(number, dtype=np.int64)).astype(np.uint64)
    word = key + (count + np.uint64(1)) * _GOLDEN
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    mixed: NDArray[np.uint64] = word ^ (word >> np.uint64(31))
    return mixed


def derived_seeds(seed: ArrayLike, *path: ArrayLike) -> Int64s:
    """Seeds from 0 to 2 ** 62, one axis at least: `seed` and the numbers of the path broadcast.

    Args:
        seed: one seed, or many.
        path: what the part is for, as a word, and which one it is, as a number or many.
    """
    key = fold(np.zeros(1, dtype=np.uint64), seed)
    for step in path:
        key = fold(key, _number(step) if isinstance(step, str) else step)
    return (key >> np.uint64(2)).astype(np.int64)


def derived_seed(seed: int, *path: int | str) -> int:
    """One seed from 0 to 2 ** 62; see `derived_seeds`."""
    return int(derived_seeds(seed, *path)[0])


def part_seeds(seed: Tensor, kind: str, number: Tensor) -> Tensor:
    """Seeds of the numbered parts of windows, agents say; the first keeps the seed of its window, as what is alone has it."""
    apart = torch.from_numpy(derived_seeds(seed.numpy(), kind, number.numpy()))
    return torch.where(number > 0, apart, seed)


def numpy_stream(seed: int, *path: int | str) -> np.random.Generator:
    """Random numbers of one part of a work."""
    return np.random.default_rng(derived_seed(seed, *path))


def torch_stream(seed: int, *path: int | str) -> torch.Generator:
    """The same for tensors."""
    return torch.Generator().manual_seed(derived_seed(seed, *path))


def _number(word: str) -> int:
    return int.from_bytes(hashlib.blake2b(word.encode(), digest_size=8).digest(), "little", signed=True)
