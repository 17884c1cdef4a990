# Everything a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: help demo test test-all check bench clean

help:
	@echo "make demo   install what is missing and calibrate a simulated UR5 + PhoXi M cell"
	@echo "make test   run the tests"
	@echo "make test-all   the same with the long studies"
	@echo "make check  formatting, lint, types, imports"
	@echo "make bench  what each stage costs"

demo: $(VENV)/.run
	$(BIN)/flangeye run ur5_phoxi-m_simulated

test: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 -m "not slow and not realtime"
	$(BIN)/python -m pytest -q -m "not slow and realtime"

test-all: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 -m "not realtime"
	$(BIN)/python -m pytest -q -m realtime

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks

$(VENV)/.run: pyproject.toml .ci/system-packages
	PYTHON=$(PYTHON) ./.ci/system-packages run
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.run
	PYTHON=$(PYTHON) ./.ci/system-packages test
	$(PIP) --editable '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
