"""Numbers with their nouns: one agent, two agents."""

from typing import Final

_SINGULAR: Final = {"are": "is", "have": "has", "do": "does", "lie": "lies", "fit": "fits", "lack": "lacks", "were": "was"}


def counted(number: int, one: str, many: str = "") -> str:
    """`1 agent`, `2 agents`: the number and what follows it; `many` where that is not `one` with an s."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def told(number: int, many: str) -> str:
    """A number and what is told of so many, in the plural: `positions are NaN and were skipped`; of one, `1 position is`."""
    if number != 1:
        return f"{number} {many}"
    noun, verb, rest = many.split(" ", 2)
    return f"1 {noun.removesuffix('s')} {_SINGULAR.get(verb, verb)} {rest.replace('and were', 'and was')}"
