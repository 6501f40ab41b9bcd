PYTHON ?= python3
MINUTES ?= 60
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet
GROUPS := develop docs benchmarks release pins
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
export PIP_BUILD_CONSTRAINT := $(CURDIR)/constraints.txt
# Tests run in parallel: BLAS threads would only wait for each other.
export OPENBLAS_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Collecting the tests takes twice as long where their bytecode may not be kept.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test test-all lint types unit newest optimised slow durations fuzz docs release bench bench-compare pins clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

demo: $(VENV)/installed-demo  ## simulate a faint star, measure it with and without denoising, write a report
	$(BIN)/faintspot demo

test: lint types unit  ## lint, types, and the tests that take no processes and no more than seconds

test-all: test slow  ## all tests

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache

types: $(VENV)/installed
	$(BIN)/mypy

unit: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# What differs between versions of Python: imports, annotations, compilation, files, numbers at their edges.
VERSIONED := tests/test_public.py tests/test_docstrings.py tests/base tests/slopes/kernels/test_compiling.py \
	tests/slopes/camera tests/io/test_frame_formats.py tests/io/test_slope_files.py tests/test_estimators_hostile.py

newest: $(VENV)/installed  ## the fast tests that may differ between versions of Python
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" $(VERSIONED)

optimised: $(VENV)/installed  ## inputs are checked without the assert statements that `python -O` leaves out
	$(BIN)/python -O -m pytest -n 2 --dist worksteal -m "not slow" tests/base tests/loop/control/test_*.py

slow: $(VENV)/installed  ## tests that start processes or a browser, or take longer
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

durations: $(VENV)/installed  ## tests/durations.csv: processor seconds of each test and each compilation, cold and warm
	$(BIN)/python -m tests.durations

fuzz: $(VENV)/installed  ## hostile values at every entry point for MINUTES=60; a finding names its seed
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES)

docs: $(VENV)/installed-docs  ## documentation as pages, build/docs/index.html; QUICK=1 leaves out what tutorials compute
	$(BIN)/python -m sphinx -W --keep-going -q -b html $(if $(QUICK),-D plot_gallery=0) docs build/docs
	@echo "build/docs/index.html: open it in a browser"

release: $(VENV)/installed  ## wheel and sdist, tried in new environments with every extra (long; TRY="--extras none,io")
	$(PIP) --group release
	$(BIN)/python release/try_packages.py $(TRY)

bench: $(VENV)/installed-benchmarks  ## speed against other packages, as ratios in one run (about 15 minutes)
	$(BIN)/python -m benchmarks

bench-compare: $(VENV)/installed  ## what changed since the run before, beyond noise (or: OLD=file NEW=file)
	$(BIN)/python -m benchmarks compare $(OLD) $(NEW)

pins: $(VENV)/installed-demo  ## write constraints.txt anew, with the versions that are there; UPGRADE=1 takes the newest
	$(PIP) --group pins
	$(BIN)/uv pip compile pyproject.toml --all-extras $(GROUPS:%=--group %) --universal --python-version 3.11 \
		--no-header --no-annotate --quiet $(if $(UPGRADE),--upgrade) --output-file constraints.txt

# What users with recorded frames need; tests need much more.
$(VENV)/installed-demo: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "faintspot needs Python 3.11 or newer: make PYTHON=/path/to/python3"; exit 2; }
	@echo "installing faintspot and its pinned dependencies into $(VENV) ..."
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) --editable '.[io,report]'
	@touch $@

# Tests run these tools, and pyRTC and soapy (which brings 0.7 GB of a graphical toolkit) where they are there.
$(VENV)/installed: $(VENV)/installed-demo
	@echo "installing what develops and tests it ..."
	$(PIP) --editable '.[all,cluster,oopao,specula]' --group develop
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(PIP) --group docs
	@touch $@

$(VENV)/installed-benchmarks: $(VENV)/installed
	$(PIP) --editable '.[all,pyrtc]' --group benchmarks
	@touch $@

clean:  ## remove what these made
	rm -rf $(VENV) build faintspot-demo docs/auto_tutorials docs/reference/commands docs/reference/generated docs/reference/options docs/sg_execution_times.rst .mypy_cache .pytest_cache .ruff_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
