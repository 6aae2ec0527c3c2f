"""An agent by its name and by how likely it is there at all, where that is not known: for every text that names it."""


def with_presence(name: str, probability: float | None) -> str:
    """`a0 (there: 32 %)`; the name alone where the log says who was seen (None)."""
    return name if probability is None else f"{name} (there: {presence_words(probability)})"


def presence_words(probability: float | None) -> str:
    """`32 %`; nothing where the log says who was seen (None)."""
    if probability is None:
        return ""
    return "> 99 %" if probability > 0.99 else f"{round(100 * probability)} %"
