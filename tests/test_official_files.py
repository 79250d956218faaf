"""Files in the structure of the archives' own, at small nside, through to an analysis."""

import healpy
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits as pyfits

from fits.common import common_maps
from fits.inputs import inputs_of
from jaxsky.experiment import leak
from jaxsky.harmonics import gaussian_beam, resample, synthesis
from jaxsky.io import InputError
from jaxsky.noise import weights_covariance
from jaxsky.settings import Experiment, SettingsError
from mapfiles import NSIDE, table, write

NPIX = 12 * NSIDE**2
SKY = "LFI_SkyMap_070_1024_R2.01_full.fits"
CORRECTION = "LFI_CorrMap_070-BPassCorr_0256_R2.01_full.fits"


def archived(columns, units, name, **header):
    """A table as the archives write it; columns given in RING."""
    return table(columns, units, name, **{"ORDERING": "NESTED", "COORDSYS": "GALACTIC"} | header)


def smooth_maps(seed, nside, fwhm, lmax=16):
    """Q and U of a beam, without structure above lmax."""
    alm = np.random.default_rng(seed).normal(size=(2, (lmax + 1) ** 2))
    first = synthesis(jnp.asarray(alm), nside)
    return np.asarray(resample(first, gaussian_beam(fwhm, lmax), nside))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("archive")
    rng = np.random.default_rng(1)
    # WMAP, nine years: maps and N_OBS, then weights, mK that only Q and U make definite.
    Q, U = rng.normal(size=(2, NPIX))
    hits = rng.integers(100, 900, NPIX).astype(float)
    QQ, UU = 0.5 * hits * (1 + 0.1 * rng.random((2, NPIX)))
    QU = 0.2 * hits * rng.uniform(-1, 1, NPIX)
    QQ[5] = QU[5] = UU[5] = 0.0  # never seen
    maps = {"TEMPERATURE": Q, "Q_POLARISATION": Q, "U_POLARISATION": U, "N_OBS": hits}
    weights = {"N_OBS": hits, "QQ": QQ, "QU": QU, "UU": UU}
    thermodynamic = ["mK,thermodynamic"] * 2
    wmap = {"COORDSYS": None}
    write(
        folder / "wmap_band_iqumap_r9_9yr_K_v5.fits",
        archived(maps, ["mK", *thermodynamic, "counts"], "Stokes Maps", **wmap),
        archived(weights, ["counts"] * 4, "Weight Arrays", **wmap),
    )
    # Planck LFI: the map at one resolution and beam, the correction at another.
    true = smooth_maps(2, 2 * NSIDE, 0.0)
    leaked = smooth_maps(3, 2 * NSIDE, 0.0)
    seen = 1e-6 * np.asarray(resample(true + leaked, gaussian_beam(500.0, 24), 2 * NSIDE))
    columns = dict(zip(["I_STOKES", "Q_STOKES", "U_STOKES"], [seen[0], *seen], strict=True))
    covariance = dict.fromkeys(["QQ_COV", "UU_COV"], np.full(4 * NPIX, 1e-12))
    covariance["QU_COV"] = np.zeros(4 * NPIX)
    units = ["K_CMB"] * 3 + ["(K_CMB)^2"] * 3
    write(folder / SKY, archived(columns | covariance, units, "FREQ-MAP"))
    coarse = 1e-6 * np.asarray(resample(leaked, gaussian_beam(700.0, 16), NSIDE))
    corrections = dict(zip(["Q_STOKES", "U_STOKES"], coarse, strict=True))
    write(folder / CORRECTION, archived(corrections, ["K_CMB"] * 2, "CORR-MAP"))
    without = {"Q_STOKES": coarse[0]}
    write(folder / "LFI_CorrMap_070_R2.01.fits", archived(without, ["K_CMB"], "CORR-MAP"))
    # Commander's dust, in the unit that the archive calls uK_RJ.
    dust = smooth_maps(4, 2 * NSIDE, 0.0)
    ml = dict(zip(["Q_ML_FULL", "U_ML_FULL"], dust, strict=True))
    write(
        folder / "COM_CompMap_DustPol-commander_1024_R2.00.fits",
        archived(ml, ["uK_RJ"] * 2, "DUST"),
    )
    return folder


DUST = {
    "law": "dust",
    "file": "COM_CompMap_DustPol-commander_1024_R2.00.fits",
    "fields": ["Q_ML_FULL", "U_ML_FULL"],
    "nu_ref": 353.0,
}
PLANCK = {
    "name": "70",
    "file": SKY,
    "fields": ["Q_STOKES", "U_STOKES"],
    "fwhm": 500.0,
    "bandpass": {"center": 70.0},
    "noise": {"covariance": ["QQ_COV", "QU_COV", "UU_COV"]},
}
LEAKAGE = {"file": CORRECTION, "fields": ["Q_STOKES", "U_STOKES"], "fwhm": 700.0}


def settings(folder, band):
    return Experiment.model_validate(
        {"data_dir": str(folder), "sky": {"dust": DUST}, "bands": [band], "cmb": {"include": False}}
    )


