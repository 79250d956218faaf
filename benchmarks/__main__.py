"""`python -m benchmarks`."""

import argparse
import sys
from pathlib import Path

import jax
from rich.console import Console

from benchmarks import (
    band_averages,
    command,
    comparisons,
    large_maps,
    likelihoods,
    pixels,
    pysm_skies,
    realisations,
    separation,
    simulations,
    stacked_maps,
)
from benchmarks.table import Row, conditions, markdown, renewed, rich_table

RESULTS = Path(__file__).with_name("RESULTS.md")
BENCHMARKS = {
    "command": command.fit,
    "planck": command.planck,
    "beta-map": band_averages.beta_map,
    "beta-and-T-maps": band_averages.beta_and_T_maps,
    "samples": band_averages.samples,
    "nside": band_averages.growth,
    "compile": band_averages.compilation,
    "pysm": pysm_skies.skies,
    "pysm-detectors": pysm_skies.detectors,
    "grid": likelihoods.grid,
    "chain": likelihoods.chain,
    "simulate-beta-maps": simulations.beta_maps,
    "simulate-constant": simulations.constant,
    "monte-carlo": simulations.monte_carlo,
    "simulate-large": simulations.high_resolution,
    "smoothing": simulations.smoothing,
    "analysis": simulations.transform,
    "smoothing-nside": simulations.growth,
    "correlated": simulations.correlated_alm,
    "separation-likelihood": separation.uniform_noise,
    "separation-pixels": separation.pixel_noise,
    "separation-fit": separation.whole_fit,
    "separation-regions": separation.regions,
    "separation-simulations": separation.simulations,
    "separation-samples": separation.samples,
    "coupling": comparisons.coupling,
    "patches": comparisons.patches,
    "commands": comparisons.commands,
    "bands-on-disk": stacked_maps.separation,
    "large-maps": large_maps.large_maps,
    "workers": realisations.workers,
    "pixels-moved": pixels.exchanged,
    "pixels-times": pixels.times,
    "pixels-memory": pixels.memory,
}
#: These take minutes: they are run by name, and when the table is kept.
LONG = (
    "planck",
    "pysm",
    "pysm-detectors",
    "simulate-large",
    "separation-pixels",
    "commands",
    "workers",
    "bands-on-disk",
    "large-maps",
    "pixels-memory",
)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m benchmarks", description="Times against peers.")
    parser.add_argument("--list", action="store_true", help="name the benchmarks and stop")
    parser.add_argument(
        "--only",
        choices=BENCHMARKS,
        action="append",
        help="run this one; repeatable",
        metavar="NAME",
    )
    parser.add_argument("--quick", action="store_true", help="small maps, no verdicts")
    words = f"write {RESULTS.name}; with --only, these rows of it"
    parser.add_argument("--write", action="store_true", help=words)
    arguments = parser.parse_args()
    if arguments.write and arguments.quick:
        parser.error("--write keeps measurements: without --quick")
    return arguments


def _measure(names: list[str], quick: bool) -> list[Row]:
    rows: list[Row] = []
    with Console(stderr=True).status("starting") as status:
        for name in names:
            status.update(name)
            rows += BENCHMARKS[name](quick)
    return [row._replace(met=None) for row in rows] if quick else rows


def main() -> None:
    arguments = _arguments()
    console = Console(width=None if sys.stdout.isatty() else 160)
    if arguments.list:
        console.print("\n".join(BENCHMARKS), highlight=False)
        return
    jax.config.update("jax_enable_x64", True)
    every = arguments.write or arguments.quick
    names = [name for name in BENCHMARKS if every or name not in LONG]
    rows = _measure(arguments.only or names, arguments.quick)
    lines = conditions(arguments.quick)
    console.print(rich_table(rows))
    console.print("\n".join(lines), highlight=False)
    if arguments.write:
        old = RESULTS.read_text() if arguments.only else ""
        RESULTS.write_text(renewed(old, rows, lines) if old else markdown(rows, lines))


if __name__ == "__main__":
    main()
