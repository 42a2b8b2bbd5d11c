# Everything happens in .venv, which each target makes and brings up to date by itself: it needs
# Python 3.11 or later, make and git. A second call costs nothing until pyproject.toml or
# constraints.txt change.

SHELL := /bin/bash
PYTHON ?= $(firstword $(foreach python,python3.11 python3.12 python3.13 python3 python,\
	$(shell $(python) -c 'import sys; sys.version_info >= (3, 11) and print("$(python)")' 2>/dev/null)))
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# PyTorch only keeps books here, for Stable-Baselines3. Its CPU build saves gigabytes; where this
# index cannot be reached, pip falls back to the ones that it is configured with.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TESTS ?= tests
# Bytecode of what is installed, on all cores, also where Python is told to write none: without it,
# every process imports for twice as long. A file that is no Python of this version stays as it is.
COMPILED = @$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true

.PHONY: install format lint type test test-all test-expensive test-lowest test-newest docs commit-checks demo clean

install: $(VENV)/.installed-dev

# torch first, so that nothing installed later can pull another build of it.
$(VENV)/.torch: constraints.txt
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or later was found. Name one: make PYTHON=/path/to/python"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --no-compile --retries 1 --constraint constraints.txt --extra-index-url $(TORCH_INDEX) torch
	@touch $@

$(VENV)/.installed-%: pyproject.toml constraints.txt $(VENV)/.torch
	$(PIP) install --quiet --no-compile --constraint constraints.txt --editable ".[$(EXTRAS)]"
	$(COMPILED)
	@touch $@

$(VENV)/.installed-demo: EXTRAS := zoo,report
$(VENV)/.installed-dev: EXTRAS := zoo,report,onnx,dev

format: install
	$(BIN)/ruff check --select I --fix .
	$(BIN)/ruff format .

lint: install
	$(BIN)/ruff check .

type: install
	$(BIN)/pyright

commit-checks: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

# Two processes, each with whole files, so that a file shares its fixtures and compiled functions.
test: install
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not expensive" $(TESTS)

test-all: install
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(TESTS)

# Among them: something is hidden in data, drawn from SB3_HDS_SALT, and has to be found.
test-expensive: install
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "expensive and not measured" $(TESTS)

# The ranges of pyproject.toml: the lowest versions that it allows, and the newest that there are.
# torch, which only keeps books, stays as tested, so that neither pulls its builds for CUDA.
test-lowest: RESOLUTION := lowest-direct
test-newest: RESOLUTION := highest
test-lowest test-newest: test-%:
	test -x $(VENV)-$*/bin/python || $(PYTHON) -m venv $(VENV)-$*
	$(VENV)-$*/bin/python -m pip --disable-pip-version-check install --quiet --no-compile \
		--retries 1 --constraint constraints.txt --extra-index-url $(TORCH_INDEX) torch
	$(VENV)-$*/bin/python -m pip --disable-pip-version-check install --quiet uv
	$(VENV)-$*/bin/uv pip install --python $(VENV)-$*/bin/python --resolution $(RESOLUTION) \
		--editable ".[zoo,report,onnx,dev]"
	$(VENV)-$*/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not expensive" $(TESTS)

docs: install
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

demo: $(VENV)/.installed-demo
	$(BIN)/python examples/demo.py --folder demo
	$(BIN)/python examples/demo_diagnosis.py --folder demo

clean:
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-newest build dist demo docs/_build .pytest_cache .ruff_cache
