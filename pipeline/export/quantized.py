"""Tracks as whole numbers: cadence.Tracks, a sixth of what their floats take in a compressed file.

Digits far below what anybody knows are noise, and noise does not compress. Each step has a quantum of its own, a power of two;
what is written is by how much a track leaves the straight line through its last two steps, in quanta.
"""

from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Floats, Int64s, UInt64s
from pipeline.logs.wire import field

_SHARE = 0.01
"""Of the hypotheses' spread at a step: rounding adds less than 1e-4 to their variance, thirty of them know it to a quarter."""
_LEAST_M = 2.0**-20


@dataclass(frozen=True, eq=False)
class Quantized:
    """Tracks [K, T, D] on a grid of 2^exponent[t] metres at each step.

    exponent  [T]
    residual  [K', D, T] quanta from the straight continuation of the last two steps; of the hypotheses that are there
    absent    rows of the K that are not: all of their steps are NaN
    """

    exponent: Int64s
    residual: Int64s
    absent: Int64s

    def encode(self) -> bytes:
        """cadence.Tracks without its tag."""
        parts = ((1, _zigzag(self.exponent)), (2, _zigzag(self.residual)), (3, self.absent.astype(np.uint64)))
        return b"".join(field(number, _varints(values)) for number, values in parts if values.size)


def quantize(track_m: Floats, weight: Floats) -> Quantized | None:
    """Tracks [K, T, D], each coordinate rounded by at most a hundredth of their spread at its step, or a micrometre.

    `weight` [K] counts in the spread. None where a track has gaps, which whole numbers cannot say.
    """
    is_there = np.isfinite(track_m).all(axis=(1, 2))
    if not np.isnan(track_m[~is_there]).all():
        return None
    kept_m = track_m[is_there].astype(np.float64)
    exponent = _exponents(kept_m, weight[is_there].astype(np.float64))
    quantum_m = np.ldexp(1.0, exponent)[:, None]
    count = np.floor(kept_m / quantum_m + 0.5)
    placed_m = count * quantum_m
    ahead_m = np.zeros_like(placed_m)
    ahead_m[:, 1:2] = placed_m[:, :1]
    ahead_m[:, 2:] = 2.0 * placed_m[:, 1:-1] - placed_m[:, :-2]
    residual = (count - np.floor(ahead_m / quantum_m + 0.5)).astype(np.int64)
    return Quantized(exponent, residual.transpose(0, 2, 1), np.flatnonzero(~is_there))


def _exponents(track_m: Float64s, weight: Float64s) -> Int64s:
    """Of the quantum at each step [T]."""
    share = (weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1.0 / max(len(weight), 1)))[:, None, None]
    away_m = track_m - (share * track_m).sum(axis=0)
    spread_m = np.sqrt((share * away_m**2).sum(axis=(0, 2)))
    return np.asarray(np.floor(np.log2(np.maximum(2.0 * _SHARE * spread_m, _LEAST_M))), dtype=np.int64)


def _zigzag(value: Int64s) -> UInt64s:
    """Small numbers of either sign as small numbers without one (protobuf's sint64)."""
    return ((value << 1) ^ (value >> 63)).astype(np.uint64)


def _varints(value: UInt64s) -> bytes:
    """Packed numbers: groups of seven bits, lowest first, each but the last of a number marked."""
    flat = value.reshape(-1)
    most = max(1, -(-int(flat.max()).bit_length() // 7))
    group = (flat[:, None] >> (7 * np.arange(most, dtype=np.uint64))) & np.uint64(0x7F)
    last = np.maximum(most - 1 - np.argmax(group[:, ::-1] > 0, axis=1), 0)
    last[flat == 0] = 0
    place = np.arange(most)
    marked = group.astype(np.uint8) | np.where(place < last[:, None], np.uint8(0x80), np.uint8(0))
    data: bytes = marked[place <= last[:, None]].tobytes()
    return data
