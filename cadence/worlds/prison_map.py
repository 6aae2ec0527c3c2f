"""The map of the Prison Escape world: forest coverage, the mountain, hideouts and cameras. Units are cells of 21 m.

Facts (constants, positions, the recipe of the coverage) are those of the original simulator, CORE-Robotics-Lab's
Opponent-Modeling (MIT licence), configuration `balance_game`. Indices of all arrays are [x, y].
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from cadence.worlds.perlin import enlarge_twice, fractal

CELL_M = 21.0
SIDE = 2428
"""Cells along a side of the map."""

MOUNTAIN = (1600.0, 1800.0)
"""Centre of the mountain."""
KEEP_OUT = 140.0
"""Movers that come nearer to the centre of the mountain turn straight away from it."""


def _cells(text: str) -> Int64s:
    """Cells [N, 2] from numbers in a text."""
    return np.array(text.split(), dtype=np.int64).reshape(-1, 2)


KNOWN_SITES = _cells("323 1623  1804 737  317 2028  819 1615  1145 182  1304 624  234 171  2398 434  633 2136  1590 2")
"""Places of hideouts that the trackers know; an episode has one of them."""
UNKNOWN_SITES = _cells("376 1190  909 510  397 798  2059 541  2011 103  901 883  1077 1445  602 372  80 2274  279 477")
"""Places of hideouts that the trackers do not know; an episode has two of them."""

_FOREST_CAMERAS = _cells(
    """
    1000 800  1400 400  1750 1800  1580 1200  2200 2200  1900 1632  1800 1525  1700 1300
    1600 1415  1500 1202  1432 200  1535 900  1742 851  1805 765  1922 696  2200 2200
    """
)
_FENCE = np.append(np.arange(2398, 2037, -30), 2028)
SEEN_CAMERAS = np.concatenate(
    [
        _FOREST_CAMERAS,
        np.stack([np.full_like(_FENCE, 2028), _FENCE], axis=-1),
        np.stack([_FENCE[:-1], np.full_like(_FENCE[:-1], 2028)], axis=-1),
    ]
)
"""Cameras that the fugitive knows; an episode has two more of them, at the start and at the known hideout."""
HIDDEN_CAMERAS = _cells(
    """
    2000 2400  1800 200  1000 1600  110 1200  1400 2000  1876 1903  207 949  667 2380  311 768  323 1334  77 1440
    1718 892  1596 628  659 1805  1228 101  1111 1319  1894 926  1778 2118  790 802  1261 598  2183 2324  750 149
    588 663  1601 55  1499 1722  1491 2294  39 804  2400 1000  2300 1250  2366 2148  2125 1330  1028 2063  2340 300
    """
)
"""Cameras that the fugitive does not know."""

_DARK, _DARK_BELOW, _DENSE_BELOW = 0.2, 0.45, 0.4
_POOL = 20
"""Cells along a side of the blocks that routes are planned on."""


@dataclass(frozen=True, eq=False)
class PrisonMap:
    """Ground of the world.

    coverage     [2428, 2428] factor on the ranges of sensors that stand there, 0.2 (dense forest) ... 0.8
    is_mountain  [2428, 2428] cells that nobody enters
    is_dense     [2428, 2428] at least half of the 6 x 6 cells around are dense forest: where the fugitive hides
    planning     [114, 114] least coverage of blocks of 20 x 20 cells, -1 where there is mountain
    """

    coverage: Float64s
    is_mountain: Bools
    is_dense: Bools
    planning: Float64s


@cache
def prison_map() -> PrisonMap:
    """The map, made once a process (one second)."""
    coverage = _coverage()
    is_mountain = np.zeros(coverage.shape, dtype=bool)
    is_mountain[1552:1649, 1703:1898] = True
    is_mountain[1504:1698, 1751:1849] = True
    return PrisonMap(coverage, is_mountain, _dense_patches(coverage), _planning_grid(np.where(is_mountain, -1.0, coverage)))


def _coverage() -> Float64s:
    """The landscape number 80 of the original, darkened. In float64 as there: routes depend on the last bits."""
    half = SIDE // 2
    place = (np.arange(half) / 250.0).astype(np.float32)
    noise = fractal(place, place, octaves=8, persistence=2.0, lacunarity=0.99, period=float(half), base=80).astype(np.float64)
    share = (noise - noise.min()) / (noise.max() - noise.min())
    coverage = enlarge_twice(share * (0.8 - 0.2) + 0.2)
    coverage[coverage < _DARK_BELOW] = _DARK
    return coverage


def _dense_patches(coverage: Float64s) -> Bools:
    """Cells with more than 17 dense cells among the 36 from three before to two behind; none near the edges at 0."""
    dense = np.zeros((SIDE + 3, SIDE + 3), dtype=np.int64)
    dense[1 : SIDE + 1, 1 : SIDE + 1] = coverage < _DENSE_BELOW
    total = dense.cumsum(axis=0).cumsum(axis=1)
    count = np.zeros((SIDE, SIDE), dtype=np.int64)
    low, high = np.arange(SIDE - 3), np.minimum(np.arange(3, SIDE) + 3, SIDE)
    count[3:, 3:] = total[np.ix_(high, high)] - total[np.ix_(low, high)] - total[np.ix_(high, low)] + total[np.ix_(low, low)]
    return count > 17


def _planning_grid(ground: Float64s) -> Float64s:
    """Least value of each block; like the original it drops eight blocks at the far edges instead of eight cells.

    The planner stretches these 114 blocks over the whole map, so that its mountain lies beside the real one.
    """
    whole = -(-SIDE // _POOL) * _POOL
    padded = np.zeros((whole, whole))
    padded[:SIDE, :SIDE] = ground
    blocks = padded.reshape(whole // _POOL, _POOL, whole // _POOL, _POOL).min(axis=(1, 3))
    rest = SIDE % _POOL
    grid: Float64s = blocks[:-rest, :-rest]
    return grid
