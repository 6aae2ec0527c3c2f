"""Conditions of a source on the messages of a channel: which of their positions are to be used."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from cadence.arrays import Bools
from pipeline.arrays import Column
from pipeline.extract.columns import CONDITION, mapped
from pipeline.mapping.conditions import Condition, parse_conditions
from pipeline.mapping.message_path import MessagePath, MissingFieldError, Place, at_place


class Conditions:
    """All of `texts` must hold. Those of a known type count where a message has them; what a user states must hold."""

    def __init__(self, texts: Sequence[str], is_stated: bool) -> None:
        self.terms = tuple(term for text in texts for term in parse_conditions(text))
        self.is_stated = is_stated
        self._unmet: dict[Condition, str] = {}  # terms whose field no message has had so far, and what was lacking
        self._is_found: set[Condition] = set()

    @property
    def missing(self) -> str | None:
        """What the first term that no message has is lacking."""
        return next((self._unmet.get(term, f"path {term.text!r}") for term in self.terms if term not in self._is_found), None)

    @property
    def paths(self) -> dict[str, list[MessagePath]]:
        """The fields that `hold_in` needs, by the names of their columns."""
        return {f"{CONDITION}{number}": [term.path] for number, term in enumerate(self.terms)}

    @property
    def name_constants(self) -> bool:
        """Whether a term compares with text, which may be the name of a constant: columns do not know those."""
        return any(isinstance(term.test.value, str) for term in self.terms)

    def located(self, message: Any) -> list[Mapping[Place, bool | None]]:
        """What the terms say of a message, by place."""
        found = [term.located(message) for term in self.terms]
        for term, verdicts in zip(self.terms, found, strict=True):
            if any(verdict is not None for verdict in verdicts.values()):
                self._is_found.add(term)
            elif self.is_stated and term not in self._is_found:
                self._unmet[term] = _lacking(term.path, message)
        return found

    def hold_at(self, located: Sequence[Mapping[Place, bool | None]], place: Place) -> bool:
        """Whether the item at `place` is to be used, by what `located` found."""
        verdicts = [at_place(verdicts, place) for verdicts in located]
        return all(verdict or (verdict is None and not self.is_stated) for verdict in verdicts)

    def hold_in(self, columns: Mapping[str, Column], num_messages: int) -> Bools:
        """Which of N messages are to be used, by the columns of the fields that they have."""
        found = np.ones(num_messages, np.bool_)
        for (name, _), term in zip(self.paths.items(), self.terms, strict=True):
            if name in columns:
                self._is_found.add(term)
                found &= mapped(columns[name].tolist(), partial(_holds, term))
        return found


def _holds(term: Condition, value: Any) -> bool:
    return term.test.compares(value, term.test.value)


def _lacking(path: MessagePath, message: Any) -> str:
    try:
        path.located(message)
    except MissingFieldError as error:
        return f"path {path.text!r}: {error}"
    return f"path {path.text!r}"
