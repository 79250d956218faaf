"""What all public functions refuse: quantities, whose unit would be dropped, and bad seeds.

Functions are found by themselves, and each of their numbers is given as a quantity in turn.
"""

import ast
import importlib
import inspect
import pkgutil
import re
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from pydantic import BaseModel, ValidationError

import fits
import jaxsky
from fits.pseudo_cl import band_powers, masked_spectra
from jaxsky import Bandpass, Sky, Synchrotron, observe, set_parameters
from jaxsky.checks import as_array
from jaxsky.harmonics import smooth
from jaxsky.io import Maps, unit_factor
from jaxsky.noise import estimate_variance, realisation_key
from jaxsky.settings import CommonTable
from refusals import raises

README = Path(__file__).parent.parent / "README.md"
#: Annotations of arguments that may be numbers, or hold some.
NUMERIC = re.compile(
    r"\b(int|float|complex|Array|ArrayLike|Numeric|Parameter|Float|Int|Bool|ndarray|Any|object)\b"
)
#: They convert quantities, or refuse them under a name that they are given.
BY_THEMSELVES = {"from_quantity", "unit_factor", "Maps.to", "refuse_unit", "compress.bare"}
BY_THEMSELVES |= {"as_array", "as_number", "read_instrument", "Instrument.from_table"}


def modules():
    """All modules of the packages but those of the command line."""
    for package in (jaxsky, fits):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not found.name.startswith(("jaxsky.__main__", "fits.app", "fits.commands")):
                yield importlib.import_module(found.name)


@pytest.mark.parametrize("package", [jaxsky, fits])
def test_what_users_need_is_in_the_packages_themselves(package):
    """Imported when it is asked for, and known to type checkers."""
    (block,) = (
        node for node in ast.parse(Path(package.__file__).read_text()).body if type(node) is ast.If
    )
    typed = {name.name: line.module for line in block.body for name in line.names}
    assert sorted(typed) == package.__all__
    submodules = {found.name for found in pkgutil.iter_modules(package.__path__)}
    for name, module in typed.items():
        found = getattr(package, name)
        assert found is getattr(importlib.import_module(module), name)
        assert found.__name__ == name
        assert found.__doc__
        assert name in dir(package)
        assert name not in submodules
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


def public():
    """Functions, constructors and methods without an underscore, by name.

    Named tuples keep what they are given, unit included; settings have types (tested below).
    """
    for module in modules():
        for name, value in vars(module).items():
            own = getattr(value, "__module__", None) == module.__name__ and callable(value)
            if name.startswith("_") or not own:
                continue
            where = f"{module.__name__}.{name}"
            if not inspect.isclass(value):
                yield where, value
            elif not issubclass(value, BaseModel | BaseException | Enum | str):
                if not issubclass(value, tuple):
                    yield where, value
                for method in vars(value):
                    bound = getattr(value, method)
                    if callable(bound) and (not method.startswith("_") or method == "__call__"):
                        yield f"{where}.{method}", bound


def numbers(function):
    """The arguments of a function that may be numbers."""
    for parameter in inspect.signature(function).parameters.values():
        bare = parameter.annotation is parameter.empty
        if parameter.name != "self" and (bare or NUMERIC.search(str(parameter.annotation))):
            yield parameter


PUBLIC = dict(public())
CASES = {
    where: list(numbers(function))
    for where, function in PUBLIC.items()
    if not any(where.endswith(f".{name}") for name in BY_THEMSELVES)
    if not where.startswith("jaxsky.pysm.")  # where arguments are quantities, as PySM's
}


def test_the_sweep_sees_the_packages():
    assert len(PUBLIC) > 300
    assert sum(map(len, CASES.values())) > 500
    for name in (
        "jaxsky.bandpass.Bandpass.shifted",
        "jaxsky.sed.power_law",
        "fits.grid.grid_fit",
    ):
        assert name in PUBLIC


QUANTITY = 2 * u.GHz
UNSEEN, NPIX = -1.6375e30, 768


