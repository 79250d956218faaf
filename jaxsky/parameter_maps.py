"""Maps of spectral parameters, checked for what they are: one column, unit, sign, resolution."""

import numpy as np
from jaxtyping import Bool, Float

from jaxsky.components import parameter_declaration
from jaxsky.io import Maps, unit_factor
from jaxsky.io.missing import sentinels
from jaxsky.settings.files import SettingsError
from jaxsky.settings.values import check_sign


def parameter_unit(name: str) -> str:
    """Unit of a spectral parameter by its name, dotted or not; "" for a pure number."""
    return parameter_declaration(name.split(".")[-1]).get("unit", "")


def parameter_map(
    found: Maps,
    name: str,
    nside: int,
    where: str,
    *,
    of: str = "that of the template",
    stated: bool = False,
) -> tuple[Float[np.ndarray, " pix"], Bool[np.ndarray, " pix"]]:
    """The map of a spectral parameter, and where it is known.

    Parameters
    ----------
    found : what was read
    name : of the parameter
    nside : resolution that it must have
    where : key in the settings, for the messages
    of : whose nside that is
    stated : the settings say which values are missing, so zeros are data

    Returns
    -------
    Values in the parameter's unit, in pixels without one the median of the others, and a mask,
    True where they are known; both of shape (pix,).
    """
    values, used = one_column(found, nside, where, of), np.asarray(found.mask)
    unit = parameter_unit(name)
    if found.unit != unit:
        try:
            values = values * float(unit_factor(found.unit, unit))
        except ValueError:
            raise SettingsError(
                f"{where}: {name} is {f'in {unit}' if unit else 'a pure number'}, but column "
                f"{found.names[0]} is in {found.unit or 'no unit'}."
            ) from None
    known = values[used]
    zero = parameter_declaration(name).get("zero", True)
    marks = [] if stated or zero else sentinels(known, zero=True)
    if marks:
        raise SettingsError(
            f"{where}: column {found.names[0]} is {marks[0][0]:g} in {marks[0][1]} pixels, far "
            "from its other values; give `missing`, the numbers that mark pixels without a value, "
            "or `missing = []` if all are data."
        )
    try:
        check_sign(name, float(np.median(known)))
    except ValueError as error:
        raise SettingsError(f"{where}: {error}.") from None
    return np.where(used, values, np.median(known)), used


def one_column(found: Maps, nside: int, where: str, of: str) -> Float[np.ndarray, " pix"]:
    """The one column that was read, of the resolution that it must have."""
    if len(found.maps) != 1:
        raise SettingsError(f"{where}: fields must name one column, not {', '.join(found.names)}.")
    if found.nside != nside:
        raise SettingsError(f"{where}: nside is {found.nside}, but {of} is {nside}.")
    return np.asarray(found.maps[0])
