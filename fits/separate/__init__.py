"""The command `jaxsky separate`: from settings to components, spectra and r."""