def call(function, parameter, value):
    """The function with one argument, and None for all others that it needs."""
    several = (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    others = {
        p.name: None
        for p in inspect.signature(function).parameters.values()
        if p.default is p.empty and p.kind not in several and p.name != parameter.name
    }
    if parameter.kind is parameter.VAR_POSITIONAL:
        return function(*others.values(), value)
    return function(**others, **{parameter.name: value})


@pytest.mark.parametrize("where", [where for where, cases in CASES.items() if cases])
def test_a_quantity_is_refused(where):
    for parameter in CASES[where]:
        for value in (QUANTITY, [1.0, QUANTITY], {"any": (QUANTITY,)}):
            name = "any" if isinstance(value, dict) else parameter.name
            words = rf"^Argument `{name}` carries the unit GHz; jaxsky"
            raises(TypeError, words, call, PUBLIC[where], parameter, value)


SEEDED = [
    pytest.param(function, parameter, id=where)
    for where, function in PUBLIC.items()
    for parameter in numbers(function)
    if parameter.name == "seed" and not inspect.isclass(function)
    if not where.endswith(".simulated_fluctuations")  # which hands it to kept_realisations
]


@pytest.mark.parametrize(("function", "parameter"), SEEDED)
def test_a_seed_is_a_natural_number_of_32_bits(function, parameter):
    for error, values in ((TypeError, (True, 1.0, "1")), (ValueError, (-1, 2**32, 2**53))):
        for value in values:
            with pytest.raises(error, match=f"Argument `seed` must be .*, but is {value!r}"):
                call(function, parameter, value)


def test_seeds_that_are_right():
    assert len(SEEDED) >= 6
    keys = [realisation_key(seed, 0) for seed in (0, np.int64(1), 2**32 - 1)]
    assert len({str(key) for key in keys}) == 3
    raises(ValueError, "Argument `index` must be from 0 to", realisation_key, 0, 2**32)


def test_what_converts_quantities():
    assert unit_factor("K_CMB", "K_RJ", at=0.1 * u.THz) == unit_factor("K_CMB", "K_RJ", at=100.0)
    maps = Maps(np.ones((1, 12)), np.ones((1, 12), bool), "K_CMB", ("I",), ("I",), 1)
    expected = maps.to("uK_RJ", at=100.0).maps
    np.testing.assert_array_equal(maps.to("uK_RJ", at=100 * u.GHz).maps, expected)
    raises(TypeError, "Argument `nu` carries the unit MHz", as_array, "nu", 3 * u.MHz)


def test_what_is_refused_inside_of_other_things():
    with pytest.raises(TypeError, match="Argument `delta` carries the unit MHz"):
        Bandpass.delta(44.0).shifted(1 * u.MHz)
    sky = Sky({"synchrotron": Synchrotron(np.ones((2, 12)))})
    with pytest.raises(TypeError, match=r"Argument `synchrotron.nu_ref` carries the unit GHz"):
        set_parameters(sky, {"synchrotron.nu_ref": QUANTITY})
    with pytest.raises(TypeError, match="Argument `nu_ref` carries the unit GHz"):
        Synchrotron(np.ones((2, 12)), nu_ref=QUANTITY)
    with pytest.raises(TypeError, match="Argument `tolerance` carries the unit GHz"):
        observe(sky, [Bandpass.delta(44.0)], tolerance=QUANTITY)
    with pytest.raises(ValidationError, match="fwhm\\n  Input should be a valid number"):
        CommonTable(fwhm=60 * u.arcmin)


def test_arrays_of_other_packages_are_refused():
    class Pint:  # pint's quantities say `units` and `magnitude`, those of unyt are arrays
        units, magnitude = "gigahertz", 44.0

    raises(TypeError, "carries the unit gigahertz", Bandpass.delta, Pint())


@pytest.mark.parametrize("value", [UNSEEN, np.nan, np.inf])
def test_missing_pixels_are_no_values(value):
    used = np.arange(NPIX) >= 200
    maps = np.ones((2, NPIX))
    spectra = masked_spectra(used.astype(float), (2, 9, 16), lmax=15)
    calls = {
        "smooth": lambda: smooth(maps, 600.0),
        "band_powers": lambda: band_powers(spectra, maps),
        "cross": lambda: band_powers(spectra, np.ones((2, NPIX)), maps),
        "variance": lambda: estimate_variance(maps, used),
    }
    for function in calls.values():
        function()
    maps[:, 5] = value  # outside of the mask
    calls["band_powers"]()
    maps[0, 400] = value
    for name, function in calls.items():
        argument = "other" if name == "cross" else "maps"
        raises(ValueError, rf"Argument `{argument}` has . of .* \(or UNSEEN\)", function)


def readme_code() -> str:
    """The Python of the README, in order."""
    return "\n".join(re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL))


def test_what_the_readme_imports_is_there():
    for line in re.findall(r"^from .* import .*", readme_code(), re.MULTILINE):
        exec(line, {})


@pytest.mark.slow
def test_the_code_of_the_readme_runs(capsys):
    names = {}
    exec(readme_code(), names)
    assert "dust.beta_dust" in capsys.readouterr().out
    assert names["fit"].best_fit["dust.beta_dust"] == pytest.approx(1.53, abs=0.01)
