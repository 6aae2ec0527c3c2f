"""The names of the files that tell where sensors looked; asked for where nothing heavy may be imported."""

LOOKS_NAME, SENSORS_NAME = "looks.parquet", "sensors.json"
LOOK_FILES = (LOOKS_NAME, SENSORS_NAME)
