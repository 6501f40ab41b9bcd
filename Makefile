# make demo   simulate a faint star, measure it with and without denoising, write a report
# make test   lint, types, tests
# make fuzz   hostile values at every door for MINUTES=60; a finding names its seed
# make docs   the documentation as pages, build/docs/index.html; QUICK=1 leaves out what tutorials compute
# make release  wheel and sdist, tried in new environments with every extra (long; TRY="--extras none,io")
# make bench  speed against other packages, as ratios in one run (about 15 minutes)
# make bench-compare  what changed since the run before, beyond noise (or: OLD=file NEW=file)
# make clean  remove what these made

PYTHON ?= python3
MINUTES ?= 60
VENV := .venv
BIN := $(VENV)/bin
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
# Tests run in parallel: BLAS threads would only wait for each other.
export OPENBLAS_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test lint types unit fuzz docs release bench bench-compare clean

demo: $(VENV)/installed-demo
	$(BIN)/faintspot demo

test: lint types unit

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache

types: $(VENV)/installed
	$(BIN)/mypy

unit: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist loadfile

fuzz: $(VENV)/installed
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES)

docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html $(if $(QUICK),-D plot_gallery=0) docs build/docs
	@echo "build/docs/index.html: open it in a browser"

release: $(VENV)/installed
	$(BIN)/python -m pip install --quiet build twine
	$(BIN)/python release/try_packages.py $(TRY)

bench: $(VENV)/installed-benchmarks
	$(BIN)/python -m benchmarks

bench-compare: $(VENV)/installed
	$(BIN)/python -m benchmarks compare $(OLD) $(NEW)

# What users with recorded frames need; tests need much more.
$(VENV)/installed-demo: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "faintspot needs Python 3.11 or newer: make PYTHON=/path/to/python3"; exit 2; }
	@echo "installing faintspot and its pinned dependencies into $(VENV) ..."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[io,web]'
	@touch $@

$(VENV)/installed: $(VENV)/installed-demo
	@echo "installing what develops and tests it ..."
	$(BIN)/python -m pip install --quiet --editable '.[develop]'
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	@touch $@

$(VENV)/installed-benchmarks: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --editable '.[benchmarks]'
	@touch $@

clean:
	rm -rf $(VENV) build faintspot-demo docs/auto_tutorials docs/reference/commands docs/reference/generated docs/reference/options docs/sg_execution_times.rst .mypy_cache .pytest_cache .ruff_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
