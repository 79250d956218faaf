# `make fit` and `make test` set up their own environment in .venv from pinned requirements.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: fit test lint validate bench docs pin clean

fit: .venv/.run
	$(BIN)/jaxsky fit --out results/fit --overwrite

test: .venv/.dev
	$(BIN)/pytest -n auto --maxprocesses 4 --dist worksteal

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Slow checks, 43 minutes on two slow cores: kills at random moments, and statistics of many skies.
validate: .venv/.dev
	$(BIN)/pytest validation tests -m slow -n auto --maxprocesses 4 --dist loadfile \
		--no-loadscope-reorder --durations 40

# Huge pages for all that is allocated: numpy asks for them itself, XLA and numba do not.
bench: .venv/.bench
	GLIBC_TUNABLES=glibc.malloc.hugetlb=1 $(BIN)/python -m benchmarks --write

# Pages in docs/_build/html; nothing is loaded from elsewhere, here or in the browser.
docs: .venv/.docs
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/.run: .venv/bin/python requirements.txt pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps \
		--no-build-isolation -e .
	touch $@

.venv/.dev: .venv/.run requirements-dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	touch $@

.venv/.bench: .venv/.dev requirements-bench.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-bench.txt
	touch $@

.venv/.docs: .venv/.dev requirements-docs.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-docs.txt
	touch $@

# The newest versions of everything, in a fresh environment; run the tests before committing.
pin:
	rm -rf .venv
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet hatchling editables .
	( sed -n 1p requirements.txt; $(BIN)/python -m pip freeze | grep -v '^jaxsky' ) > .venv/run.txt
	$(BIN)/python -m pip install --quiet '.[dev]'
	$(BIN)/python -m pip freeze | grep -v '^jaxsky' > .venv/all.txt
	( sed -n 1p requirements-dev.txt; grep -vxF -f .venv/run.txt .venv/all.txt ) > .venv/dev.txt
	$(BIN)/python -m pip install --quiet -c .venv/all.txt '.[bench]'
	( sed -n 1p requirements-bench.txt; $(BIN)/python -m pip freeze | grep -v '^jaxsky' \
		| grep -vxF -f .venv/all.txt ) > .venv/bench.txt
	$(BIN)/python -m pip freeze | grep -v '^jaxsky' > .venv/before_docs.txt
	$(BIN)/python -m pip install --quiet -c .venv/all.txt '.[docs]'
	( sed -n 1p requirements-docs.txt; $(BIN)/python -m pip freeze | grep -v '^jaxsky' \
		| grep -vxF -f .venv/before_docs.txt ) > .venv/docs.txt
	mv .venv/run.txt requirements.txt
	mv .venv/dev.txt requirements-dev.txt
	mv .venv/bench.txt requirements-bench.txt
	mv .venv/docs.txt requirements-docs.txt
	rm -rf .venv

clean:
	rm -rf .venv results docs/_build docs/generated
