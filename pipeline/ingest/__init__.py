"""Stage ingest: log to catalogue."""
