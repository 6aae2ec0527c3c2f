"""Stage export: results of a mission as MCAP channels that open in Foxglove, and back."""
