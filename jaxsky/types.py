"""Types that recur in signatures."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Float

#: What the spectral laws take: numbers or arrays that broadcast.
Numeric: TypeAlias = float | Array | np.ndarray
#: A spectral parameter: a number or a map; an array, once a component holds it.
Parameter: TypeAlias = Float[Array, ""] | Float[Array, " pix"] | float
