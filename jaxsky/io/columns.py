"""Columns of HEALPix files: what their names say for certain, and what an argument says.

Only names on this list say which Stokes parameter a column holds. They are those of Planck, WMAP,
healpy, the HEALPix libraries, PySM and this package; where a column stands says nothing.
"""

import re
from collections.abc import Sequence
from itertools import product

from jaxsky.io.tables import PIXELS, InputError

_LETTERS = {"I": "I", "T": "I", "Q": "Q", "U": "U"}
_RUNS = ("FULL", "HM1", "HM2", "HR1", "HR2", "YR1", "YR2", "Y1", "Y2")
_OF_ONE = (
    *("STOKES", "STOKES_INP", "POLARISATION", "POLARIZATION", "ML", "MEAN"),
    *(f"{word}_{run}" for word, run in product(("ML", "MEAN", "STOKES"), _RUNS)),
)
_SPREADS = ("RMS", "STD", "STDDEV", "SIGMA", "ERR", "ERROR", "COV", "VAR", "VARIANCE")
_OF_TWO = ("COV", "COVAR", "COVARIANCE", "VAR", "VARIANCE", "INVCOV", "WEIGHT", "WEIGHTS")
_SCALARS = (
    *("HITS", "HIT", "N_OBS", "NOBS", "N_HITS", "NHITS", "HITMAP", "MASK", "LABEL"),
    *("BETA", "BETA_D", "BETA_S", "BETA_DUST", "BETA_SYN", "BETA_ML", "BETA_MEAN"),
    *("T_D", "T_DUST", "TEMP_ML", "TEMP_MEAN", "CURVATURE", "NU_PIV"),
)


def _known() -> dict[str, str]:
    """Names that are certain -> one Stokes parameter, two of a covariance, or "" for neither."""
    names = dict.fromkeys(("TEMPERATURE", "INTENSITY", "I_MAP", "T_MAP"), "I")
    for letter, one in _LETTERS.items():
        names |= {letter: one, f"STOKES_{letter}": one}
        names |= {f"{letter}_{word}": one for word in _OF_ONE}
        # The spread of a Stokes parameter has no sign: it goes with the variance.
        names |= {f"{letter}_{word}": one * 2 for word in _SPREADS}
        names |= {f"{word}_{letter}": one * 2 for word in _SPREADS}
    for (a, first), (b, second) in product(_LETTERS.items(), repeat=2):
        pair = "".join(sorted(first + second, key="IQU".index))
        names[a + b] = pair
        for word in _OF_TWO:
            forms = (f"{a}{b}_{word}", f"{word}_{a}{b}", f"{a}{b}{word}", f"{word}{a}{b}")
            names |= dict.fromkeys((*forms, f"{word}_{a}_{b}", f"{a}_{b}_{word}"), pair)
    return names | dict.fromkeys((*_SCALARS, *PIXELS), "")


_KNOWN = _known()
#: What `stokes` takes for one column.
_CHOICES = ("", "I", "Q", "U", "II", "IQ", "IU", "QQ", "QU", "UU")


def stokes(name: str) -> str | None:
    """Stokes parameter of a column as far as its name is certain.

    Returns
    -------
    "I", "Q" or "U"; two of them for a covariance, and for an rms, which has no sign either; ""
    for what has none, such as hits; None if the name is not on the list.

    Examples
    --------
    >>> [stokes(n) for n in ("Q_POLARISATION", "TEMPERATURE", "TU_COV", "U-ML", "HITS", "UNKNOWN1")]
    ['Q', 'I', 'IU', 'U', '', None]
    """
    return _KNOWN.get(name.strip().upper().replace("-", "_").replace(" ", "_"))


def choose(names: Sequence[str]) -> list[int]:
    """Numbers of the first columns that are called I, Q and U, whatever follows after "_" or "-".

    Good enough to choose by, but no evidence of what is in them.

    Examples
    --------
    >>> choose(["HITS", "Q_353GHz", "U_353GHz", "Q_RMS"])
    [1, 2]
    """

    def kind(name: str) -> str:
        beginning = re.match(r"[IQU](?=[_-])", name.upper())
        return stokes(name) or (beginning[0] if beginning and stokes(name) is None else "")

    kinds = [kind(name) for name in names]
    return [kinds.index(letter) for letter in "IQU" if letter in kinds]


def parse_stokes(given: str | Sequence[str]) -> list[str]:
    """The Stokes parameters that an argument names, one entry per column.

    Parameters
    ----------
    given : a letter per column ("IQU"), or words: a sequence, or text with blanks or commas
        ("QQ QU UU"); an entry "" is a column without a Stokes parameter

    Examples
    --------
    >>> parse_stokes("QU"), parse_stokes("QQ, UQ, UU")
    (['Q', 'U'], ['QQ', 'QU', 'UU'])
    """
    if isinstance(given, str):
        words = given.replace(",", " ").split()
        entries: Sequence[str] = list(words[0]) if len(words) == 1 else words
    else:
        entries = given
    found = []
    for entry in entries:
        letters = [_LETTERS.get(c, "?") for c in entry.upper()] if isinstance(entry, str) else ["?"]
        kind = "".join(sorted(letters, key="IQU?".index))
        if kind not in _CHOICES:
            raise InputError(
                "Argument `stokes` must name I, Q, U or pairs of them in the order of the columns, "
                f'such as "QU" or "QQ QU UU", but is {given!r}.'
            )
        found.append(kind)
    return found
