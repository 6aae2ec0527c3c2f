import numpy as np
import pytest
import torch

from cadence.seeds import derived_seed, derived_seeds, fold, numpy_stream, part_seeds, torch_stream


def test_seeds_and_numbers_do_not_meet() -> None:
    found = derived_seeds(np.arange(40)[:, None], "step", np.arange(20_000))
    assert found.shape == (40, 20_000) and 0 <= found.min() and found.max() < 2**62
    assert len(np.unique(found)) == found.size
    # generators of torch take the lower half of a seed: by chance some 75 pairs in 800 000 share it
    assert found.size - len(np.unique(found & 0xFFFFFFFF)) < 150


def test_what_a_part_is_for_tells_it_from_others() -> None:
    paths = [(), (0,), (0, 0), (1, 0), (0, 1), ("a",), ("b",), ("a", 0), ("a", "b"), ("b", "a"), ("ab",)]
    assert len({derived_seed(3, *path) for path in paths} | {derived_seed(4, *path) for path in paths}) == 2 * len(paths)


def test_many_at_once_are_those_of_each() -> None:
    seeds, numbers = np.array([5, 2**61]), np.array([[0], [7], [2**40]])
    found = derived_seeds(seeds, "agent", numbers)
    assert found.tolist() == [[derived_seed(int(s), "agent", int(n)) for s in seeds] for n in numbers[:, 0]]


def test_the_first_part_keeps_the_seed_of_its_window() -> None:
    seeds, number = torch.tensor([5, 5, 5, 9]), torch.tensor([0, 1, 2, 1])
    found = part_seeds(seeds, "agent", number)
    assert found.tolist() == [5, *(derived_seed(s, "agent", n) for s, n in ((5, 1), (5, 2), (9, 1)))]


def test_streams_are_the_same_each_time() -> None:
    first, again, other = (numpy_stream(1, "windows", number).random() for number in (2, 2, 3))
    assert first == again != other
    draws = [torch.rand(4, generator=torch_stream(1, "step", step)) for step in (2, 2, 3)]
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


def test_splitmix64_by_its_published_numbers() -> None:
    """The first numbers of the generator with state 0 and with state 1234567, as other implementations give them."""
    assert fold(np.zeros(1, np.uint64), 0).tolist() == [0xE220A8397B1DCDAF]
    assert fold(np.array([1234567], np.uint64), np.arange(3)).tolist() == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
    ]


@pytest.mark.parametrize("number", [-1, 0, 2**62])
def test_numbers_may_be_any(number: int) -> None:
    assert 0 <= derived_seed(number, number) < 2**62
