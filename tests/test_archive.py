"""Official data products: the catalogue, the command, and checks."""

from pathlib import Path

import pytest

from commands import jaxsky
from fits.commands.run import DEFAULTS
from jaxsky.archive import fetch
from jaxsky.bandpass import parse_unit
from jaxsky.io import InputError
from jaxsky.products import ProductSet, catalogue, find, product_sets, total_size, verify
from jaxsky.settings import load, named_files
from misbehaving import CONTENT, NAME, SHA, body, fits_bytes, product
from refusals import cases, raises

EXAMPLES = Path(__file__).parents[1] / "examples"


pytestmark = pytest.mark.usefixtures("log")


def test_the_catalogue_is_complete():
    products = catalogue()
    assert len(products) > 40
    for name, found in products.items():
        assert found.name == name
        assert found.addresses
        assert all(a.startswith("https://") and a.endswith(name) for a in found.addresses)
        assert found.hash is None or found.hash.split(":")[0] in ("sha256", "md5")
        if found.unit is not None:
            parse_unit(found.unit)
        assert found.nside in (None, 256, 512, 1024, 2048)
        # The nside is part of the names of Planck's maps.
        parts = name.split("_")
        if "Map" in name and found.nside:
            assert str(found.nside).zfill(4) in parts
    assert products["wmap_band_iqumap_r9_9yr_K_v5.fits"].unit == "mK_CMB"
    for wanted in ("wmap9", "planck2015-lfi", "commander2015", "haslam"):
        assert find([wanted])


def test_sets_are_files_of_the_catalogue():
    for name, found in product_sets().items():
        assert len(find([name])) == len(found.files)
        assert name not in {p.group for p in find()}
    assert total_size(find(["planck-44-70"])) == "about 1.8 GB"
    assert total_size(find(["separate"])) == "about 5.0 GB"
    assert total_size(find(["wmap9"])) == "503 MB"
    assert total_size(find(["haslam"])) == "of unknown size"
    assert total_size(find(["planck-ancillary"])) == "more than 19 MB"


@pytest.mark.parametrize(
    ("wanted", "path"),
    [
        ("planck-44-70", EXAMPLES / "planck_44_70.toml"),
        ("planck-44-70", DEFAULTS / "planck-44-70.toml"),
        ("separate", DEFAULTS / "planck-separate.toml"),
    ],
)
def test_sets_are_the_files_of_examples(wanted, path):
    assert set(named_files(load(path))) == {product.name for product in find([wanted])}


def test_the_set_of_the_paper_is_what_is_commented_out_in_an_example(tmp_path):
    text = (DEFAULTS / "planck-44-70.toml").read_text()
    start, commented = text.split("\n# [sky.ame]")
    assert "[paper]" in commented
    text = start + f"\n[sky.ame]{commented}".replace("\n# ", "\n")
    path = tmp_path / "x.toml"
    path.write_text(text)
    assert set(named_files(load(path))) == {product.name for product in find(["paper"])}


def test_products_are_found_by_group_name_and_part():
    assert len(find(["wmap9"])) == 5
    assert [p.what for p in find(["wmap_band_iqumap_r9_9yr_K_v5.fits"])] == ["K, 23 GHz"]
    assert {p.name[:7] for p in find(["rimo"])} == {"LFI_RIM", "HFI_RIM"}
    assert len(find(["wmap9", "wmap_band_iqumap_r9_9yr_K_v5.fits"])) == 5
    assert {p.group[:6] for p in find(["planck"])} == {"planck"}
    assert len(find(["planck"])) > 20
    assert find() == list(catalogue().values())
    raises(ValueError, r"no product 'cobe'; give the name .* wmap9, wmap9-masks", find, ["cobe"])


