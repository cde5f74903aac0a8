# Every target makes what it needs: Python >= 3.11, make and a package index are enough.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
FLOORS := .venv-floors

NOTEBOOKS := examples/neural_dae_pendulum_drag.ipynb $(wildcard examples/gallery/*.ipynb)

# $(call make-venv,DIR,CANDIDATES): a virtual environment from the first interpreter that is new enough.
define make-venv
	@for p in $(2); do \
	    "$$p" -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
	    echo "$$("$$p" --version) makes $(1)"; \
	    exec "$$p" -m venv $(1); \
	done; \
	echo "Python >= 3.11 (with venv) is needed; name one: make PYTHON=/path/to/python" >&2; exit 1
endef

pip = $(1)/bin/python -m pip --disable-pip-version-check

.PHONY: help demo test test-slow test-all test-floors attack lint types docs wheel check bench notebook clean

help:
	@echo "demo         train the pendulum's drag network (examples/)"
	@echo "test         quick tests;  test-floors: a share of them on the oldest dependencies"
	@echo "test-slow    slow tests for so long, those that waited longest first: make test-slow MINUTES=25"
	@echo "test-all     all tests;  test-all PART=3/8: the third of eight parts"
	@echo "attack       random models for so many minutes: make attack MINUTES=10 [SEED=7] [FAMILY=events]"
	@echo "check        lint, types, test, docs, wheel: all that must pass"
	@echo "bench        benchmarks;  notebook: execute the example notebooks in place;  clean: remove products"

$(BIN)/python:
	$(call make-venv,$(VENV),"$(PYTHON)" python3.13 python3.12 python3.11 python3.14)

$(VENV)/.stamp-demo: pyproject.toml | $(BIN)/python
	$(call pip,$(VENV)) install -q -e '.[plot]'
	@touch $@

$(VENV)/.stamp-dev: pyproject.toml | $(BIN)/python
	$(call pip,$(VENV)) install -q -e '.[dev]'
	@touch $@ $(VENV)/.stamp-demo

demo: $(VENV)/.stamp-demo
	$(BIN)/python examples/neural_dae_pendulum_drag.py

# Most of the time goes into compiling programs that run once. XLA's older code generator takes half of it, and without
# optimization a third less again, and in one part a twentieth less; the programs are slower. test-floors compiles as
# users do.
QUICK_COMPILES := XLA_FLAGS="$$XLA_FLAGS --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 \
    --xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1"
IN_PARALLEL := -n auto --dist worksteal
SLOWEST := --durations=10 --durations-min=1

test: $(VENV)/.stamp-dev
	$(QUICK_COMPILES) $(BIN)/python -m pytest $(IN_PARALLEL) $(SLOWEST)

# `make test-all PART=3/8` runs the third of eight parts that take equally long by tests/durations.json, which
# `make test-all DURATIONS=1` writes anew.
PART :=
part_of = $(word $(1),$(subst /, ,$(PART)))
part_asked_for = --splits $(call part_of,2) --group $(call part_of,1)
ALL := -m "slow or not slow" --durations-path tests/durations.json

test-all: $(VENV)/.stamp-dev
	@if [ -n "$(PART)" ] && ! echo "$(PART)" | grep -Eq '^[1-9][0-9]*/[1-9][0-9]*$$'; then \
	    echo "PART=$(PART) is not a part: PART=3/8 is the third of eight" >&2; exit 2; fi
	$(QUICK_COMPILES) $(BIN)/python -m pytest $(IN_PARALLEL) $(SLOWEST) $(ALL) \
	    $(if $(PART),$(part_asked_for)) $(if $(DURATIONS),--store-durations --clean-durations)

# Asked before anything is made.
$(if $(filter attack,$(MAKECMDGOALS)),$(if $(MINUTES),,$(error how many minutes? make attack MINUTES=10)))
$(if $(filter test-slow,$(MAKECMDGOALS)),$(if $(MINUTES),,$(error how many minutes? make test-slow MINUTES=25)))

# When the time is spent, no further test begins. tests/slow_box.py says in which order they run.
test-slow: $(VENV)/.stamp-dev
	$(QUICK_COMPILES) $(BIN)/python -m pytest $(IN_PARALLEL) $(SLOWEST) -m slow --minutes "$(MINUTES)"

# Draws models of all families in turn, with two processes; prints the seed, which repeats a run, and a table.
attack: $(VENV)/.stamp-dev
	$(BIN)/python -m benchmarks.attack --minutes "$(MINUTES)" $(if $(SEED),--seed "$(SEED)") $(if $(FAMILY),--family "$(FAMILY)")

lint: $(VENV)/.stamp-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.stamp-dev
	$(BIN)/pyright

docs: $(VENV)/.stamp-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The wheel alone, in an environment without the development tools, seen from outside the repository.
wheel: $(VENV)/.stamp-dev
	rm -rf dist
	$(BIN)/python -m build --wheel --outdir dist . >/dev/null
	@set -e; dir=$$(mktemp -d); trap 'rm -rf "$$dir"' EXIT; \
	$(BIN)/python -m venv "$$dir/venv"; \
	"$$dir/venv/bin/python" -m pip --disable-pip-version-check install -q dist/*.whl; \
	cp .ci/check_wheel.py dist/*.whl "$$dir"; \
	cd "$$dir"; venv/bin/python check_wheel.py ./*.whl

check: lint types test docs wheel

# Every dependency, extras included, is used by one of these.
ON_FLOORS := tests/kernels tests/compiler tests/plants/test_composition.py tests/plants/test_solution.py \
    tests/plants/test_analysis.py tests/plants/test_converters.py

# The lowest versions that pyproject.toml admits, on the oldest Python where there is a choice.
$(FLOORS)/.stamp: pyproject.toml
	rm -rf $(FLOORS)
	$(call make-venv,$(FLOORS),python3.11 "$(PYTHON)" python3.12 python3.13)
	$(call pip,$(FLOORS)) install -q uv
	$(FLOORS)/bin/uv pip install -q --python $(FLOORS)/bin/python --resolution lowest-direct -e '.[plot,test]'
	@touch $@

test-floors: $(FLOORS)/.stamp
	@$(FLOORS)/bin/python -c 'import jax, diffrax, equinox, optimistix, lineax, optax, sympy, scipy, jaxtyping'
	@$(FLOORS)/bin/uv pip freeze -q --python $(FLOORS)/bin/python --exclude-editable
	$(FLOORS)/bin/python -m pytest $(IN_PARALLEL) $(ON_FLOORS)

bench: $(VENV)/.stamp-dev
	@set -e; for f in $(filter-out %/record.py,$(wildcard benchmarks/[!_]*.py)); do echo "== $$f"; $(BIN)/python "$$f"; done
	$(BIN)/python -m benchmarks.record

notebook: $(VENV)/.stamp-dev
	$(BIN)/python docs/execute_notebooks.py $(NOTEBOOKS)

clean:
	rm -rf build dist site .pytest_cache .ruff_cache .hypothesis examples/output $(FLOORS)
	find . -path './.venv*' -prune -o -type d \( -name __pycache__ -o -name .ipynb_checkpoints \) -print \
	    | xargs rm -rf
