"""Newton's method with exact second derivatives, damped as by Levenberg and Marquardt.

A step does not depend on the units of parameters or data.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from fits.posterior import Matrix, Posterior
from fits.systems import Factor

#: Steps of a search, by default.
NEWTON_STEPS = 100


def _damped(matrix: Matrix, damping: float) -> Matrix:
    diagonal = np.abs(matrix.diagonal()) * damping
    if isinstance(matrix, np.ndarray):
        return matrix + np.diag(diagonal)
    return scipy.sparse.csc_matrix(matrix + scipy.sparse.diags(diagonal))


class Newton(NamedTuple):
    """The solver.

    Parameters
    ----------
    last : a step this small, in standard deviations, is the last one
    """

    last: float = 1e-5

    def minimise(
        self, posterior: Posterior, max_steps: int | None = None
    ) -> tuple[Float[np.ndarray, " par"], int]:
        """The optimum within bounds, and the number of steps to it."""
        theta, max_steps = posterior.start, NEWTON_STEPS if max_steps is None else max_steps
        value, gradient = posterior.value(theta)
        damping, reach = 1e-4, posterior.reach()
        for step in range(max_steps):
            blocked = (theta <= posterior.low) & (gradient > 0) | (theta >= posterior.high) & (
                gradient < 0
            )
            moving = np.flatnonzero(posterior.present & ~blocked)
            if not moving.size:
                return theta, step
            local = posterior.exact(theta)
            matrix = posterior.curvature(theta, local, moving)
            factor = Factor(matrix)
            exact = factor.positive
            if not exact:
                local = posterior.convex(theta, local)
                matrix = posterior.curvature(theta, local, moving)
                factor = Factor(matrix)
            slope = gradient[moving]
            newton = factor.solve(-slope) if factor.positive else None
            close = exact and np.sqrt(max(-slope @ newton, 0)) < self.last * np.sqrt(len(moving))
            for _ in range(40):
                move = newton
                if newton is None or (damping and not close):
                    damped = Factor(_damped(matrix, damping or 1e-6))
                    move = damped.solve(-slope) if damped.positive else None
                if move is not None:
                    trial = theta.copy()
                    trial[moving] += np.clip(move, -reach[moving], reach[moving])
                    trial = np.clip(trial, posterior.low, posterior.high)
                    made = trial[moving] - theta[moving]
                    expected = -(slope @ made + made @ (matrix @ made) / 2)
                    new, new_gradient = posterior.value(trial)
                    rounding = 1e-13 * abs(value)
                    gained = (value - new + rounding) / (max(expected, 0) + rounding)
                    if np.isfinite(new) and np.isfinite(new_gradient).all() and gained > 1e-3:
                        break
                damping = max(10 * damping, 1e-4)
            else:
                return theta, step
            theta, value, gradient = trial, new, new_gradient
            if close:
                return theta, step + 1
            damping = damping / 10 if gained > 0.5 else damping
            damping = 0.0 if damping < 1e-8 else damping
        return theta, max_steps
