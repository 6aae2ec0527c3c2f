"""Best-first search over a grid of blocks, with the order of visits of the original Prison Escape planner.

Where coverage is constant thousands of ways cost the same, and which of them is taken is decided by the order of the queue
and by the last bits of the sums. So both are kept: the queue is ordered by (estimate, cost, block, block before), a block is
closed at its first visit, and the estimate counts the price of the block itself twice, which makes the search slightly
greedy: it avoids bright blocks beyond what the shortest way would.

The search is confined to blocks through which a way costs at most `slack` more than the cheapest (the least cost to the goal
is known for all blocks at once). Ways found are at most 65 dearer than the cheapest, so a slack of 500 changes none.
"""

import math
from heapq import heappop, heappush

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from cadence.arrays import Bools, Float64s, Int64s

_MOVES = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)]


class BlockPlanner:
    """Ways over a square grid of prices [n, n]; blocks with prices at or below zero are closed. Answers are kept."""

    def __init__(self, price: Float64s, factor: float, slack: float = 500.0) -> None:
        self.side, self.slack = len(price), slack
        self.is_open: Bools = price.ravel() > 0
        cost = (price * factor).ravel().tolist()
        self._neighbours = [self._around(block, cost) for block in range(self.side**2)]
        self._backwards = self._reversed()
        self._fields: dict[int, tuple[list[float], list[float]]] = {}
        self._known: dict[tuple[int, int], Int64s] = {}

    def plan(self, start: int, goal: int) -> Int64s:
        """The way from `start` to `goal` [W, 2], both included; blocks are numbered x * n + y.

        Raises `ValueError` where there is no way.
        """
        way = self._known.get((start, goal))
        if way is None:
            numbers = np.array(self._search(start, goal))
            way = self._known[start, goal] = np.stack([numbers // self.side, numbers % self.side], axis=-1)
        return way

    def _around(self, block: int, cost: list[float]) -> list[tuple[int, float, float]]:
        """Open neighbours: number, length of the move, price."""
        x, y = divmod(block, self.side)
        found = []
        for dx, dy in _MOVES:
            number = (x + dx) * self.side + y + dy
            if 0 <= x + dx < self.side and 0 <= y + dy < self.side and self.is_open[number]:
                found.append((number, 1.0 if dx == 0 or dy == 0 else math.sqrt(2.0), cost[number]))
        return found

    def _reversed(self) -> csr_matrix:
        """Costs of all moves, from the block entered to the one left."""
        moves = [
            (entered, block, length + price)
            for block in np.flatnonzero(self.is_open).tolist()
            for entered, length, price in self._neighbours[block]
        ]
        entered, left, cost = zip(*moves, strict=True)
        return csr_matrix((cost, (entered, left)), shape=(self.side**2, self.side**2))

    def _fields_of(self, goal: int) -> tuple[list[float], list[float]]:
        """Straight distance of every block to the goal, and the least cost from there."""
        if goal not in self._fields:
            x, y = divmod(goal, self.side)
            along = np.arange(self.side, dtype=np.float64)
            distance = np.sqrt((along[:, None] - x) ** 2 + (along - y) ** 2).ravel()
            self._fields[goal] = distance.tolist(), dijkstra(self._backwards, indices=[goal])[0].tolist()
        return self._fields[goal]

    def _search(self, start: int, goal: int) -> list[int]:
        distance, remaining = self._fields_of(goal)
        neighbours, bound = self._neighbours, remaining[start] + self.slack
        count = self.side**2
        best, before, is_closed = [math.inf] * count, [-1] * count, bytearray(count)
        queue = [(distance[start], 0.0, start)]
        while queue:
            _, cost, block = heappop(queue)
            if is_closed[block]:
                continue
            is_closed[block] = 1
            if block == goal:
                break
            for number, length, price in neighbours[block]:
                if is_closed[number]:
                    continue
                reached = cost + length + price
                # The first visit comes from the cheapest predecessor, of equals the one with the least number: others need
                # not be queued.
                if reached < best[number] and reached + remaining[number] <= bound:
                    best[number], before[number] = reached, block
                    heappush(queue, (reached + distance[number] + price, reached, number))
                elif reached == best[number] and block < before[number]:
                    before[number] = block
        if not is_closed[goal]:
            raise ValueError(f"no way from block {start} to block {goal}")
        way = [goal]
        while way[-1] != start:
            way.append(before[way[-1]])
        return way[::-1]
