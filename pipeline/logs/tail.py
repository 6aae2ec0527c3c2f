"""What stands behind an end mark of the data: mostly the summary, but where a file is damaged also more data."""

from dataclasses import dataclass, field

from mcap.opcode import Opcode

from pipeline.logs.summary import Summary


@dataclass(frozen=True)
class EndMark:
    """A DataEnd record.

    end           the byte behind it
    stated        the checksum over all data that it states, 0 where it states none
    found         the checksum over all data, where it was followed
    is_confirmed  whether the end of the file says, too, that the data end there
    """

    end: int
    stated: int
    found: int | None
    is_confirmed: bool


@dataclass
class Tail:
    """The records since the last end mark of the data, or since the first record that belongs into a summary.

    begin        byte at which it begins; -1 while the walk is among data
    mark         the end mark at its beginning; None where that is missing
    num_losses   losses before it
    definitions  opcode and body of the channels and schemas in it
    testimony    its records as a summary which no checksum confirms
    closing      the byte behind the magic that ends the recording; -1 where there is none so far
    """

    begin: int = -1
    mark: EndMark | None = None
    num_losses: int = 0
    definitions: list[tuple[int, bytes]] = field(default_factory=list)
    testimony: Summary = field(default_factory=lambda: Summary(0))
    closing: int = -1

    @property
    def is_open(self) -> bool:
        """Whether the walk is behind the data, as far as it knows."""
        return self.begin >= 0

    @property
    def is_confirmed(self) -> bool:
        """Whether the data are sure to have ended."""
        return self.mark is not None and self.mark.is_confirmed

    def take(self, opcode: int, body: bytes) -> None:
        """Take a record; `DamagedRecord` where it cannot be one of a summary."""
        self.testimony.add(opcode, body, 0)
        if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            self.definitions.append((opcode, body))
