"""HEALPix tables as archives and other codes write them, and a sky in two frames of coordinates."""

import healpy
import numpy as np
from astropy.io import fits as pyfits

NSIDE = 8


def save(path, columns, units=None, formats=None, before=(), **header):
    """Columns as they are given, with a unit for all or by name; None leaves a keyword out."""
    units = units if isinstance(units, dict) else dict.fromkeys(columns, units)
    formats = dict.fromkeys(columns, "D") | (formats or {})
    table = pyfits.BinTableHDU.from_columns(
        [
            pyfits.Column(name=name, format=formats[name], array=values, unit=units.get(name))
            for name, values in columns.items()
        ]
    )
    keys = {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": NSIDE, "COORDSYS": "G"} | header
    table.header.update({key: value for key, value in keys.items() if value is not None})
    pyfits.HDUList([pyfits.PrimaryHDU(), *before, table]).writeto(path, overwrite=True)
    return path


def table(columns, units, name="MAP", form="E", **header):
    """A table with columns given in RING, as they are in the file's ordering."""
    nside = healpy.npix2nside(len(next(iter(columns.values()))))
    order = np.arange(12 * nside**2)
    if header.get("ORDERING") == "NESTED":
        order = healpy.nest2ring(nside, order)
    made = [
        pyfits.Column(n, form, unit=unit, array=np.asarray(c)[order])
        for (n, c), unit in zip(columns.items(), units, strict=True)
    ]
    hdu = pyfits.BinTableHDU.from_columns(made, name=name)
    keys = {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": nside, "COORDSYS": "G"} | header
    hdu.header.update({k: v for k, v in keys.items() if v is not None})
    return hdu


def write(path, *tables):
    pyfits.HDUList([pyfits.PrimaryHDU(), *tables]).writeto(path, overwrite=True)
    return path


def sky(nside, frame, lmax=16):
    """I, Q, U without structure above lmax, in a frame of coordinates and in Galactic ones."""
    rng = np.random.default_rng(3)
    ell, m = healpy.Alm.getlm(lmax)
    alm = rng.normal(size=(2, 3, ell.size)) / (1 + ell)
    alm = alm[0] + 1j * np.where(m > 0, alm[1], 0)
    alm[1:, ell < 2] = 0
    turned = healpy.Rotator(coord=[frame, "G"]).rotate_alm(alm)
    return healpy.alm2map(alm, nside), healpy.alm2map(turned, nside)
