"""The MCAP boundary: reading what can be trusted, writing what can be checked."""
