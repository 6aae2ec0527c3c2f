"""The name of the file of measurements; asked for where nothing heavy may be imported."""

MEASUREMENTS_NAME = "measurements.parquet"
