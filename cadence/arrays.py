"""Names of numpy array types, by what they hold; shapes and units stand with whatever bears them."""

import numpy as np
from numpy.typing import NDArray

Float64s = NDArray[np.float64]
Float32s = NDArray[np.float32]
Floats = NDArray[np.floating]
Int64s = NDArray[np.int64]
UInt64s = NDArray[np.uint64]
Int32s = NDArray[np.int32]
Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]
Objects = NDArray[np.object_]
