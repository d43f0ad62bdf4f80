"""Types of arrays that the whole package shares."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

#: Floating-point numbers, of any shape.
Floats = npt.NDArray[np.float64]
