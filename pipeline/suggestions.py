"""What may have been meant by a word that is not known."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` with the known word that is most like `word`; empty where none is like it."""
    by_letters = {name.lower(): name for name in known}
    found = difflib.get_close_matches(word.lower(), by_letters, n=1)
    return f" (did you mean {by_letters[found[0]]!r}?)" if found else ""


def by_likeness(word: str, known: Iterable[str]) -> list[str]:
    """The known words, those most like `word` first; those that are equally alike keep their order."""
    return sorted(known, key=lambda name: -difflib.SequenceMatcher(None, word.lower(), name.lower()).ratio())
