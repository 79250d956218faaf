"""Component separation with parametric laws: spectra first, then maps of the components."""

from importlib import import_module
from typing import Any

#: name -> module that has it; imported when it is asked for
_WHERE = {
    "fits.separation.fit": ("fisher", "fit_spectra", "hessian"),
    "fits.multipoles": (
        "harmonic_coefficients",
        "harmonic_likelihood",
        "white_spectrum",
    ),
    "fits.profile_likelihood": ("SpectralLikelihood", "spectral_likelihood"),
    "fits.separated_maps": (
        "ComponentMaps",
        "HarmonicMaps",
        "component_maps",
        "harmonic_component_maps",
        "noise_degradation",
        "residual_maps",
    ),
    "fits.noise": ("Noise", "as_noise"),
    "fits.regions": ("clusters", "latitude_bands", "superpixels"),
    "fits.separation.results": ("SpectralFit",),
    "fits.separation.sample": ("sample_spectra",),
}


def __getattr__(name: str) -> Any:
    for module, names in _WHERE.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
