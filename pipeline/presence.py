"""An agent by its name and by how likely it is there at all, where that is not known: for every text that names it."""


def with_presence(name: str, probability: float | None) -> str:
    """`a0 (there: 32 %)`; the name alone where the log says who was seen (None)."""
    if probability is None:
        return name
    return f"{name} (there: {'> 99' if probability > 0.99 else round(100 * probability)} %)"
