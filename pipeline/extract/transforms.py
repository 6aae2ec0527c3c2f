"""Transforms of a log: where frames were in each other, and so where a sensor's detections were in a fixed frame.

A link is the pose of a frame in its parent over time; the links make trees. Between two samples of a link its position is
interpolated linearly and its rotation along the shortest arc (slerp). Outside, and in longer gaps, the nearest sample holds
for as long as the limits allow; a position behind them is refused, because a wrong place is worse than none.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cadence.arrays import Bools, Float64s, Int64s
from pipeline.frames import EARTH_CENTRED

_EARTH = EARTH_CENTRED | {"utm", "wgs84"}
"""Frames of the whole earth: the mission's frame lies below them."""

_NO_ANGLE = 1e-6
"""Radians below which slerp's formula divides by nearly nothing, and a straight line is as good."""


@dataclass(frozen=True)
class Limits:
    """How far from its samples a transform is believed: before the first and after the last, and between two of them."""

    max_extrapolation_s: float
    max_gap_s: float


@dataclass(frozen=True, eq=False)
class Link:
    """Poses of `child` in `parent` at time_ns [N], ascending; a static one has one sample, which always holds.

    translation_m [N, 3]; rotation [N, 4] unit quaternions x, y, z, w.
    """

    parent: str
    child: str
    time_ns: Int64s
    translation_m: Float64s
    rotation: Float64s
    is_static: bool = False

    def __post_init__(self) -> None:
        num = len(self.time_ns)
        if num == 0 or self.translation_m.shape != (num, 3) or self.rotation.shape != (num, 4):
            raise ValueError(f"{self.parent} → {self.child}: times, translations and rotations do not fit each other")

    def motion(self, time_ns: Int64s, limits: Limits) -> "Motion":
        """The pose at time_ns [M]."""
        if self.is_static:
            repeated = np.zeros(len(time_ns), dtype=np.intp)
            return Motion(
                _matrices(self.rotation[-1:])[repeated], self.translation_m[-1:][repeated], np.ones(len(time_ns), bool)
            )
        last = len(self.time_ns) - 1
        after = np.clip(np.searchsorted(self.time_ns, time_ns, side="right"), 0, last)
        before = np.clip(after - 1, 0, last)
        before = np.where(time_ns >= self.time_ns[last], last, np.where(time_ns < self.time_ns[0], 0, before))
        gap_ns, since_ns = self.time_ns[after] - self.time_ns[before], time_ns - self.time_ns[before]
        distance_ns = np.minimum(np.abs(since_ns), np.abs(self.time_ns[after] - time_ns))
        is_between = (gap_ns > 0) & (gap_ns <= limits.max_gap_s * 1e9)
        nearest = (2 * since_ns > gap_ns).astype(np.float64)
        share = np.where(is_between, since_ns / np.maximum(gap_ns, 1), nearest)
        rotation = slerp(self.rotation[before], self.rotation[after], share)
        translation = self.translation_m[before] + share[:, None] * (self.translation_m[after] - self.translation_m[before])
        return Motion(_matrices(rotation), translation, is_between | (distance_ns <= limits.max_extrapolation_s * 1e9))


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses [M] of one frame in another: p ↦ rotation p + translation_m; those not known are to be refused."""

    rotation: Float64s
    translation_m: Float64s
    is_known: Bools

    def after(self, inner: "Motion") -> "Motion":
        """First `inner`, then this one."""
        translation = np.einsum("nij,nj->ni", self.rotation, inner.translation_m) + self.translation_m
        return Motion(self.rotation @ inner.rotation, translation, self.is_known & inner.is_known)

    def inverse(self) -> "Motion":
        """The way back."""
        back = self.rotation.transpose(0, 2, 1)
        return Motion(back, -np.einsum("nij,nj->ni", back, self.translation_m), self.is_known)


@dataclass(frozen=True)
class TransformTree:
    """The links by child; no cycles. `problems` says in one sentence each what the log's transforms are lacking."""

    links: Mapping[str, Link] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    def ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to its root."""
        found = [frame]
        while found[-1] in self.links:
            found.append(self.links[found[-1]].parent)
        return found

    def world(self, frame: str) -> str:
        """The fixed frame that a frame moves in: its root, or what lies directly below the earth's frame."""
        path = [name for name in self.ancestors(frame) if not is_of_earth(name)]
        return path[-1] if path else frame

    def is_fixed(self, frame: str) -> bool:
        """Whether a frame never moves in its world."""
        path = self.ancestors(frame)
        return all(self.links[name].is_static for name in path[: path.index(self.world(frame))])

    def is_joined(self, frame: str, other: str) -> bool:
        """Whether a chain of links leads from one frame to the other."""
        return self.ancestors(frame)[-1] == self.ancestors(other)[-1]

    def motion(self, frame: str, target: str, time_ns: Int64s, limits: Limits) -> Motion | None:
        """The poses of `frame` in `target` at time_ns [M]; None where no chain of links joins them."""
        up, down = self.ancestors(frame), self.ancestors(target)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        to_common = self._chain(up[: up.index(common)], time_ns, limits)
        return self._chain(down[: down.index(common)], time_ns, limits).inverse().after(to_common)

    def _chain(self, frames: Sequence[str], time_ns: Int64s, limits: Limits) -> Motion:
        """The pose of the first of `frames`, each the parent of the one before, in the last one's parent."""
        num = len(time_ns)
        motion = Motion(np.broadcast_to(np.eye(3), (num, 3, 3)), np.zeros((num, 3)), np.ones(num, dtype=np.bool_))
        for frame in frames:
            motion = self.links[frame].motion(time_ns, limits).after(motion)
        return motion


