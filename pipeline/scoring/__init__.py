"""Hypotheses against the truth of their log, cell by cell: the numbers that `evaluate` tabulates and the report tells."""
