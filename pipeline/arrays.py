"""Names of numpy array types beside those of `cadence.arrays`; shapes and units stand with whatever bears them."""

from typing import Any

from numpy.typing import NDArray

Column = NDArray[Any]
"""Values of one field of many messages or rows, of whatever type the field has."""
