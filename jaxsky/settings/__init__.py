"""The experiment file: its tables, error messages, and the files that it names."""

from jaxsky.settings.experiment import CommonTable, Experiment, RadioIndexMap, parse_region
from jaxsky.settings.files import BeamedMap, MapFile, MapKeys, NoiseColumns, NoiseTable, SeenKeys
from jaxsky.settings.tables import BandTable, ComponentTable, RegionsTable, SmallScalesTable
from jaxsky.settings.toml import (
    at_key,
    changed_settings,
    check_log,
    circumstances,
    find_file,
    load,
    named_files,
    of_file,
)
from jaxsky.settings.types import WORDS, SettingsError, check_signs
