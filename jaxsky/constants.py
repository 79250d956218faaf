"""Physical constants in the package's own units (GHz, K, MJy/sr)."""

from typing import Final

#: h/k [K/GHz], CODATA 2018 (both exact in the SI).
H_OVER_K: Final = 6.62607015e-34 / 1.380649e-23 * 1e9

#: CMB temperature [K], Fixsen (2009), the value of the paper. `astropy` has 2.7255.
T_CMB: Final = 2.72548

#: Brightness of 1 K_RJ at 1 GHz, 2 k nu^2 / c^2 [MJy/sr].
MJYSR_PER_K_RJ_AT_1GHZ: Final = 2 * 1.380649e-23 * 1e18 / 299792458.0**2 * 1e20
