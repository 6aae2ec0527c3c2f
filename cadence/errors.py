"""The one exception tree: every foreseen failure names what is wrong, where, and what to do.

`cli.main` catches `CadenceError` once, prints it as one line and leaves with `exit_code`. Anything else is a defect
and keeps its traceback.
"""


class CadenceError(Exception):
    """A foreseen failure; `str(error)` is one line: what, where, what to do."""

    exit_code = 1


class UsageError(CadenceError):
    """The call itself is wrong: an argument that is missing, unknown or contradictory."""

    exit_code = 2


class InputError(CadenceError):
    """An input cannot be used: not an MCAP, empty, no detections, NaN everywhere."""

    exit_code = 3


class NothingDetectedError(InputError):
    """A log can be used, but nothing was detected in it: there is nothing to infer from."""


class ConfigError(CadenceError):
    """A configuration, mapping or checkpoint does not fit: unknown key, wrong type, wrong shape."""

    exit_code = 4


class DeviceError(CadenceError):
    """Compute or storage failed: no such device, out of memory, unwritable output."""

    exit_code = 5


class PartialInputError(CadenceError):
    """A log is damaged: what is sound was read, some of it is lost."""

    exit_code = 7


class ImplausibleInputError(CadenceError):
    """What a log says cannot be meant as it stands: results rest on a suspicion, or are refused because of one."""

    exit_code = 8
