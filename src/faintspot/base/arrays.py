"""Types of arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Of a kernel: its type is that of the lanes, or stands in the record or docstring."""
Floats = NDArray[np.float64]
