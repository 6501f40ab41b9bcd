"""Types of arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Array that a kernel takes: of the type of the lanes, or of the one that its record or docstring states."""
Floats = NDArray[np.float64]
