"""Component separation of full-sky maps in multipoles, with a beam for each band.

With b_l the beam and N_l the noise of a band, its coefficients without the beam are

    d_lm / b_l = A s_lm + n_lm / b_l,    of noise N_l / b_l^2

(Tegmark & Efstathiou 1996, MNRAS 281, 1297), the same for all m. So a multipole is what a region
with uniform noise is among pixels: its 2l + 1 coefficients enter the spectral likelihood only
through their covariance of bands, and as many vectors as there are bands take their place,
exactly. Nothing is smoothed, so each band keeps the resolution it has. A rotation of Q + iU by
the angle of a band turns E + iB in the same way.
"""

from fits.multipoles import harmonic_coefficients, white_spectrum
from fits.separation.harmonic.likelihood import harmonic_likelihood
from fits.separation.harmonic.maps import HarmonicMaps, harmonic_component_maps