def test_wmaps_weights_are_the_inverse_covariance(folder):
    band = {
        "name": "K",
        "file": "wmap_band_iqumap_r9_9yr_K_v5.fits",
        "fields": ["Q_POLARISATION", "U_POLARISATION"],
        "coordinates": "G",
        "bandpass": {"center": 23.0},
        "noise": {"weights": {"fields": ["QQ", "QU", "UU"], "hdu": 2, "sigma0": 1.435}},
    }
    found = inputs_of(settings(folder, band)).bands["K"]
    factor = float(found.bandpass.conversion("mK_CMB", "uK_RJ"))
    assert (~found.used).sum() == 1
    with pyfits.open(folder / band["file"]) as hdus:
        ring = healpy.ring2nest(NSIDE, np.arange(NPIX))
        QQ, QU, UU = (hdus[2].data[name][ring].astype(float) for name in ("QQ", "QU", "UU"))
        Q = hdus[1].data["Q_POLARISATION"][ring]
    np.testing.assert_allclose(found.maps[0, found.used], factor * Q[found.used], rtol=1e-6)
    matrices = np.array([[QQ, QU], [QU, UU]])[..., found.used]
    product = np.einsum("ijp,jkp->ikp", matrices, found.noise[..., found.used])
    expected = np.eye(2)[..., None] * (1.435 * factor) ** 2 * np.ones(found.used.sum())
    np.testing.assert_allclose(product, expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_weights_have_their_sigma0s():
    weights = np.array([[4.0, 2.0], [0.0, 1.0], [9.0, 3.0]])
    found = weights_covariance([2.0, 3.0], weights)
    np.testing.assert_allclose(found[..., 0], [[1.0, 0.0], [0.0, 1.0]])
    np.testing.assert_allclose(found[..., 1], np.array([[4 * 3, -6], [-6, 9 * 2]]) / 5)
    with pytest.raises(ValueError, match=r"`sigma0` must be a number or have shape \(2,\)"):
        weights_covariance([1.0, 1.0, 1.0], weights)
    with pytest.raises(ValueError, match=r"`weights` must have shape \(3, pix\)"):
        weights_covariance(1.0, weights[:2])


def test_leakage_is_subtracted_at_the_common_resolution(folder):
    """The correction has its own nside and beam, and what is left is the sky that did not leak."""
    inputs = inputs_of(settings(folder, PLANCK | {"leakage": LEAKAGE}))
    factor = float(inputs.bands["70"].bandpass.conversion("uK_CMB", "uK_RJ"))
    prepared = common_maps(inputs, NSIDE, 800.0)
    alone = resample(smooth_maps(2, 2 * NSIDE, 0.0), gaussian_beam(800.0, 16), NSIDE)
    # Single precision of the files, and l > 16 of what the pixels alias.
    np.testing.assert_allclose(prepared.data[0], factor * alone, atol=1e-4 * factor)
    assert float(jnp.abs(prepared.leakage["70"]).max()) > 0.1 * factor
    # Without it the map is as it was, but for the last multipoles, to which the coarser limits it.
    before = common_maps(inputs_of(settings(folder, PLANCK)), NSIDE, 800.0)
    assert not before.leakage
    np.testing.assert_allclose(
        before.data[0], prepared.data[0] + prepared.leakage["70"], atol=1e-5 * factor
    )


def test_intensity_leaks_along_the_meridians_of_the_ecliptic():
    intensity = jnp.asarray(np.random.default_rng(0).random(NPIX))
    found = np.asarray(leak(intensity))
    np.testing.assert_allclose(np.hypot(*found), intensity, rtol=1e-12)
    # In ecliptic coordinates all is Q > 0: Q and U turn with the frame as healpy has it.
    theta, phi = healpy.pix2ang(NSIDE, np.arange(NPIX))
    turn = np.exp(2j * healpy.Rotator(coord=["G", "E"]).angle_ref(theta, phi))
    turned = (found[0] + 1j * found[1]) * turn
    np.testing.assert_allclose(turned, np.asarray(intensity), atol=1e-9)


def test_corrections_of_another_release_are_refused(folder):
    corrected = "LFI_SkyMap_070-BPassCorrected_1024_R3.00_full.fits"
    for file, leakage, words in (
        (SKY, CORRECTION.replace("R2.01", "R3.00"), "is of release 3, but the map .* of release 2"),
        (corrected, CORRECTION, r"leakage is subtracted from LFI_SkyMap_070-BPassCorrected\S+ alr"),
    ):
        with pytest.raises(ValueError, match=words):
            settings(folder, PLANCK | {"file": file, "leakage": LEAKAGE | {"file": leakage}})


def test_a_correction_without_its_columns_is_named(folder):
    band = PLANCK | {"leakage": LEAKAGE | {"file": "LFI_CorrMap_070_R2.01.fits"}}
    with pytest.raises(InputError, match=r"LFI_CorrMap_070_R2.01.fits.*U_STOKES.*Q_STOKES"):
        inputs_of(settings(folder, band))
    band = PLANCK | {"leakage": LEAKAGE | {"file": "LFI_CorrMap_070_R2.01.fits", "fields": None}}
    with pytest.raises(SettingsError, match=r"bands.70.leakage: fields must name Q and U"):
        inputs_of(settings(folder, band))
