"""Experiment files: what they can say, with a sentence for each mistake."""

from jaxsky.settings.files import (
    BandpassSpec,
    FileName,
    Hits,
    MapFile,
    MapKeys,
    MaskFile,
    NamedFile,
    NoiseColumns,
    NoiseTable,
    SettingsError,
    SettingsFile,
    Table,
    expand,
)

__all__ = [
    "BandpassSpec",
    "FileName",
    "Hits",
    "MapFile",
    "MapKeys",
    "MaskFile",
    "NamedFile",
    "NoiseColumns",
    "NoiseTable",
    "SettingsError",
    "SettingsFile",
    "Table",
    "expand",
]
