"""Table I with the published architecture as a row, on fewer windows: it takes some 20 times as long to sample as CADENCE.

Options are those of `table1`.

    python -m benchmarks.table1_paper --reference ../shared/data/prison_reference --windows 100 --publish docs
"""

import sys

from benchmarks import table1
from benchmarks.publishing import Measurement
from benchmarks.table1_page import budget_words, lead_table
from cadence.errors import CadenceError

SHOWN = ("the paper's preset, energy score", "the paper's preset, 30 samples")
"""Rows of the page."""


def section(measured: Measurement) -> str:
    """Leads over the published architecture, and what both trainings cost."""
    budgets = budget_words(measured, ("prison low",), ("cadence", "paper"))
    return f"{lead_table(measured, SHOWN)}\n\n{measured.facts['num_windows']} moments a set. Trained on {budgets}."


if __name__ == "__main__":
    try:
        sys.exit(table1.main("table1_paper", section))
    except CadenceError as error:
        sys.exit(f"{error}")
