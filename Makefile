# Every target sets up what it needs in .venv, once; `make help` lists them.
PYTHON ?= $(firstword $(shell command -v python3.11 2>/dev/null) python3)
BIN := .venv/bin
READY := $(BIN)/.ready

# One thread per process: the work is spread over processes, and idle OpenMP threads spin.
export OMP_NUM_THREADS := 1

.PHONY: help bench test test-slow lint docs render-setup

help:
	@echo 'make bench         score NNiT on PickCube-v1, unseen architectures, and print the table'
	@echo 'make test          lint, types and tests'
	@echo 'make test-slow     the tests that take minutes'
	@echo 'make lint          ruff and mypy only'
	@echo 'make docs          the documentation, as HTML in docs/_build'
	@echo 'make render-setup  fetch what nnit-bench render needs on a machine without a GPU (Debian)'

bench: $(READY)
	@$(BIN)/nnit-bench run --method nnit

test: lint
	@$(BIN)/pytest -m 'not slow'

test-slow: $(READY)
	@$(BIN)/pytest -m slow

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

docs: $(READY)
	@$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build

render-setup:
	@sh nnit_zoo/sim/lavapipe.sh

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'error: Python 3.11 or newer is needed; say which with: make PYTHON=/path/to/python3.11' >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@
