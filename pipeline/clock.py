"""Times for people: UTC where the log's clock is a calendar's, else time since the start."""

from dataclasses import dataclass
from datetime import UTC, datetime

CALENDAR_FROM_NS = 946_684_800_000_000_000
"""1 January 2000: clocks before it count from when the recorder was switched on."""

STEPS_S = (
    0.1,
    0.2,
    0.5,
    1,
    2,
    5,
    10,
    15,
    30,
    60,
    120,
    300,
    600,
    900,
    1800,
    3600,
    7200,
    10800,
    21600,
    43200,
    86400,
    172800,
    604800,
)


@dataclass(frozen=True)
class Clock:
    """How times of a mission are written."""

    start_ns: int
    end_ns: int

    @property
    def is_calendar(self) -> bool:
        """Whether times are shown as UTC."""
        return self.start_ns >= CALENDAR_FROM_NS

    def moment(self, time_ns: int, decimals: int = 0) -> str:
        """A time within the mission: 12:34:56, or T+00:01:05 without a calendar.

        The date is added where the mission lasts over midnight.
        """
        unit = 10 ** (9 - decimals)
        if self.is_calendar:
            seconds, rest = divmod(time_ns // unit, 10**decimals)
            pattern = "%H:%M:%S" if self._day(self.start_ns) == self._day(self.end_ns) else "%d %b %H:%M:%S"
            text = datetime.fromtimestamp(seconds, UTC).strftime(pattern)
        else:
            ticks = (time_ns - self.start_ns) // unit
            sign, ticks = ("+", ticks) if ticks >= 0 else ("-", -ticks)
            seconds, rest = divmod(ticks, 10**decimals)
            text = f"T{sign}{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}"
        return f"{text}.{rest:0{decimals}}" if decimals else text

    def range(self) -> str:
        """Start and end in full."""
        if not self.is_calendar:
            return f"{self.start_ns / 1e9:.3f} s to {self.end_ns / 1e9:.3f} s on the clock of the log"
        start, end = (datetime.fromtimestamp(time_ns // 10**9, UTC) for time_ns in (self.start_ns, self.end_ns))
        last = f"{end:%H:%M:%S}" if start.date() == end.date() else f"{end:%Y-%m-%d %H:%M:%S}"
        return f"{start:%Y-%m-%d %H:%M:%S} to {last} UTC"

    def ticks(self, start_ns: int, end_ns: int, count: int) -> list[tuple[int, str]]:
        """About `count` round times between start and end, with labels."""
        span_s = (end_ns - start_ns) / 1e9
        step_s = next((step for step in STEPS_S if span_s / step <= count), span_s / count)
        step_ns = round(step_s * 1e9)
        base_ns = 0 if self.is_calendar else self.start_ns
        first = -((base_ns - start_ns) // step_ns)
        times = [base_ns + index * step_ns for index in range(first, first + 2 * count + 2)]
        return [(time_ns, self.moment(time_ns, 1 if step_s < 1 else 0)) for time_ns in times if start_ns <= time_ns <= end_ns]

    @staticmethod
    def _day(time_ns: int) -> int:
        return time_ns // 86_400_000_000_000


def duration(seconds: float) -> str:
    """A length of time for people: 12.3 s, 3 min 18 s, 2 h 05 min, 3 d 04 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.3g} s"
    if whole < 3600:
        return _pair(whole // 60, "min", whole % 60, "s")
    if whole < 86_400:
        return _pair(whole // 3600, "h", whole // 60 % 60, "min")
    return _pair(whole // 86_400, "d", whole // 3600 % 24, "h")


def _pair(large: int, large_unit: str, small: int, small_unit: str) -> str:
    return f"{large} {large_unit}" + (f" {small:02} {small_unit}" if small else "")
