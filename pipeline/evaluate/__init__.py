"""Stage evaluate: hypotheses of missions against their truth, beside rivals."""
