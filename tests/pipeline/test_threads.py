"""Several computations side by side: in their order, in bounded number, failures and all."""

import threading
import time

import pytest
import torch

from pipeline.threads import in_order, num_cores, one_thread


@pytest.mark.parametrize("num_threads", [1, 2, 5])
def test_results_come_in_order(num_threads: int) -> None:
    def piece(number: int) -> int:
        time.sleep(0.002 * (3 - number % 4))
        return number

    assert list(in_order((lambda n=n: piece(n) for n in range(20)), num_threads)) == list(range(20))


def test_several_work_at_once_and_few_wait() -> None:
    """Three pieces meet at a barrier, which one thread could not; what nobody asked for yet is not begun."""
    barrier, begun = threading.Barrier(3, timeout=30.0), []

    def pieces():
        for number in range(30):
            begun.append(number)
            yield (lambda: barrier.wait()) if number < 3 else (lambda: 0)

    results = in_order(pieces(), 3)
    next(results)
    assert len(begun) <= 5
    assert len(list(results)) == 29


@pytest.mark.parametrize("num_threads", [1, 3])
def test_a_failure_is_raised_where_its_turn_is(num_threads: int) -> None:
    def fail() -> int:
        raise ValueError("piece 2")

    results = in_order([lambda: 0, lambda: 1, fail, lambda: 3], num_threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="piece 2"):
        next(results)


def test_inside_a_piece_there_is_one_thread_and_afterwards_as_many_as_before() -> None:
    before = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == 1
        assert set(in_order([torch.get_num_threads] * 4, 2)) == {1}
    assert torch.get_num_threads() == before and num_cores() >= 1
