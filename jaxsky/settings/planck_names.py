"""What the names of Planck's maps say: release, and leakage of intensity into Q and U."""

import re
from collections.abc import Sequence
from pathlib import Path

#: Release and correction in the names of Planck's files.
_RELEASE = re.compile(r"_R(\d)\.\d\d")
#: Maps of LFI's second and third release, and of HFI's second, that are as they were observed: of
#: the whole mission, years, surveys and half rings, whole or compressed.
_LEAKY = re.compile(
    r"(LFI_SkyMap_0\d\d|HFI_SkyMap_(?:100|143|217|353)(?=.*_R2))(.*_R[23]\.\d\d.*)", re.IGNORECASE
)


def _without_leakage(name: str) -> str | None:
    """What to take in place of a map that holds leakage, or None if it is not known to."""
    match = _LEAKY.fullmatch(name)
    if match is None or "bpasscorr" in name.lower():
        return None
    start, rest = match.groups()
    if start.upper().startswith("HFI"):  # corrected as it was mapped since the third release
        return f"Take {start}_2048_R3.01_full.fits"
    corrected, beam = f"{start}-BPassCorrected{rest}", "fwhm = ..."
    channel = start.rsplit("_", 1)[1]
    correction = f"LFI_CorrMap_{channel}-BPassCorr{rest.replace('-field-IQU', '')}"
    if "_R2." in rest.upper():  # corrected at nside 256 and 1 degree only
        corrected, beam = f"{start}-BPassCorrected_1024_R3.00_full.fits", "fwhm = 60.0"
        correction = f"LFI_CorrMap_{channel}-BPassCorr_0256_R2.01_full.fits"
    return f'Take {corrected}, or subtract it: leakage = {{ file = "{correction}", {beam} }}'


def leak(name: str, files: Sequence[str]) -> str | None:
    """A warning if the map of a band is known by its files to hold leakage."""
    found = [Path(file).name for file in files]
    advice = {file: words for file in found if (words := _without_leakage(file)) is not None}
    if not advice:
        return None
    file, words = next(iter(advice.items()))
    return (
        f"bands.{name}: {file} holds intensity that has leaked into Q and U through the "
        "bandpasses, and nothing is subtracted; indices fitted to it may be wrong by many sigma. "
        f"{words}."
    )


def check_release(files: Sequence[str], leakage: Sequence[str], map_label: str, label: str) -> None:
    """Raise ValueError if leakage is of another release than the map, or subtracted already."""
    for file in files:
        if "BPassCorrected" in file:
            raise ValueError(f"leakage is subtracted from {file} already")
    releases = [_RELEASE.search(file) for file in (*files, *leakage)]
    found = [release[1] for release in releases if release]
    if len(set(found)) > 1:
        raise ValueError(
            f"leakage {label} is of release {found[-1]}, but the map {map_label} of release "
            f"{found[0]}"
        )
