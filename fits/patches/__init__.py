"""Power laws D_l = A (l/80)^(alpha + 2) of EE and BB on small patches of the sky."""

from fits.patches.fit import PatchFits, fit_patches
from fits.patches.prepare import EDGES, PreparedPatches, prepare_patches
