"""Transform a posterior to unbounded numbers whose covariance is about the unit matrix.

A uniform prior becomes the logistic map of its range, whose Jacobian is part of the density; the
curvature of -log posterior at the best fit gives the rest, until there are samples. Where a prior
cuts the posterior, that map is far from linear. The other parameters are then linear in the cut
parameter itself, not in its unbounded number, or, once there are samples, in the best combination
of both: so a narrow ridge remains straight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Bool, Float

from fits.posterior import Density, Posterior
from fits.systems import degenerate

#: Samples per parameter from which they say more than the curvature at the best fit.
ENOUGH = 30
#: Spread of an unbounded number above which its prior cuts the parameter: an edge is then within
#: about four standard deviations.
NEAR = 0.25


class Unbounded(NamedTuple):
    """Numbers z for samplers: unbounded numbers are center + root z, or root * z if a vector.

    `cut` are parameters that are cut by their prior, `middle` is about where they are, and `lean`
    is added to the numbers of the others per unit of distance from there.
    """

    density: Density
    center: Float[Array, " par"]
    root: Float[Array, "*par par"]
    cut: Bool[Array, " par"]
    middle: Float[Array, " par"]
    lean: Float[Array, "*par par"]

    def values(self, z: Float[Array, " par"]) -> tuple[Float[Array, " par"], Float[Array, ""]]:
        """Return parameters, and the log of the Jacobian of the logistic map."""
        low, width = self.density.low, self.density.high - self.density.low
        if self.root.ndim == 1:
            y = self.center + self.root * z
        else:
            y = self.center + self.root @ z
            moved = low + width * jax.nn.sigmoid(y) - self.middle
            y = y + self.lean @ jnp.where(self.cut, moved, 0.0)
        inside = low + width * jax.nn.sigmoid(y)
        jacobian = jnp.log(width) + jax.nn.log_sigmoid(y) + jax.nn.log_sigmoid(-y)
        values = jnp.where(self.density.bounded, inside, y)
        return values, jnp.sum(jnp.where(self.density.bounded, jacobian, 0.0))

    def log_density(self, z: Float[Array, " par"]) -> Float[Array, ""]:
        """Return the log density of z."""
        values, jacobian = self.values(z)
        return self.density.log_prob(values) + jacobian

    def coordinates(self, values: Float[np.ndarray, "sample par"]) -> np.ndarray:
        """Return the z of parameters; `root` must be a matrix."""
        rest = self._unbounded(values) - np.asarray(self.center)
        moved = np.where(self.cut, values - np.asarray(self.middle), 0.0)
        return np.linalg.solve(self.root, (rest - moved @ np.asarray(self.lean).T).T).T

    def _unbounded(self, values: np.ndarray) -> np.ndarray:
        bounded, low, high = map(np.asarray, self.density[4:])
        # At an edge to rounding, the number stays finite.
        unit = np.clip((values - low) / (high - low), 1e-15, 1 - 1e-15)
        return np.where(bounded, scipy.special.logit(unit), values)

    def adapted(self, values: Float[np.ndarray, "sample par"]) -> "Unbounded":
        """Adapt to the covariance of samples, as a matrix; unchanged if too few, or not moving."""
        y = self._unbounded(values)
        center, middle, spread = y.mean(axis=0), values.mean(axis=0), y.std(axis=0)
        if len(y) < ENOUGH * len(spread) or not np.isfinite(spread).all() or not spread.min() > 0:
            return self
        y = (y - center) / spread
        cut = np.asarray(self.density.bounded) & (spread > NEAR)
        first, rest = np.flatnonzero(cut), np.flatnonzero(~cut)
        width = values[:, first].std(axis=0)
        # The others as linear functions of cut parameters and of their unbounded numbers.
        both = np.concatenate([y[:, first], (values[:, first] - middle[first]) / width], axis=1)
        slopes = np.linalg.lstsq(both, y[:, rest], rcond=1e-6)[0].T
        rests = y[:, rest] - both @ slopes.T
        root, lean = np.zeros_like(self.root), np.zeros_like(self.root)
        try:
            for own, block in ((first, y[:, first]), (rest, rests)):
                root[np.ix_(own, own)] = np.linalg.cholesky(block.T @ block / len(block))
        except np.linalg.LinAlgError:
            return self
        root[np.ix_(rest, first)] = slopes[:, : len(first)] @ root[np.ix_(first, first)]
        lean[np.ix_(rest, first)] = slopes[:, len(first) :] / width
        return self._replace(
            center=jnp.asarray(center),
            root=jnp.asarray(root * spread[:, None]),
            cut=jnp.asarray(cut),
            middle=jnp.asarray(middle),
            lean=jnp.asarray(lean * spread[:, None]),
        )


def unbounded_posterior(posterior: Posterior, theta: np.ndarray) -> tuple[Unbounded, list[str]]:
    """Return the posterior, scaled by its curvature near the best fit theta.

    Also return the labels of parameters that it does not determine.
    """
    density = posterior.density(theta)
    present, bounded, low, high = map(np.asarray, density[3:])
    width = high - low

    def derivatives(theta):
        matrix = posterior.curvature(theta, posterior.convex(theta), present)
        return matrix, posterior.value(theta)[1][present]

    # Away from the edges by the distance over which the density falls there.
    matrix, slope = derivatives(theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.stack([1 / np.sqrt(matrix.diagonal()), 1 / np.abs(slope), width / 4])
    margin = np.nanmin(scales, axis=0)
    theta = theta.copy()
    near = np.clip(theta[present], low + margin, high - margin)
    theta[present] = np.where(bounded, near, theta[present])
    matrix, slope = derivatives(theta)

    unit = np.where(bounded, (theta[present] - low) / width, 0.5)
    jacobian = np.where(bounded, width * unit * (1 - unit), 1.0)
    bend = np.maximum(slope * jacobian * (1 - 2 * unit), 0) + 2 * unit * (1 - unit)
    diagonal = matrix.diagonal() * jacobian**2 + np.where(bounded, bend, 0.0)
    unknown = []
    if isinstance(matrix, np.ndarray):
        matrix = matrix * jacobian * jacobian[:, None]
        np.fill_diagonal(matrix, diagonal)
        unknown = degenerate(matrix, [posterior.labels[i] for i in present])
    elif (flat := ~(diagonal > 0)).any():
        unknown = [posterior.labels[i] for i in present[flat]]
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    root, cut, lean = scale, np.zeros(len(present), bool), np.zeros(0)
    if isinstance(matrix, np.ndarray) and not unknown:
        root, cut, lean = _straightened(matrix * scale * scale[:, None], bounded, scale, jacobian)
    center = np.where(bounded, np.log(unit / (1 - unit)), theta[present])
    numbers = (center, root, cut, theta[present], lean)
    return Unbounded(posterior.density(theta), *map(jnp.asarray, numbers)), unknown


def _straightened(matrix, bounded, scale, jacobian):
    """Return root, cut parameters, and lean of others on these; see `Unbounded`.

    The matrix is the curvature in unbounded numbers times `scale` on both sides, with a unit
    diagonal; `jacobian` is the derivative of parameters in unbounded numbers.
    """
    spread = scale * np.sqrt(np.diagonal(np.linalg.inv(matrix)))
    cut = bounded & (spread > NEAR)
    first, rest = np.flatnonzero(cut), np.flatnonzero(~cut)
    coupling, alone = matrix[np.ix_(rest, first)], matrix[np.ix_(rest, rest)]
    follow = -np.linalg.solve(alone, coupling)
    led = matrix[np.ix_(first, first)] + coupling.T @ follow
    root, lean = np.zeros_like(matrix), np.zeros_like(matrix)
    for own, block in ((rest, alone), (first, led)):
        root[np.ix_(own, own)] = np.linalg.inv(np.linalg.cholesky(block)).T
    lean[np.ix_(rest, first)] = follow / (scale * jacobian)[first]
    return root * scale[:, None], cut, lean * scale[:, None]
