"""Presets of PySM: from jaxsky's table to arguments of the models."""

from collections.abc import Mapping
from typing import Any

from jaxsky.public import packaged
from jaxsky.pysm.models import MODELS, LawModel, ModifiedBlackBodyLayers


def preset_settings(name: str) -> dict[str, Any]:
    """Return a preset as settings in PySM's format, a table or one for each part.

    KeyError if there is no such preset, ValueError if jaxsky does not have it.
    """
    presets = packaged("presets.toml")
    refused = presets["refused"]
    if name in refused:
        raise ValueError(f"Preset {name!r} is not in jaxsky: it {refused[name]}.")
    if name not in pysm_presets():
        raise KeyError(f"Unknown preset {name!r}; known are {', '.join(pysm_presets())}.")
    entry = presets[name]
    if _single(entry):
        return _settings(entry)
    return {part: _settings(own) for part, own in entry.items()}


def _single(entry: Mapping[str, Any]) -> bool:
    """Return whether an entry of the table is one model of PySM, not several."""
    return "model" in entry or "files" in entry


def pysm_presets() -> list[str]:
    """Return the names of the presets that there are."""

    def made(entry: Mapping[str, Any]) -> bool:
        parts = [own for own in entry.values() if isinstance(own, dict)]
        return _single(entry) or (bool(parts) and all(map(_single, parts)))

    return [name for name, entry in packaged("presets.toml").items() if made(entry)]


def _settings(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of one model."""
    if "model" in entry:
        return {"class": entry["model"]} | {k: v for k, v in entry.items() if k != "model"}
    own = {key: value for key, value in entry.items() if key not in ("law", "maps", "files")}
    own |= entry["files"]
    own = {"beta_syn" if key == "pysm_beta" else key: value for key, value in own.items()}
    kind = _kind(entry["law"], own)
    words = {ours: theirs for theirs, ours in kind.words.items()}
    units = {"nu_piv": " GHz"}
    found = {
        words[key]: f"{value}{units[key]}" if key in units else value
        for key, value in own.items()
        if key in words
    }
    found |= {"class": kind.__name__, "available_nside": own.get("nsides")}
    nu_ref, unit = f"{own['nu_ref']} GHz", own.get("unit")
    if "layers" in own:
        named = {"map_layers": own["amplitude"], "unit_layers": unit, "num_layers": own["layers"]}
        return found | named | {"color_correction": own["factor"], "freq_ref": nu_ref}
    maps = own["amplitude"] if isinstance(own["amplitude"], list) else [own["amplitude"]]
    for row, file in zip("IQU", maps, strict=False):
        found |= {f"map_{row}": file, f"unit_{row}": unit}
    nu_ref_I = f"{own['nu_ref_I']} GHz" if "nu_ref_I" in own else nu_ref
    found |= {"freq_ref_I": nu_ref_I, "freq_ref_P": nu_ref}
    return found | {"has_polarization": own.get("polarized", True)}


def _kind(law: str, own: Mapping[str, Any]) -> type[LawModel]:
    """Return the class with a law that takes most of what is given."""
    if "layers" in own:
        return ModifiedBlackBodyLayers
    fitting = [one for one in MODELS.values() if issubclass(one, LawModel) and one.law == law]
    fitting = [one for one in fitting if set(one.words.values()) <= {*own}]
    return max(fitting, key=lambda one: len(one.words))
