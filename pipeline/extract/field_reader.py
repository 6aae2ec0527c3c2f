"""One field of a message that has it at one of several paths: a type's versions, and its flattened forms."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pipeline.mapping.message_path import MissingFieldError, Place, parse_path


class FieldReader:
    """Alternative message paths of one field; tries first the one that served the last message.

    `convert` turns a value into what is kept, None where it is not filled in; then the next alternative is tried.
    """

    def __init__(self, texts: Iterable[str], is_needed: bool = False, convert: Callable[[Any], Any] | None = None) -> None:
        self.paths = [parse_path(text) for text in texts]
        self.is_needed = is_needed
        self.is_found = False
        self.num_lost = 0  # texts that say something which `convert` does not understand
        self._problem: tuple[str, MissingFieldError] | None = None
        self._convert = convert
        self._order = list(range(len(self.paths)))

    @property
    def problem(self) -> str:
        """What the last path that led nowhere was lacking."""
        return "path {!r}: {}".format(*self._problem) if self._problem is not None else "it"

    def located(self, message: Any) -> Mapping[Place, Any] | None:
        """The values by place; None where no alternative leads anywhere."""
        unfilled: Mapping[Place, Any] | None = None
        for rank, number in enumerate(self._order):
            try:
                values = self.paths[number].located(message)
            except MissingFieldError as error:
                self._problem = self.paths[number].text, error
                continue
            self.is_found = True
            if self._convert is not None:
                stated, values = values, {place: self._convert(value) for place, value in values.items()}
                if None in values.values():
                    self.num_lost += sum(
                        values[place] is None and isinstance(text, str) and text.strip() != "" for place, text in stated.items()
                    )
                if values and all(value is None for value in values.values()):
                    unfilled = unfilled or values
                    continue
            if rank:
                self._order.insert(0, self._order.pop(rank))
            return values
        return unfilled