@pytest.mark.parametrize("known", [None, SHA], ids=["without a hash", "with a hash"])
def test_a_file_is_fetched_once_and_checked(server, tmp_path, log, known):
    wanted = product(f"{server}/good/{NAME}", hash=known, size=len(CONTENT))
    seen = []
    path = fetch(wanted, tmp_path, report=lambda **numbers: seen.append(tuple(numbers.values())))
    assert path.read_bytes() == CONTENT
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert fetch(wanted, tmp_path) == path
    assert len(log) == 1
    assert verify(wanted, tmp_path) == "hash, columns, complete"
    assert not list(tmp_path.glob("*.part"))
    # Damage that leaves the length is noticed, whoever knew the hash.
    damaged = bytearray(CONTENT)
    damaged[-3000] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"map.fits: has the hash sha256:.* but should have"):
        verify(wanted, tmp_path)


def test_what_verify_refuses(tmp_path):
    path = tmp_path / NAME
    wanted = product()
    raises(InputError, r"is not there; fetch it with `jaxsky data fetch`", verify, wanted, tmp_path)
    for content, changes, words in cases("archive/verify"):
        path.write_bytes(body(content))
        with pytest.raises(InputError) as caught:
            verify(wanted._replace(**changes), tmp_path)
        assert words in str(caught.value)
    path.write_bytes(fits_bytes(unit="mK"))
    # Bare kelvins, as in older files, may be the ones that are expected.
    assert verify(wanted._replace(unit="mK_CMB"), tmp_path) == "columns, complete"


def command(monkeypatch, *arguments):
    return jaxsky(monkeypatch, "data", *arguments)


@pytest.fixture
def served(server, monkeypatch, tmp_path):
    """The server's file as two products, which are a set, and a folder for them."""
    wanted = product(f"{server}/good/{NAME}", hash=SHA, size=len(CONTENT))
    second = wanted._replace(name="second.fits", addresses=(f"{server}/good/second.fits",))
    known = {NAME: wanted, "second.fits": second}
    monkeypatch.setattr("jaxsky.products.catalogue", lambda: known)
    sets = {"both": ProductSet("An analysis", (NAME, "second.fits"))}
    for module in ("jaxsky.products", "fits.commands.data"):
        monkeypatch.setattr(f"{module}.product_sets", lambda: sets)
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_the_command(served, monkeypatch, capsys):
    assert command(monkeypatch, "list") == 0
    said = capsys.readouterr().out
    assert "map.fits" in said
    assert "yes" not in said
    assert command(monkeypatch, "verify", NAME) == 1
    assert "map.fits: is not there; fetch it with" in capsys.readouterr().err
    assert command(monkeypatch, "verify") == 0
    assert f"No product is in {served}." in capsys.readouterr().err
    assert command(monkeypatch, "fetch", NAME) == 0
    assert f"In {served}: 1 files." in capsys.readouterr().err
    assert command(monkeypatch, "list") == 0
    assert "1 of 2" in capsys.readouterr().out
    assert command(monkeypatch, "fetch", "both") == 0
    said = capsys.readouterr().err
    assert "2 files, 17 kB." in said
    assert f"In {served}: 2 files." in said
    assert command(monkeypatch, "list", "map") == 0
    assert "yes" in capsys.readouterr().out
    assert command(monkeypatch, "verify") == 0
    assert "map.fits: hash, columns, complete" in capsys.readouterr().err
    (served / NAME).write_bytes(CONTENT[:-3000])
    assert command(monkeypatch, "verify") == 1
    assert "map.fits: not a FITS file, or a truncated one" in capsys.readouterr().err


def test_mistakes_of_the_command(served, server, monkeypatch, capsys, tmp_path):
    for arguments, words in cases("archive/mistakes"):
        assert command(monkeypatch, *(a.replace("SERVER", server) for a in arguments)) == 2
        said = capsys.readouterr().err
        assert words in said
        assert "Traceback" not in said
        assert not (served / NAME).exists()
    # The rest comes from wherever.
    assert command(monkeypatch, "fetch", NAME, "--dir", served) == 0
    assert (served / NAME).read_bytes() == CONTENT
