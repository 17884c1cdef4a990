# Everything a newcomer needs: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Commands are started some hundred times: their bytecode is kept, whatever the shell says of it.
export PYTHONDONTWRITEBYTECODE :=
PYTEST := $(BIN)/python -m pytest -q
TWO := $(PYTEST) -n 2 --dist worksteal
# Tests in real time wait most of their time, so three run at once. They share the machine with whatever
# runs beside them: what fails is tried once more, with nothing of ours beside it.
THREE := $(PYTEST) -n 3 --dist worksteal
BESIDE := -m "realtime and not (slow or alone)"
ALONE := -m "realtime and alone and not slow"
ALONE_ALL := -m "realtime and (slow or alone)"
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: help demo test test-all check docs bench flame clean

help:
	@echo "make demo   install what is missing and calibrate a simulated UR5 + PhoXi M cell"
	@echo "make test   run the tests"
	@echo "make test-all   the same with the long studies"
	@echo "make check  formatting, lint, types, imports; size of each room"
	@echo "make docs   build the documentation into site/, strictly"
	@echo "make bench  what each stage costs, beside its yardstick and what it was"
	@echo "make flame  a flame graph of RECIPE=…, flame.svg"

demo: $(VENV)/.run
	$(BIN)/flangeye run ur5_phoxi-m_simulated

test: $(VENV)/.dev $(VENV)/.ros2
	$(TWO) -m "not slow and not realtime"
	$(THREE) $(BESIDE) || $(PYTEST) $(BESIDE) --last-failed
	$(PYTEST) $(ALONE) || $(PYTEST) $(ALONE) --last-failed

test-all: $(VENV)/.dev $(VENV)/.ros2
	$(TWO) -m "not realtime" --hypothesis-profile=search
	$(THREE) $(BESIDE) || $(PYTEST) $(BESIDE) --last-failed
	$(PYTEST) $(ALONE_ALL) || $(PYTEST) $(ALONE_ALL) --last-failed

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tools.count

docs: $(VENV)/.dev
	$(BIN)/python -m mkdocs build --strict --quiet

bench: $(VENV)/.dev
	$(BIN)/python -m tests.benchmarks

# A flame graph of a run, flame.svg: make flame RECIPE=ur5_phoxi-m_simulated
RECIPE ?= ur5_phoxi-m_simulated
flame: $(VENV)/.dev
	$(BIN)/py-spy record --rate 200 --output flame.svg -- $(BIN)/python -m flangeye.cli run $(RECIPE)

# The versions of requirements.lock, where it was made for this machine; else what pip finds.
LOCKED := $(VENV)/locked.txt
$(VENV)/.run: pyproject.toml requirements.lock .ci/system-packages
	PYTHON=$(PYTHON) ./.ci/system-packages run
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -c 'import platform as p, sys; sys.exit((sys.version_info[:2], p.system(), p.machine()) != ((3, 11), "Linux", "x86_64"))' \
		&& sed -nE 's/^([A-Za-z0-9._-]+==[^ ;]+).*/\1/p' requirements.lock >$(LOCKED) || : >$(LOCKED)
	$(PIP) --constraint $(LOCKED) --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.run plugins/flangeye_paper/pyproject.toml
	PYTHON=$(PYTHON) ./.ci/system-packages test
	$(PIP) --editable '.[dev]' --editable plugins/flangeye_paper
	@touch $@

# The real rclpy of the tests, beside them and not among them; its wheels are for CPython 3.11 alone.
$(VENV)/.ros2: $(VENV)/.run tests/plugins/ros2/requirements.txt
	$(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' \
		&& $(PYTHON) -m venv $(VENV)/ros2 \
		&& $(VENV)/ros2/bin/python -m pip install --quiet --disable-pip-version-check \
			--requirement tests/plugins/ros2/requirements.txt \
		|| echo "ROS 2 tests are left out: its wheels cannot be had here"
	@touch $@

clean:
	rm -rf $(VENV) build dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis
