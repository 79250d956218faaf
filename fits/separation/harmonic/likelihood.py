"""The spectral likelihood, summed over multipoles."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from fits.mixing import spectral_names
from fits.multipoles import check_alm, compressed, multipoles_of
from fits.profile_likelihood import SpectralLikelihood, spectral_likelihood
from fits.template_likelihood import named_bands
from jaxsky import Bandpass, Component, Sky, get_parameters
from jaxsky.checks import Numeric


def _refuse_maps(sky: Sky, start: Mapping[str, Numeric]) -> None:
    names = [name for name in spectral_names(sky) if name not in start]
    for name, value in get_parameters(sky, names).items():
        if jnp.ndim(value):
            raise ValueError(
                f"Parameter {name!r} is a map of {value.size} pixels, but in the harmonic domain "
                "it must be a number: laws that vary over the sky mix multipoles."
            )


def harmonic_likelihood(
    sky: Sky | Mapping[str, Component],
    bands: Mapping[str, Bandpass] | Sequence[Bandpass],
    alm: Numeric,
    noise: Numeric,
    start: Mapping[str, Numeric],
    *,
    beams: Numeric,
    unit: str = "uK_RJ",
    lmin: int = 2,
    lmax: int | None = None,
) -> SpectralLikelihood:
    """The spectral likelihood of full-sky maps that each have their own beam.

    -2 ln L = sum_lm [d^T W d - (A^T W d)^T (A^T W A)^-1 (A^T W d)] with d = d_lm / b_l and
    W = b_l^2 / N_l: that of Stompor et al. (2009, MNRAS 392, 216) with multipoles in the place of
    pixels. Where the beam of a band is below 1e-5, it is left out.

    Parameters
    ----------
    sky : components by name. Their laws count, not their amplitudes; parameters that are not
        free keep their values, which must be numbers.
    bands : the bands by name, or as a list
    alm : packed coefficients (band, stokes, alm) of the maps as observed, E, B or I, E, B; see
        `harmonic_coefficients`
    noise : N_l of the maps as observed [square of `unit` times sr], shape (band,), (band, stokes)
        or (band, stokes, ell) from l = 0; infinite where a band is not to be used. See
        `white_spectrum`.
    start : start values of the free parameters by name, as for `spectral_likelihood`
    beams : full widths at half maximum of Gaussian beams [arcmin], (band,), or tables b_l,
        (band, ell) from l = 0, with the window of the pixels if the maps have one
    unit : of the data, "uK_RJ", "K_CMB" or the like; amplitudes are uK in any case (CMB: uK_CMB)
    lmin, lmax : smallest and largest multipole that is used; by default 2 and all there are

    Returns
    -------
    The likelihood, for `fits.separation.fit_spectra`. Maps of the components come from
    `harmonic_component_maps`.

    Raises
    ------
    RuntimeError
        If JAX is not in double precision.
    KeyError
        For unknown parameters.
    TypeError, ValueError
        For shapes that do not match, units, noise that is not positive, coefficients that are not
        finite, parameters that are maps, too few bands, or too few that resolve a multipole.
    """
    sky = sky if isinstance(sky, Sky) else Sky(sky)
    bands = named_bands(bands)
    alm = check_alm(alm, len(bands))
    _refuse_maps(sky, start)
    # The laws and their parameters, on a pixel without data.
    nothing = np.zeros((len(bands), alm.shape[1], 1))
    like = spectral_likelihood(
        sky, bands, nothing, np.ones(len(bands)), start, unit=unit, compress=False
    )
    components = len(sky.components)
    multipoles = multipoles_of(alm.shape, noise, beams, components, lmin, lmax)
    return dataclasses.replace(
        like,
        pixels=tuple(compressed(alm, multipoles, layout) for layout in like.layout),
        block_cell=jnp.zeros(len(multipoles.ell), int),
        values=int(multipoles.dof(components).sum()),
    )