def is_of_earth(frame: str) -> bool:
    """Whether a frame is one of the whole earth by its name."""
    return frame.lower() in _EARTH


def tree_of(links: Sequence[Link], problems: Sequence[str] = ()) -> TransformTree:
    """The links as trees: of several parents of a frame the one with most samples counts, cycles are taken out."""
    found = list(problems)
    by_child: dict[str, Link] = {}
    for link in sorted(links, key=lambda link: (link.child, -len(link.time_ns), link.parent)):
        if link.child not in by_child:
            by_child[link.child] = link
        elif link.parent != by_child[link.child].parent:
            kept = by_child[link.child].parent
            found.append(f"frame {link.child} has the parents {kept} and {link.parent}; {kept} is used")
    for cycle in _cycles(by_child):
        found.append(f"frames {' → '.join([*cycle, cycle[0]])} form a cycle and are not used")
        for frame in cycle:
            del by_child[frame]
    return TransformTree(by_child, tuple(found))


def slerp(first: Float64s, second: Float64s, share: Float64s) -> Float64s:
    """Unit quaternions [N, 4] at `share` [N] of the shortest arc from `first` to `second` [N, 4]."""
    is_far = np.einsum("ni,ni->n", first, second) < 0
    second = np.where(is_far[:, None], -second, second)
    # Of two chords: the arc cosine of their product would lose half the digits of small angles.
    angle = 2 * np.arctan2(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    is_line = angle < _NO_ANGLE
    sine = np.where(is_line, 1.0, np.sin(angle))
    weight_first = np.where(is_line, 1 - share, np.sin((1 - share) * angle) / sine)
    weight_second = np.where(is_line, share, np.sin(share * angle) / sine)
    found = weight_first[:, None] * first + weight_second[:, None] * second
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def _cycles(links: Mapping[str, Link]) -> list[list[str]]:
    """Every cycle once, from its alphabetically first frame."""
    found: dict[frozenset[str], list[str]] = {}
    for start in sorted(links):
        path = [start]
        while path[-1] in links and links[path[-1]].parent not in path:
            path.append(links[path[-1]].parent)
        if path[-1] in links:
            cycle = path[path.index(links[path[-1]].parent) :]
            found.setdefault(frozenset(cycle), cycle)
    return list(found.values())


def _matrices(rotation: Float64s) -> Float64s:
    """Rotation matrices [N, 3, 3] of unit quaternions [N, 4] (x, y, z, w)."""
    x, y, z, w = rotation.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), -1, 0))
