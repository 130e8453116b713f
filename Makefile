# `make demo` and `make test` set up everything they need in .venv; nothing but Python ≥ 3.11 and make is required.
PYTHON ?= python3
# Another Python beside the first: make test PYTHON=python3.13 VENV=.venv-3.13
VENV ?= .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS ?= 2
# Each worker begins with one half of the tests, so that what the tests of a file share is made once.
TWO := -n 2 --dist worksteal

.PHONY: demo core test test-shard test-slow fuzz soak mutation check lint docs docs-check gallery clean

demo: $(VENV)/demo-ready
	$(BIN)/noiseflow demo --out noiseflow-demo

test: export OMP_NUM_THREADS := 1
test: $(VENV)/test-ready
	$(BIN)/python -m pytest $(TWO)

# Laws, contracts, projector and its adjoint, formats, plan, checks on stored evidence: less than a minute on two cores.
CORE := tests/test_architecture.py tests/noiseflow/test_statistics.py tests/noiseflow/runs tests/noiseflow/checks \
	tests/noiseflow/io/test_mrc.py tests/noiseflow/io/test_images.py tests/noiseflow/fitting/test_pixels.py \
	tests/noiseflow/metrics/test_metrics.py tests/noiseflow/models/test_digitised_model.py \
	tests/noiseflow/distributions/test_law.py tests/noiseflow/distributions/test_normal.py \
	tests/noiseflow/distributions/test_contract.py tests/recon/test_contracts.py tests/recon/projection tests/recon/metrics \
	tests/recon/joint/test_plan.py tests/recon/verdict/test_stored_evidence.py tests/recon/verdict/test_distortions.py \
	tests/recon/verdict/test_moments.py
core: export OMP_NUM_THREADS := 1
core: $(VENV)/test-ready
	$(BIN)/python -m pytest $(TWO) $(CORE)

# What CI runs: all fast tests and one share of the slow ones, SHARD=K/N.
test-shard: export OMP_NUM_THREADS := 1
test-shard: export NOISEFLOW_SLOW_SHARD = $(SHARD)
test-shard: $(VENV)/test-ready
	$(BIN)/python -m pytest $(TWO) -m "slow or not slow"

test-slow: $(VENV)/test-ready
	$(BIN)/python -m pytest -m "slow or not slow"

# Damaged files by the thousand through every reader; NOISEFLOW_FUZZ_EXAMPLES sets how many of each kind.
fuzz: export NOISEFLOW_FUZZ_EXAMPLES ?= 5000
fuzz: $(VENV)/test-ready
	$(BIN)/python -m pytest tests/fuzz

# Each command in a loop with kills, full disks, two at a time, ...: SECONDS of it, its report on the last lines and in soak.md.
soak: export OMP_NUM_THREADS := 1
soak: SECONDS ?= 3600
soak: $(VENV)/test-ready
	$(BIN)/python -m tests.soak --seconds $(SECONDS) --report soak.md

# Mutations of the mathematical core, one at a time, against the tests nearest to them; NUMBER=0 tries all.
mutation: export OMP_NUM_THREADS := 1
mutation: NUMBER ?= 60
mutation: $(VENV)/test-ready
	$(BIN)/python -m tests.mutation --number $(NUMBER)

check: lint docs-check

lint: $(VENV)/test-ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell

docs: $(VENV)/test-ready
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

# All that docs can warn of, in half the time: its theme makes the tree of all pages anew for each.
docs-check: $(VENV)/test-ready
	$(BIN)/python -m sphinx -W --keep-going -q -b html -D html_theme=basic docs docs/_build/plain

# Draws the pictures of the gallery again, in docs/images.
gallery: $(VENV)/test-ready
	set -e; for program in $(filter-out %/drawing.py,$(wildcard docs/gallery/*.py)); do $(BIN)/python $$program; done

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/demo-ready: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $@

$(VENV)/test-ready: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test]"
	touch $@ $(VENV)/demo-ready

clean:
	rm -rf .venv .venv-* build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache noiseflow-demo
