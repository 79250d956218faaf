"""Values of the settings of every command, replaced by values that they cannot have."""

import pytest

from settings_fuzz import KINDS, faults


@pytest.mark.parametrize("kind", KINDS)
def test_settings_work_or_are_refused_with_file_and_key(tmp_path, kind):
    assert faults(kind, tmp_path / "settings.toml", every=11) == []
