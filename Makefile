# Everything a newcomer needs, from a bare Python 3.11 or newer and make. `make help` lists the targets.

VENV ?= .venv
BIN := $(VENV)/bin
# The first interpreter that is new enough and can make an environment; override with PYTHON=python3.12.
PYTHON ?= $(shell for python in python3.11 python3.12 python3 python3.13; do \
	$$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { echo $$python; break; }; done)
# Processes for the tests; the suite is written for two cores.
WORKERS ?= 2
DEMO ?= demo
DAYS ?= 30
SEEDS ?= 1
# Folder of the golden record.
RECORD ?= golden-record

# One BLAS thread: steps run in parallel over days, and results must not depend on the number of threads.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
# Arrays are made and dropped by the thousand: the tests' processes keep the memory, as flows' workers do. Pages
# of two megabytes have to be put together first, which costs more than they save.
test test-slow: export NUMPY_MADVISE_HUGEPAGE := 0
test test-slow: export MALLOC_TRIM_THRESHOLD_ := 1073741824
test test-slow: export MALLOC_MMAP_THRESHOLD_ := 1073741824
# What is imported is compiled once, not by every process that the tests start.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow cases coverage lint bench golden docs lock format clean

help:  ## list the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(VENV)/.installed  ## make the environment in .venv from the lock file (runs once)

$(VENV)/.locked: requirements.lock
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer with the venv module found;" \
		"install one or say which: make setup PYTHON=/path/to/python3"; exit 1; }
	@echo "Making the environment $(VENV) with $(PYTHON); the first time takes a few minutes."
	$(PYTHON) -m venv $(VENV)
	@# The lock is complete, so nothing is resolved: what it does not name is not installed.
	$(BIN)/python -m pip install -qq --no-compile --no-deps --require-hashes -r requirements.lock
	@$(BIN)/python -m compileall -q -j 0 $(VENV)/lib >/dev/null 2>&1 || true
	@touch $@

$(VENV)/.installed: pyproject.toml $(VENV)/.locked
	$(BIN)/python -m pip install -qq --no-deps --no-build-isolation --editable .
	@$(BIN)/python -m pip check
	@touch $@

demo: setup  ## simulate a month, run the whole chain, show what came out (a minute)
	$(BIN)/inflight --workspace $(DEMO) demo --days $(DAYS)

# What a file's tests share is made by one process; tests/conftest.py names the files whose tests share nothing.
PYTEST = .ci/in-memory $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadfile --durations 40

test: setup  ## run the tests
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: setup  ## run the long physics cases and real records that 'make test' leaves out
	$(PYTEST) -m slow $(ARGS)

cases: setup  ## diagnose missions with hidden effects, print scores and the verdicts kept beside them (half an hour)
	$(BIN)/python -m tests.physics_cases --seeds $(SEEDS) --jobs $(WORKERS) --against tests/physics_cases/verdicts.json

coverage: setup  ## print how often the truth lies within the stated sigmas: tables, products, effects (an hour)
	$(BIN)/python -m benchmarks coverage

lint: setup  ## check style, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup  ## put the code into the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: setup  ## measure speed and memory
	$(BIN)/python -m benchmarks

golden: setup  ## keep what the software gives for small missions in RECORD, to compare
	$(BIN)/python -m benchmarks.golden make $(RECORD) --jobs $(WORKERS)

docs: setup  ## build the documentation into docs/_build/html
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

lock: setup  ## resolve requirements.lock anew for Python 3.11 and later
	@command -v uv >/dev/null || test -x $(BIN)/uv || $(BIN)/python -m pip install -qq uv
	PATH="$$PATH:$(abspath $(BIN))" uv pip compile --quiet --universal --generate-hashes --no-emit-index-url \
		--python-version 3.11 --extra dev --extra docs --extra postgres pyproject.toml -o requirements.lock \
		--custom-compile-command "make lock"

clean:  ## remove what the targets made, the environment included
	rm -rf $(VENV) $(DEMO) build dist docs/_build .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
