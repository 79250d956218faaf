"""Read and write maps, masks, bandpasses, beams and spectra, and convert quantities with units.

Inside the package there are only bare arrays (GHz, uK_RJ, K, arcmin; Galactic, RING, COSMO).
Everything else is converted and checked here, once. A file that cannot be used raises
`InputError`, one sentence with the file, the argument and the value.
"""

from jaxsky.io.bandpasses import read_bandpass
from jaxsky.io.curves import read_beam, read_spectra
from jaxsky.io.files import InputError, MissingFileError, check_file, whole, write_text
from jaxsky.io.maps import Maps, degrade_mask, read_maps, read_mask, write_maps
from jaxsky.io.quantities import from_quantity, unit_factor, unit_name
