"""Names as numbers: those that are kept up through every step are those that would be counted anew."""

import numpy as np
from fixtures.detection_rows import rows
from hypothesis import given
from hypothesis import strategies as st

from pipeline.extract.positions import Names, Positions

NAMES = st.lists(st.sampled_from(["a", "b", "c", None]), min_size=1, max_size=30)


def of(names: list[str | None], topic: str = "/seen") -> Positions:
    return rows(*[(i, float(i), 0.0, 0.0, name) for i, name in enumerate(names)], topic=topic)


def agree(found: Positions) -> bool:
    """Whether numbers that are known already are those of a column that is counted now."""
    anew = Names.of(found.agent), Names.of(found.topic)
    both = zip((found.agents, found.topics), anew, strict=True)
    return all(known.names == fresh.names and (known.number == fresh.number).all() for known, fresh in both)


@given(NAMES, NAMES, st.randoms(use_true_random=False))
def test_numbers_are_kept_up(first: list[str | None], second: list[str | None], chance: object) -> None:
    both = Positions.concatenate([of(first), of(second, "/other")])
    rng = np.random.default_rng(chance.randint(0, 2**31))  # type: ignore[attr-defined]
    chosen = both[rng.permutation(len(both))[: rng.integers(0, len(both) + 1)]]
    assert agree(both) and agree(chosen) and agree(both[::2]) and agree(both[rng.random(len(both)) < 0.5])
    assert agree(chosen.changed(first=chosen.second)) and agree(chosen.changed(agent=np.full(len(chosen), "x", object)))


def test_rows_of_each_name() -> None:
    (of_a, of_b) = of(["a", None, "b", "a"]).agents.rows()
    assert of_a.tolist() == [0, 3] and of_b.tolist() == [2]
