"""`jaxsky data`: list, download and check official data products."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

from fits.commands.report import ResultTable, Row, console, print_tables
from fits.commands.run import if_stopped
from jaxsky.archive import fetch
from jaxsky.io import InputError
from jaxsky.io.files import cache_folder
from jaxsky.products import find, product_sets, total_size, verify

data_commands = typer.Typer(
    help="Official data products: what there is, download, and checks.", no_args_is_help=True
)

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PRODUCT ...]",
        help="Names of files, groups, sets, or parts of the first two; without, all.",
    ),
]
Folder = Annotated[
    Path,
    typer.Option(
        "--dir",
        default_factory=cache_folder,
        help="Where files are kept.",
        show_default="$JAXSKY_CACHE, or the platform's folder for caches",
    ),
]


@data_commands.command("list")
def _list(folder: Folder, products: Words = None) -> None:
    """Name the products and sets of them, and say which are there."""
    rows, group = list[Row](), None
    for product in find(products or []):
        if product.group != group:
            group = product.group
            rows += [(), (group, product.title)]
        path = folder / product.name
        here = path.is_file()
        known = product._replace(size=path.stat().st_size) if here else product
        size = total_size([known]) if known.size or known.about else ""
        nside, kept = str(product.nside or ""), "yes" if here else ""
        rows.append((product.name, product.what, nside, product.unit or "", size, kept))
    if not products:
        rows += [(), ("sets", "files of an analysis")]
        for name, found in product_sets().items():
            members = find([name])
            held = f"{sum((folder / p.name).is_file() for p in members)} of {len(members)}"
            rows.append((name, found.title, "", "", total_size(members), held))
    header = ("file", "what", "nside", "unit", "size", "here")
    table = ResultTable(header, rows, f"Kept in {folder}", words=6)
    print_tables([table], width=None if console.is_terminal else 200)


@data_commands.command("fetch")
def _fetch(
    products: Annotated[
        list[str],
        typer.Argument(
            metavar="PRODUCT ...", help="Names of files, groups, sets, or parts of the first two."
        ),
    ],
    folder: Folder,
    mirror: Annotated[
        str | None,
        typer.Option(envvar="JAXSKY_MIRROR", help="Address of a folder with the files."),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Take files of another size or hash, if all else fits.")
    ] = False,
) -> None:
    """Download products, unless they are there; what was cut is resumed."""
    wanted = find(products)
    if len(wanted) > 1:
        console.print(f"{len(wanted)} files, {total_size(wanted)}.")
    if_stopped("; fetch it again to resume")
    name = TextColumn("{task.description}", markup=False)
    shown = name, BarColumn(), DownloadColumn(), TransferSpeedColumn()
    with Progress(*shown, console=console) as progress:
        for product in wanted:
            report = partial(progress.update, progress.add_task(product.name, total=product.size))
            words = f"{product.name}: another process fetches it; waiting."
            waiting = partial(console.print, words)
            path = fetch(
                product, folder, mirror=mirror, accept=accept, report=report, waiting=waiting
            )
            size = path.stat().st_size
            report(completed=size, total=size)
    if_stopped("; all files are there")
    console.print(f"In {folder}: {len(wanted)} files.", soft_wrap=True)


@data_commands.command("verify")
def _verify(folder: Folder, products: Words = None) -> None:
    """Check files that are there: size, hash, columns, units, and that they are complete."""
    wanted = [p for p in find(products or []) if products or (folder / p.name).exists()]
    wrong = 0
    for product in wanted:
        try:
            console.print(f"{product.name}: {verify(product, folder)}", soft_wrap=True)
        except InputError as error:
            wrong += 1
            console.print(str(error), style="red", soft_wrap=True)
    if wrong:
        raise typer.Exit(1)
    if not wanted:
        console.print(f"No product is in {folder}.", soft_wrap=True)
