"""Benchmarks: each task next to a peer that does the same in the same process.

`python -m benchmarks` prints one table of ratios with their targets; `--list` names the
benchmarks, `--only NAME` runs one, `--quick` runs all on small maps, without verdicts, and
`--write` keeps the table as `benchmarks/RESULTS.md`. Those who are compared take turns, so that
a busy machine slows all of them alike; what is compiled is compiled before, and counted apart.
"""
