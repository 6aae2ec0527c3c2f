"""Suspicions: what a log says and can hardly mean, and what was made of it.

Damage is a matter of bytes, plausibility one of sense: numbers of the log are compared with each other. Whoever finds that
they do not fit says what was seen, what was done instead, and by which setting the user decides otherwise. That setting, once
given, silences the suspicion.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

LogKind = Literal["identity", "time", "place", "covariance", "duplication", "stage"]
"""identity: who was seen; time: when; place: where, in which frame and unit; covariance: how accurately; duplication: the same
thing counted twice; stage: what a channel holds (detections, or a step of work on them)."""

Kind = LogKind | Literal["checkpoint"]
"""checkpoint: what hypotheses were to be drawn with (`pipeline.estimators.fit_test`)."""

_MAX_SHOWN: Final = 10
_MAX_LISTED: Final = 3


@dataclass(frozen=True)
class Suspicion:
    """One thing that cannot be meant as it stands.

    subject   the topic, agent or frame that it is about
    seen      what does not fit, with the numbers that were compared
    done      what was made of it
    setting   what to write to have it otherwise
    """

    kind: Kind
    subject: str
    seen: str
    done: str
    setting: str

    def __str__(self) -> str:
        return f"{self.kind} of {self.subject}: {self.seen}; {self.done}; to decide otherwise: {self.setting}"


class Suspicions:
    """The suspicions of one log as they are found. Kinds that the user trusts are not looked for."""

    def __init__(self, trusted: Iterable[LogKind] = ()) -> None:
        self._trusted = frozenset(trusted)
        self._found: dict[Suspicion, None] = {}

    def __len__(self) -> int:
        return len(self._found)

    def looks_for(self, kind: Kind) -> bool:
        """Whether checks of this kind are wanted."""
        return kind not in self._trusted

    def add(self, kind: Kind, subject: str, *, seen: str, done: str, setting: str) -> None:
        """Remember one; the same one twice is one."""
        self._found[Suspicion(kind, subject, seen, done, setting)] = None

    def lines(self) -> list[str]:
        """A sentence each, in the order in which they were found."""
        return [str(suspicion) for suspicion in self._found]

    def records(self) -> list[dict[str, str]]:
        """The suspicions for a stage's summary (`suspicions`)."""
        return [asdict(suspicion) for suspicion in self._found]


def few(sentences: Sequence[str]) -> list[str]:
    """The sentences for people: where a fault is in each of many channels, the first ones and how many more there are."""
    rest = [f"{len(sentences) - _MAX_SHOWN} more are in extract.manifest.json"] if len(sentences) > _MAX_SHOWN else []
    return [*sentences[:_MAX_SHOWN], *rest]


def listed(names: Collection[str]) -> str:
    """Names in quotation marks, the first ones of many."""
    shown = ", ".join(f'"{name}"' for name in list(names)[:_MAX_LISTED])
    return shown + (f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else "")


def suspicions_in(summary: Mapping[str, Any]) -> list[str]:
    """The sentences of the suspicions that a stage's summary holds; none for stages that look for none."""
    return [str(Suspicion(**record)) for record in summary.get("suspicions", ())]
