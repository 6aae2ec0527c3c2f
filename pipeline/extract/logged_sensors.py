"""What a log itself says of its sensors' footprints: the Metadata record `cadence.sensors`, as our simulator writes it.

Its key `sensors` holds a JSON list of the entries of `[[extract.sensors]]`.
"""

from cadence.errors import ConfigError, InputError
from pipeline.config import read_config
from pipeline.documents import parse_json
from pipeline.extract.sensor_config import SensorConfig
from pipeline.logs.reader import MissionLog

RECORD, KEY = "cadence.sensors", "sensors"


def logged_sensors(log: MissionLog) -> tuple[SensorConfig, ...]:
    """The entries; none where the log has no such record. `InputError` where it is there and cannot be meant."""
    found = [record[KEY] for name, record in log.metadata() if name == RECORD and KEY in record]
    if not found:
        return ()
    try:
        entries = parse_json(found[-1])
        return tuple(read_config(SensorConfig, entry, f"sensors[{index}]") for index, entry in enumerate(entries))
    except (ConfigError, ValueError, TypeError, AttributeError) as error:
        raise InputError(
            f"Metadata record {RECORD}: not a list of sensors ({error}); [[extract.sensors]] or extract.suggest = false decides"
        ) from error
