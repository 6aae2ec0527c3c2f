"""Numbers with their nouns: one agent, two agents."""


def counted(number: int, one: str, many: str = "") -> str:
    """`1 agent`, `2 agents`: the number and what follows it; `many` where that is not `one` with an s."""
    return f"{number} {one if number == 1 else many or one + 's'}"
