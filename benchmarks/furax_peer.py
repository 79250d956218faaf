"""The spectral likelihood of FURAX: the peer of `fits.profile_likelihood`.

FURAX (github.com/CMBSciPol/furax) writes A^T N^-1 A as an operator on maps and inverts it by
conjugate gradients. Its bands are monochromatic. What its own benchmarks do is call
`negative_log_likelihood` with references at 150 and 20 GHz; here it is used in three more ways
that are faster: with references at which the components are about as bright, so that the matrix
is better conditioned; with a preconditioner of our own for its solver; and with its operators
alone, the small systems solved directly. The gradient is its analytical one.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import lineax
import numpy as np
from furax import AbstractLinearOperator, Config, asoperator
from furax.obs import CMBOperator, DustOperator, SynchrotronOperator, spectral_log_likelihood
from furax.obs.operators import MixingMatrixOperator, NoiseDiagonalOperator
from furax.obs.stokes import StokesQU
from furax.tree import dot

#: T_CMB of its operators [K], of astropy's Planck15.
T_CMB = 2.7255
#: References [GHz] of dust and synchrotron: those of its benchmarks, and those for which
#: conjugate gradients take the fewest steps with LiteBIRD's noise, of seven pairs tried.
USUAL, BALANCED = (150.0, 20.0), (220.0, 80.0)
#: Its own tolerance, and a number of steps that is never reached (its own is 500).
TOLERANCE, MANY = 1e-6, 20_000
NAMES = ("temp_dust", "beta_dust", "beta_pl")

# The solver is looked up while a function is traced. The jitted function would be traced once,
# for the first solver, and then used with all of them.
_log_likelihood = spectral_log_likelihood.__wrapped__

#: T_dust, beta_dust, beta_syn -> -ln L up to a constant, and its gradient
Evaluation = Callable[[np.ndarray], tuple[float, np.ndarray]]


class Furax:
    """Data and noise in FURAX's types, and ways to evaluate the likelihood.

    Parameters
    ----------
    nu : frequencies [GHz]
    data : maps (band, QU, pix) [uK_CMB]
    sigma : noise (band, 1 or QU, 1 or pix) [uK_CMB]

    Attributes
    ----------
    steps : conjugate-gradient steps of the last evaluations
    """

    def __init__(self, nu: np.ndarray, data: np.ndarray, sigma: np.ndarray) -> None:
        self.nu = jnp.asarray(nu)
        self.data = StokesQU.from_array(jnp.asarray(np.ascontiguousarray(data.swapaxes(0, 1))))
        variance = jnp.asarray(np.ascontiguousarray(sigma.swapaxes(0, 1)) ** 2)
        self.noise = NoiseDiagonalOperator(variance, in_structure=self.data.structure)
        self.steps: list[int] = []

    def conjugate_gradients(
        self,
        reference: tuple[float, float] = BALANCED,
        max_steps: int = MANY,
        preconditioned: np.ndarray | None = None,
    ) -> Evaluation:
        """Its own likelihood, compiled.

        Parameters
        ----------
        reference : frequencies of dust and synchrotron [GHz]
        max_steps : of the solver
        preconditioned : parameters at which the inverse of A^T N^-1 A in each pixel is made, the
            preconditioner; none if not given
        """
        options: dict[str, Any] = {}
        if preconditioned is not None:
            params = self._params(preconditioned)
            options["preconditioner"] = self._preconditioner(params, reference)
        config = {
            "solver": lineax.CG(rtol=TOLERANCE, atol=TOLERANCE, max_steps=max_steps),
            "solver_options": options,
            "solver_callback": lambda solution: self.steps.append(int(solution.stats["num_steps"])),
        }

        def value(params, noise, data):
            with Config(**config):
                return -_log_likelihood(
                    params, self.nu, noise, data, *reference, analytical_gradient=True
                )

        return self._compiled(value)

    def direct(self) -> Evaluation:
        """Its operators, and a Cholesky factorisation of 3 x 3 numbers in each pixel, compiled."""

        def value(params, noise, data):
            mixing = self._mixing(params, BALANCED)
            right = (mixing.T @ noise.I)(data)
            lower = jnp.linalg.cholesky(self._blocks(mixing, noise), symmetrize_input=False)
            solve = jax.lax.linalg.triangular_solve
            solved = jnp.stack([each.data for each in right.values()], axis=-1)[..., None]
            solved = solve(lower, solved, left_side=True, lower=True)
            solved = solve(lower, solved, left_side=True, lower=True, transpose_a=True)[..., 0]
            # The amplitudes are where the function below is stationary: they count as constant.
            solved = jax.lax.stop_gradient(solved)
            sky = {name: StokesQU.from_array(solved[..., i]) for i, name in enumerate(right)}
            model = mixing(sky)
            return dot(model, noise.I(model)) - 2 * dot(right, sky)

        return self._compiled(value)

    def _compiled(self, value: Callable[..., jax.Array]) -> Evaluation:
        example = self._params(np.ones(3))
        program = jax.jit(jax.value_and_grad(value)).lower(example, self.noise, self.data).compile()

        def evaluate(theta):
            chi2, gradient = program(self._params(theta), self.noise, self.data)
            slope = np.array([gradient[name] for name in NAMES]) * [1, 1, -1]
            return float(chi2) / 2, slope / 2

        return evaluate

    @staticmethod
    def _params(theta: np.ndarray) -> dict[str, jax.Array]:
        T_dust, beta_dust, beta_syn = theta
        values = (T_dust, beta_dust, -beta_syn)
        return {name: jnp.asarray(float(v)) for name, v in zip(NAMES, values, strict=True)}

    def _mixing(
        self, params: Mapping[str, jax.Array], reference: tuple[float, float]
    ) -> AbstractLinearOperator:
        structure = self.data.structure_for(self.data.shape[1:])
        return MixingMatrixOperator(
            cmb=CMBOperator(self.nu, in_structure=structure),
            dust=DustOperator(
                self.nu,
                frequency0=reference[0],
                temperature=params["temp_dust"],
                beta=params["beta_dust"],
                in_structure=structure,
            ),
            synchrotron=SynchrotronOperator(
                self.nu, frequency0=reference[1], beta_pl=params["beta_pl"], in_structure=structure
            ),
        )

    @staticmethod
    def _blocks(mixing: AbstractLinearOperator, noise: AbstractLinearOperator) -> jax.Array:
        """A^T N^-1 A in each pixel, (stokes, pix, component, component)."""
        normal = mixing.T @ noise.I @ mixing
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), normal.in_structure)
        columns = []
        for name in zero:
            unit = {**zero, name: jax.tree.map(lambda x: x + 1, zero[name])}
            column = normal(unit)
            columns.append(jnp.stack([each.data for each in column.values()], axis=-1))
        return jax.lax.stop_gradient(jnp.stack(columns, axis=-1))

    def _preconditioner(
        self, params: Mapping[str, jax.Array], reference: tuple[float, float]
    ) -> AbstractLinearOperator:
        mixing = self._mixing(params, reference)
        inverse = jnp.linalg.inv(self._blocks(mixing, self.noise))
        count = inverse.shape[-1]
        # An element in all pixels side by side, as its maps are.
        elements = [[inverse[..., i, j] for j in range(count)] for i in range(count)]

        def apply(sky, elements):
            parts = [each.data for each in sky.values()]
            rows = [sum(e * x for e, x in zip(row, parts, strict=True)) for row in elements]
            return {n: StokesQU.from_array(row) for n, row in zip(sky, rows, strict=True)}

        return asoperator(apply, in_structure=mixing.in_structure, elements=elements)
