"""Templates and maps at a common resolution, where they can be compared."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.covariance import Fluctuations, uniform_level
from fits.inputs import Inputs
from fits.preparation import Preparation, prepare_component
from fits.record import fingerprint
from fits.template_likelihood import CovarianceOf, Likelihood, likelihood
from fits.template_noise import prepared_variance
from jaxsky import Bandpass, Sky, observe
from jaxsky.checks import Numeric
from jaxsky.harmonics import beam_ratio, gaussian_beam, pixel_window

#: A pixel is used if no more than this fraction of what was smoothed or averaged was missing.
MISSING = 0.01


class Prepared(NamedTuple):
    """Templates and maps at the common resolution.

    `sky` is None where there are no templates. `leakage` is what was subtracted from the data, by
    band, and `sources` the nside of each template and map as they were given. `covariance_of` is
    that of the fluctuations, which remembers what it was asked for last, `template_variances` that
    of the noise of each template where it is known.
    """

    sky: Sky | None
    bands: dict[str, Bandpass]
    data: Float[Array, "band stokes pix"]
    sigma: Float[Array, "band stokes pix"]
    used: Bool[np.ndarray, " pix"]
    fluctuations: Fluctuations
    leakage: dict[str, Float[Array, "stokes pix"]]
    sources: dict[str, int]
    covariance_of: CovarianceOf
    template_variances: dict[str, Float[Array, "stokes pix"]]

    def model(self) -> Float[Array, "band stokes pix"]:
        """What the templates show in the bands [uK_RJ]."""
        assert self.sky is not None  # there are templates
        return observe(self.sky, list(self.bands.values()))

    def likelihood(
        self,
        start: Mapping[str, Numeric],
        *,
        stokes: str = "QU",
        region: Bool[np.ndarray, " pix"] | None = None,
        kind: str = "exact",
    ) -> Likelihood:
        """The likelihood of the parameters in `start`; see `fits.template_likelihood.likelihood`.

        Parameters
        ----------
        start : free parameters by name
        stokes : "Q", "U" or "QU"
        region : pixels to use, of those that can be; default all
        kind : "exact", or "diagonal" for the paper's sum over pixels
        """
        if kind not in ("exact", "diagonal"):
            raise ValueError(f"Argument `kind` must be 'exact' or 'diagonal', not {kind!r}.")
        used = self.used if region is None else self.used & region
        assert self.sky is not None  # there are templates
        return likelihood(
            self.sky,
            self.bands,
            self.data,
            jnp.where(used, self.sigma, jnp.inf),
            start,
            stokes=stokes,
            covariance_of=self.covariance_of if kind == "exact" else None,
        )


def prepare(inputs: Inputs, nside: int, fwhm: float) -> Prepared:
    """Bring templates and maps to a common nside and, if fwhm > 0, a common beam.

    With fwhm = 0 pixels are averaged and beams stay as they are. Otherwise all maps are cut at
    one multipole, that to which the coarsest is good.

    Parameters
    ----------
    inputs : templates and maps
    nside, fwhm : common resolution; fwhm in arcmin
    """
    maps: dict[str, tuple[Bool[np.ndarray, " pix"], Any]] = {
        f"template {name!r}": (t.used, t.fwhm) for name, t in inputs.templates.items()
    }
    maps |= {f"band {name!r}": (b.used, b.beam) for name, b in inputs.bands.items()}
    maps |= {
        f"leakage of band {name!r}": (b.leakage.used, b.leakage.beam)
        for name, b in inputs.bands.items()
        if b.leakage is not None
    }
    nsides = {name: healpy.npix2nside(used.size) for name, (used, _) in maps.items()}
    lmax = min(3 * nside - 1, 2 * min(nsides.values()))
    operators = {}
    for name, (_, own) in maps.items():
        if fwhm:
            operator = Preparation.smoothing(nsides[name], own, nside, fwhm, lmax, name)
        else:
            operator = Preparation.averaging(nsides[name], nside, name)
        operators[name] = operator

    holes = _common_holes([own_used for own_used, _ in maps.values()]) if fwhm else {}
    used = np.ones(healpy.nside2npix(nside), bool)
    for name, (own_used, _) in maps.items():
        if not own_used.all():
            spread = operators[name]
            if fwhm:  # the whole beam, without the ringing that the cut at lmax causes
                window = gaussian_beam(fwhm, 2 * nsides[name])
                spread = Preparation(window, nsides[name], nside)
                own_used = holes[nsides[name]]
            kept = spread(jnp.asarray(own_used[None], float))[0]
            used &= np.asarray(kept) > 1 - MISSING
    sky = {
        name: prepare_component(
            template.component,
            operators[f"template {name!r}"],
            holes.get(nsides[f"template {name!r}"]),
        )
        for name, template in inputs.templates.items()
    }
    preparations = tuple(operators[f"band {name!r}"] for name in inputs.bands)
    whole = [holes.get(op.nside_in) for op in preparations]
    leakage = {
        name: operators[f"leakage of band {name!r}"](
            _without(band.leakage.maps, holes.get(healpy.npix2nside(band.leakage.used.size)))
        )
        for name, band in inputs.bands.items()
        if band.leakage is not None
    }
    data = jnp.stack(
        [
            # Band by band: JAX would make what all of them need ahead of their transforms.
            (op(_without(band.maps, kept)) - leakage.get(name, 0.0)).block_until_ready()
            for op, (name, band), kept in zip(
                preparations, inputs.bands.items(), whole, strict=True
            )
        ]
    )
    bandpasses = {name: band.bandpass for name, band in inputs.bands.items()}
    factors = jnp.stack([b.conversion("uK_CMB", "uK_RJ") for b in bandpasses.values()])
    spectra = windows = None
    if not fwhm:  # averaged pixels hold multipoles beyond those they resolve
        lmax = 4 * nside
    if inputs.cmb is not None:
        beams = [fwhm or band.beam for band in inputs.bands.values()]
        windows = jnp.stack([beam_ratio(beam, 0.0, lmax) for beam in beams])
        if not fwhm:
            windows = windows * pixel_window(nside, lmax)
        spectra = jnp.asarray(inputs.cmb(lmax)[1:3])
    noise = tuple(
        band.noise if kept is None else band.noise * kept
        for band, kept in zip(inputs.bands.values(), whole, strict=True)
    )
    correlated = tuple(
        _prepared_spectrum(band.correlated, op, lmax)
        for op, band in zip(preparations, inputs.bands.values(), strict=True)
    )
    fluctuations = Fluctuations(
        preparations,
        noise,
        correlated,
        spectra,
        windows,
        factors,
        tuple(inputs.bands),
        tuple(map(uniform_level, noise)),
    )
    sigma = fluctuations.sigma()
    known = np.asarray(jnp.isfinite(sigma).all(axis=(0, 1)))
    return Prepared(
        Sky(sky) if sky else None,
        bandpasses,
        data,
        jnp.where(known, sigma, jnp.inf),
        used & known,
        fluctuations,
        leakage,
        nsides,
        _remembered(fluctuations.covariance),
        {
            name: prepared_variance(
                noise, inputs.templates[name].fwhm, operators[f"template {name!r}"], fwhm
            )
            for name, noise in inputs.template_noise.items()
        },
    )


def _remembered(covariance_of: CovarianceOf) -> CovarianceOf:
    """A covariance that is made once for rows that come again, as for each choice of Stokes."""
    last: dict[str, Float[np.ndarray, "row row"]] = {}

    def remembered(rows: Float[Array, "band row stokes pix"]) -> Float[np.ndarray, "row row"]:
        mark = fingerprint(rows)
        if mark not in last:
            last.clear()
            last[mark] = covariance_of(rows)
        return last[mark]

    return remembered


def _common_holes(maps: Sequence[Bool[np.ndarray, " pix"]]) -> dict[int, np.ndarray]:
    """Pixels that no map misses, at each nside of the maps; empty if none misses any.

    Smoothing spreads what surrounds a hole into it and the hole into what surrounds it, so all
    maps, templates and data, get the same holes.
    """
    if all(used.all() for used in maps):
        return {}
    nsides = {healpy.npix2nside(used.size) for used in maps}
    return {
        nside: np.logical_and.reduce(
            [healpy.ud_grade(u.astype(float), nside) > 0.999 for u in maps]
        )
        for nside in nsides
    }


def _without(maps: Float[Array, "stokes pix"], kept: np.ndarray | None) -> Array:
    """Maps in double precision, zero outside the pixels that are kept; None keeps all."""
    return jnp.asarray(maps, float) if kept is None else jnp.asarray(maps, float) * kept


def _prepared_spectrum(
    spectrum: Float[Array, " ell"] | None, preparation: Preparation, lmax: int
) -> Float[Array, " ell"] | None:
    """Spectrum of a prepared map, from that before."""
    if spectrum is None:
        return None
    window = preparation.window
    if window is None:
        pixels = pixel_window(preparation.nside, lmax) / pixel_window(preparation.nside_in, lmax)
        window = jnp.asarray(pixels)
    return spectrum[: lmax + 1] * window**2
