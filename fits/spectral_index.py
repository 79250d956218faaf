"""The paper's spectral-index test: templates scaled to other bands, compared with maps there.

Templates and data are brought to a common resolution; the parameters are then fitted in each
region, to Q, to U and to both, on a grid, by gradient and by MCMC.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import healpy
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Bool, Float

from fits.covariance import Fluctuations
from fits.grid import grid_fit, grid_is_possible
from fits.inputs import Inputs
from fits.likelihood import Likelihood, chi2, likelihood
from fits.optimize import best_fit
from fits.preparation import Preparation, prepare_component
from fits.results import FitResult
from fits.sample import ChainFile, sample
from fits.settings import Settings, known_regions
from jaxsky import Bandpass, Sky
from jaxsky.harmonics import gaussian_beam, pixel_window
from jaxsky.io import degrade_mask, read_mask
from jaxsky.settings import SettingsError
from jaxsky.types import Numeric

__all__ = ["Fit", "Prepared", "prepare", "region_masks", "run"]

#: A pixel is used if no more than this fraction of what was smoothed or averaged was missing.
MISSING = 0.01


class Prepared(NamedTuple):
    """Templates and maps at the common resolution."""

    sky: Sky
    bands: dict[str, Bandpass]
    data: Float[Array, "band stokes pix"]
    sigma: Float[Array, "band stokes pix"]
    used: Bool[np.ndarray, " pix"]
    fluctuations: Fluctuations

    def likelihood(
        self,
        start: Mapping[str, Numeric],
        *,
        stokes: str = "QU",
        region: Bool[np.ndarray, " pix"] | None = None,
        kind: str = "exact",
    ) -> Likelihood:
        """The likelihood of the parameters in `start`; see `fits.likelihood.likelihood`.

        Parameters
        ----------
        start : free parameters by name
        stokes : "Q", "U" or "QU"
        region : pixels to use, of those that can be; default all
        kind : "exact", or "diagonal" for the paper's sum over pixels

        Raises
        ------
        KeyError, ValueError
            For unknown parameters, a region without pixels or an unknown kind.
        """
        if kind not in ("exact", "diagonal"):
            raise ValueError(f"Argument `kind` must be 'exact' or 'diagonal', not {kind!r}.")
        used = self.used if region is None else self.used & region
        return likelihood(
            self.sky,
            self.bands,
            self.data,
            jnp.where(used, self.sigma, jnp.inf),
            start,
            stokes=stokes,
            covariance_of=self.fluctuations.covariance if kind == "exact" else None,
        )


class Fit(NamedTuple):
    """The fits of one region and choice of Stokes parameters, by method.

    `chi2` is the paper's sum over pixels at the best fit of each method, with `dof` degrees of
    freedom; `chi2_amplitudes` and `dof_amplitudes` are those of the exact likelihood, which
    compares the amplitudes of the templates only.
    """

    region: str
    stokes: str
    results: dict[str, FitResult]
    chi2: dict[str, float]
    dof: int
    dof_amplitudes: int | None

    def probability_to_exceed(self, method: str) -> float | None:
        """Probability of a larger chi^2 of the amplitudes; None for the diagonal likelihood."""
        if not self.dof_amplitudes:
            return None
        return float(scipy.stats.chi2.sf(self.results[method].chi2, self.dof_amplitudes))


def all_free(fits: Sequence[Fit]) -> tuple[str, ...]:
    """Names of the parameters that are free in any of the fits."""
    return tuple(sorted({name for f in fits for r in f.results.values() for name in r.free}))


def prepare(inputs: Inputs, nside: int, fwhm: float) -> Prepared:
    """Bring templates and maps to a common nside and, if fwhm > 0, a common beam.

    With fwhm = 0 pixels are averaged and beams stay as they are. Otherwise all maps are cut at
    one multipole, that to which the coarsest is good.

    Parameters
    ----------
    inputs : templates and maps
    nside, fwhm : common resolution; fwhm in arcmin

    Raises
    ------
    ValueError
        If a map is coarser than the common resolution.
    """
    maps = {f"template {name!r}": (t.used, t.fwhm) for name, t in inputs.templates.items()}
    maps |= {f"band {name!r}": (b.used, b.fwhm) for name, b in inputs.bands.items()}
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
    sky = Sky(
        {
            name: prepare_component(
                template.component,
                operators[f"template {name!r}"],
                holes.get(nsides[f"template {name!r}"]),
            )
            for name, template in inputs.templates.items()
        }
    )
    preparations = tuple(operators[f"band {name!r}"] for name in inputs.bands)
    whole = [holes.get(op.nside_in, np.ones(1, bool)) for op in preparations]
    data = jnp.stack(
        [
            op(band.maps * kept)
            for op, band, kept in zip(preparations, inputs.bands.values(), whole, strict=True)
        ]
    )
    bandpasses = {name: band.bandpass for name, band in inputs.bands.items()}
    factors = jnp.stack([b.conversion("uK_CMB", "uK_RJ") for b in bandpasses.values()])
    spectra = windows = None
    if not fwhm:  # averaged pixels hold multipoles beyond those they resolve
        lmax = 4 * nside
    if inputs.cmb is not None:
        beams = [fwhm or band.fwhm for band in inputs.bands.values()]
        windows = jnp.stack([gaussian_beam(beam, lmax) for beam in beams])
        if not fwhm:
            windows = windows * pixel_window(nside, lmax)
        spectra = jnp.asarray(inputs.cmb)[1:3, : lmax + 1]
    noise = tuple(
        band.noise * kept for band, kept in zip(inputs.bands.values(), whole, strict=True)
    )
    correlated = tuple(
        _prepared_spectrum(band.correlated, op, lmax)
        for op, band in zip(preparations, inputs.bands.values(), strict=True)
    )
    fluctuations = Fluctuations(preparations, noise, correlated, spectra, windows, factors)
    sigma = fluctuations.sigma()
    known = np.asarray(jnp.isfinite(sigma).all(axis=(0, 1)))
    return Prepared(
        sky, bandpasses, data, jnp.where(known, sigma, jnp.inf), used & known, fluctuations
    )


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


def region_masks(settings: Settings) -> dict[str, Bool[np.ndarray, " pix"]]:
    """Pixels of each region at the common nside.

    Raises
    ------
    SettingsError, jaxsky.io.InputError
        For a region that is neither known nor a readable mask.
    """
    analysis, folder = settings.analysis, Path(settings.data_dir)
    npix = healpy.nside2npix(analysis.nside)
    latitude = healpy.pix2ang(analysis.nside, np.arange(npix), lonlat=True)[1]
    common = np.ones(npix, bool)
    if analysis.mask is not None:
        mask = analysis.mask
        path = folder / mask.file
        common = degrade_mask(read_mask(path, key=mask.key, ordering=mask.ordering), analysis.nside)
    regions = {}
    for name in analysis.regions:
        if name == "strip":
            region = np.abs(latitude) <= analysis.latitude
        elif name == "outside":
            region = np.abs(latitude) > analysis.latitude
        elif name == "full":
            region = np.ones(npix, bool)
        elif (folder / name).is_file():
            region = degrade_mask(read_mask(folder / name), analysis.nside)
        else:
            raise SettingsError(
                f"analysis.regions: {name!r} is neither {', '.join(known_regions())} nor a file "
                f"in {folder}."
            )
        label = name if name in known_regions() else Path(name).stem
        if label in regions:
            raise SettingsError(f"analysis.regions: two regions are called {label!r}.")
        regions[label] = np.asarray(region & common)
    return regions


def _fingerprint(like: Likelihood) -> str:
    """A hash of everything that the likelihood depends on."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(like):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def _chain(path: Path, name: str, like: Likelihood, settings: Settings, free: int) -> ChainFile:
    """The chain's place in its file; a chain of other data or settings is refused."""
    if path.exists() and not h5py.is_hdf5(path):
        raise SettingsError(f"{path}: is damaged; start again with --overwrite.")
    backend = ChainFile(path, name)
    size = (settings.mcmc.nwalkers, free)
    mark = f"{_fingerprint(like)} {settings.free} {settings.analysis.seed} {size}"
    if not backend.initialized:
        backend.reset(*size)
        with backend.open("a") as file:
            file[name].attrs["fingerprint"] = mark
        return backend
    with backend.open() as file:
        if file[name].attrs.get("fingerprint") != mark:
            raise SettingsError(
                f"{path}: holds a chain of other data or settings; choose another --out, or "
                "start again with --overwrite."
            )
    return backend


