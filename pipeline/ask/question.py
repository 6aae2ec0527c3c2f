"""A question as a person states it, on the command line, in a file or from Python."""

from dataclasses import dataclass
from typing import Literal

from cadence.errors import UsageError

Kind = Literal["where", "inside", "arrive", "passed", "meet", "same", "searched"]
NEEDS: dict[Kind, tuple[str, ...]] = {
    "where": ("at",),
    "inside": ("area",),
    "arrive": ("area",),
    "passed": ("line",),
    "meet": ("within_m",),
    "same": ("agent", "other"),
    "searched": (),
}
"""What each kind of question cannot do without."""
_TAKES: dict[str, tuple[Kind, ...]] = {
    "at": ("where",),
    "area": ("inside", "arrive"),
    "line": ("passed",),
    "other": ("meet", "same"),
    "within_m": ("meet", "same"),
    "for_s": ("meet",),
    "dwell_s": ("inside",),
}


@dataclass(frozen=True)
class Question:
    """One question to the stories of a mission.

    ask       where, inside, arrive, passed, meet, same or searched
    name      what the answer is called in report and events; by default its words
    agent     whom it is about; by default each agent (of meet: each pair)
    other     the second agent of meet and same; of same each may be #N, row N of detections.parquet
    area      of inside and arrive: a GeoJSON file or text, `latitude,longitude,metres` (`x,y,metres` where the log is not
              georeferenced), or the name of an obstacle
    line      of passed: the same with lines, or `latitude,longitude latitude,longitude ...`
    at        of where: the moment, ISO 8601, a time of day, or seconds after the log begins
    start, end  of the others: from when to when; by default the whole mission
    dwell_s   of inside: for so long without a break
    within_m, for_s  of meet: within which distance, and for how long; of same: how far apart two can be and still be one
    as_of     answer from what was known at that moment: the last window before it; by default from all that was detected
    """

    ask: Kind
    name: str | None = None
    agent: str | None = None
    other: str | None = None
    area: str | None = None
    line: str | None = None
    at: float | str | None = None
    start: float | str | None = None
    end: float | str | None = None
    dwell_s: float = 0.0
    within_m: float | None = None
    for_s: float = 0.0
    as_of: float | str | None = None

    def __post_init__(self) -> None:
        for field in NEEDS[self.ask]:
            if getattr(self, field) is None:
                raise ValueError(f"a question `{self.ask}` needs {field}")
        for field, kinds in _TAKES.items():
            if getattr(self, field) not in (None, 0.0) and self.ask not in kinds:
                raise ValueError(f"{field} is for `{'` and `'.join(kinds)}`, not for `{self.ask}`")
        if self.ask == "where" and (self.start is not None or self.end is not None):
            raise ValueError("`where` is about a moment, at, and takes neither start nor end")
        if self.within_m is not None and not self.within_m > 0:
            raise ValueError(f"within_m must be above zero, got {self.within_m:g}")
        if not (self.dwell_s >= 0 and self.for_s >= 0):
            raise ValueError("dwell_s and for_s must not be negative")
        if self.other is not None and (self.agent is None or self.agent == self.other):
            raise ValueError(f"`{self.ask}` is about two different agents")

    @staticmethod
    def asked(**stated: object) -> "Question":
        """A question of the command line or from Python; `UsageError` where it has no meaning."""
        try:
            return Question(**stated)  # type: ignore[arg-type]  # as the caller's signature has them
        except ValueError as error:
            raise UsageError(f"{error}; see cadence ask --help") from error
