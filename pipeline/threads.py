"""Threads: one inside every computation, so that results are the same on all machines; several computations side by side."""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Result = TypeVar("_Result")


def num_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Every computation in one thread: sums that are shared out among threads differ with their number."""
    import torch  # only now: to count cores must not cost it

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_order(pieces: Iterable[Callable[[], _Result]], num_threads: int) -> Iterator[_Result]:
    """The results of pieces in their order, so many computed at once; never more than one result waits for another.

    Threads serve because nearly all time goes into kernels that let others run meanwhile; the results are those of one thread.
    """
    if num_threads <= 1:
        yield from (piece() for piece in pieces)
        return
    import torch

    waiting: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(num_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            for piece in pieces:
                waiting.append(pool.submit(piece))
                if len(waiting) > num_threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