def fit_pixels(
    settings: Settings,
    prepared: Prepared,
    used: Bool[np.ndarray, " pix"],
    region: str,
    stokes: str,
    chains: Path | None = None,
    report: Callable[[str], None] = lambda message: None,
    progress: bool = False,
) -> Fit:
    """The fits of one region and choice of Stokes parameters; see `run`."""
    # An offset of a Stokes parameter that is not looked at has no effect.
    other = tuple(s for s in "QU" if s not in stokes)
    start = {
        name: value
        for name, value in settings.start().items()
        if not (name.startswith("offset.") and name.endswith(other))
    }
    priors = {name: prior for name, prior in settings.priors().items() if name in start}
    report(f"{region}, {stokes}: inner products")
    diagonal = prepared.likelihood(start, stokes=stokes, region=used, kind="diagonal")
    like, dof_amplitudes = diagonal, None
    if settings.analysis.likelihood == "exact":
        like = prepared.likelihood(start, stokes=stokes, region=used)
        dof_amplitudes = like.residuals(start).size - len(start)
    results: dict[str, FitResult] = {}
    for method in settings.analysis.methods:
        report(f"{region}, {stokes}: {method}")
        if method == "grid" and not grid_is_possible(start, priors):
            continue
        if method == "grid":
            results[method] = grid_fit(like, start, priors=priors, points=settings.grid.points)
        elif method == "gradient":
            results[method] = best_fit(like, start, priors=priors, throw=False)
        else:
            chain = None
            if chains is not None:
                chain = _chain(chains, f"{region}_{stokes}", like, settings, len(start))
            results[method] = sample(
                like,
                start,
                priors=priors,
                nwalkers=settings.mcmc.nwalkers,
                nsteps=settings.mcmc.nsteps,
                seed=settings.analysis.seed,
                backend=chain,
                progress=progress,
                throw=False,
            )
    if not results:
        raise SettingsError(
            "analysis.methods: a grid alone takes one or two free parameters with uniform priors."
        )
    values = {method: float(chi2(diagonal, r.best_fit)) for method, r in results.items()}
    dof = int(used.sum()) * len(prepared.bands) * len(stokes) - len(start)
    return Fit(region, stokes, results, values, dof, dof_amplitudes)


def run(
    settings: Settings,
    prepared: Prepared,
    regions: dict[str, Bool[np.ndarray, " pix"]],
    chains: Path | None = None,
    report: Callable[[str], None] = lambda message: None,
    progress: bool = False,
) -> list[Fit]:
    """All fits that the settings ask for.

    Parameters
    ----------
    settings : what to fit, and how
    prepared : templates and maps at the common resolution
    regions : pixels of each region by name
    chains : file of the chains; steps that it already holds are not made again
    report : called with a line before each step of the work
    progress : show a progress bar for chains

    Raises
    ------
    KeyError, ValueError
        For parameters that do not exist, regions without pixels, or what a method cannot do.
    """
    used = {region: inside & prepared.used for region, inside in regions.items()}
    for region, pixels in used.items():
        if not pixels.any():
            raise SettingsError(f"analysis.regions: region {region!r} leaves no pixel.")
    return [
        fit_pixels(settings, prepared, pixels, region, stokes, chains, report, progress)
        for region, pixels in used.items()
        for stokes in settings.analysis.stokes
    ]
