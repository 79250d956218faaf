"""Templates, maps and their noise at a common resolution, where they can be compared."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fits.fluctuations import Fluctuations
from fits.inputs import Inputs
from fits.kept import fingerprint
from fits.template_likelihood import CovarianceOf, SkyLikelihood, likelihood
from fits.template_noise import TemplateErrors
from jaxsky import Bandpass, Sky, observe
from jaxsky.checks import Numeric
from jaxsky.components import Component
from jaxsky.harmonics import Preparation, beam_ratio, gaussian_beam, pixel_window
from jaxsky.noise import pixel_covariance
from jaxsky.settings import Experiment, at_key

#: A pixel is used if no more than this fraction of what was smoothed or averaged was missing.
MISSING = 0.01


class CommonMaps(NamedTuple):
    """Templates and maps at the common resolution.

    `sky` is None where there are no templates. `leakage` is what was subtracted from the data, by
    band, and `sources` the nside of each template and map as they were given. `covariance_of` is
    that of the fluctuations, which remembers what it was asked for last. `template_errors` is the
    noise of the templates where it is known, None where there is none.
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
    template_errors: TemplateErrors | None

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
    ) -> SkyLikelihood:
        """The likelihood of the parameters in `start`; see `fits.template_likelihood.likelihood`.

        Parameters
        ----------
        start : free parameters by name; where templates have noise, the errors that it causes are
            those at these values
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
            template_errors=self.template_errors,
        )

    def noise_shares(self, region: Bool[np.ndarray, " pix"], stokes: str) -> dict[str, float]:
        """Part of the weighted power of each template that is its noise."""
        assert self.sky is not None
        assert self.template_errors is not None  # as called
        keep = np.array([s in stokes for s in "QU"])
        inside = self.used & region & np.isfinite(self.sigma) & keep[:, None]
        weights = np.where(inside, 1 / np.asarray(self.sigma) ** 2, 0.0)
        templates = np.stack([c.amplitude for c in self.sky.components.values()])
        shares = self.template_errors.shares(np.where(self.used, templates, 0.0), weights)
        return dict(zip(self.sky, shares.tolist(), strict=True))


def prepared_maps(settings: Experiment, inputs: Inputs) -> CommonMaps:
    """Templates and maps at the resolution of the settings, whose key errors name."""
    with at_key("common"):
        return common_maps(inputs, settings.common.nside, settings.common.fwhm)


def common_maps(inputs: Inputs, nside: int, fwhm: float) -> CommonMaps:
    """Bring templates and maps to a common nside and, if fwhm > 0, a common beam.

    With fwhm = 0 pixels are averaged and beams stay as they are. Otherwise all maps are cut at
    one multipole, that to which the coarsest is good.

    Parameters
    ----------
    inputs : templates and maps
    nside, fwhm : common resolution; fwhm in arcmin
    """
    templates = {f"template {name!r}": t for name, t in inputs.templates.items()}
    bands = {f"band {name!r}": b for name, b in inputs.bands.items()}
    leaked = {f"leakage of {what}": b.leakage for what, b in bands.items() if b.leakage is not None}
    given: dict[str, tuple[Bool[np.ndarray, " pix"], Any]] = {
        what: (t.used, t.fwhm) for what, t in templates.items()
    }
    given |= {what: (each.used, each.beam) for what, each in (bands | leaked).items()}
    nsides = {what: healpy.npix2nside(used.size) for what, (used, _) in given.items()}
    lmax = min(3 * nside - 1, 2 * min(nsides.values()))
    operators = {
        what: Preparation.smoothing(nsides[what], own, nside, fwhm, lmax, what)
        if fwhm
        else Preparation.averaging(nsides[what], nside, what)
        for what, (_, own) in given.items()
    }
    holes = _common_holes([used for used, _ in given.values()]) if fwhm else {}
    kept = {what: holes.get(own) for what, own in nsides.items()}

    used = np.ones(healpy.nside2npix(nside), bool)
    for what, (own_used, _) in given.items():
        if not own_used.all():
            spread = operators[what]
            if fwhm:  # the whole beam, without the ringing that the cut at lmax causes
                window = gaussian_beam(fwhm, 2 * nsides[what])
                spread, own_used = Preparation(window, nsides[what], nside), holes[nsides[what]]
            left = spread(jnp.asarray(own_used[None], float))[0]
            used &= np.asarray(left) > 1 - MISSING
    sky = {
        name: prepare_component(template.component, operators[what], kept[what])
        for (what, template), name in zip(templates.items(), inputs.templates, strict=True)
    }

    def brought(what: str, maps: Array) -> Array:
        """Maps in double precision without holes, at the common resolution."""
        maps, own = jnp.asarray(maps, float), kept[what]
        return operators[what](maps if own is None else maps * own)

    leakage = {
        name: brought(f"leakage of band {name!r}", band.leakage.maps)
        for name, band in inputs.bands.items()
        if band.leakage is not None
    }
    data = [
        # Band by band: JAX would make what all of them need ahead of their transforms.
        (brought(f"band {name!r}", band.maps) - leakage.get(name, 0.0)).block_until_ready()
        for name, band in inputs.bands.items()
    ]
    fluctuations = _fluctuations(
        inputs, [operators[w] for w in bands], [kept[w] for w in bands], fwhm, lmax
    )
    sigma = fluctuations.sigma()
    known = np.asarray(jnp.isfinite(sigma).all(axis=(0, 1)))
    return CommonMaps(
        Sky(sky) if sky else None,
        {name: band.bandpass for name, band in inputs.bands.items()},
        jnp.stack(data),
        jnp.where(known, sigma, jnp.inf),
        used & known,
        fluctuations,
        leakage,
        nsides,
        _remembered(fluctuations.covariance),
        _template_errors(inputs, operators, kept, fluctuations, lmax if fwhm else 4 * nside),
    )


def _fluctuations(
    inputs: Inputs,
    operators: Sequence[Preparation],
    kept: Sequence[np.ndarray | None],
    fwhm: float,
    lmax: int,
) -> Fluctuations:
    """Noise and CMB of the bands at the common resolution.

    Parameters
    ----------
    inputs : the bands
    operators, kept : of each band, and the pixels of it that are not holes; None if there are none
    fwhm, lmax : common beam [arcmin], 0 for averages of pixels, and largest multipole
    """
    bands = inputs.bands.values()
    factors = jnp.stack([band.bandpass.conversion("uK_CMB", "uK_RJ") for band in bands])
    nside = operators[0].nside
    if not fwhm:  # averaged pixels hold multipoles beyond those they resolve
        lmax = 4 * nside
    spectra = windows = None
    if inputs.cmb is not None:
        windows = jnp.stack([beam_ratio(fwhm or band.beam, 0.0, lmax) for band in bands])
        if not fwhm:
            windows = windows * pixel_window(nside, lmax)
        spectra = jnp.asarray(inputs.cmb(lmax)[1:3])
    noise = tuple(
        _without_holes(band.noise, op, own)
        for op, band, own in zip(operators, bands, kept, strict=True)
    )
    correlated = tuple(
        prepared_spectrum(band.correlated, op, lmax)
        for op, band in zip(operators, bands, strict=True)
    )
    return Fluctuations(
        tuple(operators),
        noise,
        correlated,
        spectra,
        windows,
        factors,
        tuple(inputs.bands),
    )


def _without_holes(noise: Numeric, operator: Preparation, kept: np.ndarray | None) -> Numeric:
    """Noise of the pixels that are kept."""
    return noise if kept is None else pixel_covariance(noise, operator.nside_in) * kept


def _template_errors(
    inputs: Inputs,
    operators: Mapping[str, Preparation],
    kept: Mapping[str, np.ndarray | None],
    fluctuations: Fluctuations,
    lmax: int,
) -> TemplateErrors | None:
    """Noise of the templates at the common resolution; None where there is none."""
    noises, names = inputs.template_noise, list(inputs.templates)
    own = [name for name, one in noises.items() if one.own]
    bands = [b for b in fluctuations.names if any(b in one.shared for one in noises.values())]
    if not own and not bands:
        return None
    preparations = [operators[f"template {name!r}"] for name in own]
    noise = [
        _without_holes(noises[name].noise, op, kept[f"template {name!r}"])
        for name, op in zip(own, preparations, strict=True)
    ]
    spectra = [
        prepared_spectrum(noises[name].correlated, op, lmax)
        for name, op in zip(own, preparations, strict=True)
    ]
    which = list(map(fluctuations.names.index, bands))
    sources = Fluctuations(
        (*preparations, *(fluctuations.preparations[b] for b in which)),
        (*noise, *(fluctuations.noise[b] for b in which)),
        (*spectra, *(fluctuations.correlated[b] for b in which)),
        None,
        None,
        jnp.ones(len(own) + len(bands)),
        (*own, *bands),
    )
    shared = [noises[n].shared if n in noises else {} for n in names]
    parts = [
        [float(n == name) for name in own] + [one.get(band, 0.0) for band in bands]
        for n, one in zip(names, shared, strict=True)
    ]
    of_band = [[0.0] * len(own) + [float(b == name) for b in bands] for name in fluctuations.names]
    variance = jnp.nan_to_num(sources.sigma() ** 2)
    covariance_of = _remembered(sources.covariance)
    return TemplateErrors(covariance_of, np.array(parts), np.array(of_band), variance)


def prepare_component(
    component: Component, preparation: Preparation, kept: Bool[np.ndarray, " pix"] | None = None
) -> Component:
    """A component with its amplitude, and parameters that are maps, at the common resolution.

    Parameters
    ----------
    component, preparation : what is prepared, and how
    kept : pixels of the amplitude that are not set to zero; default all
    """

    def brought(leaf):
        if leaf.ndim not in (1, 2):
            return leaf
        values = jnp.atleast_2d(jnp.asarray(leaf, float))
        if leaf.ndim == 2:
            values = values if kept is None else values * kept
        prepared = preparation(values).block_until_ready()
        return prepared if leaf.ndim == 2 else prepared[0]

    return jax.tree.map(brought, component)


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


def prepared_spectrum(
    spectrum: Float[Array, " ell"] | None, preparation: Preparation, lmax: int
) -> Float[Array, " ell"] | None:
    """Spectrum of a prepared map, from that before."""
    if spectrum is None:
        return None
    window = preparation.window
    if window is None:
        pixels = pixel_window(preparation.nside, lmax) / pixel_window(preparation.nside_in, lmax)
        window = jnp.asarray(pixels)
    return spectrum[: lmax + 1] * window[: lmax + 1] ** 2
