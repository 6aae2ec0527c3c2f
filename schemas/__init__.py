"""Declarations only: Arrow tables, MCAP channels, protobuf messages. Imports nothing of this project."""
