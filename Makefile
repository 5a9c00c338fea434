# `make` alone lists the targets. Everything runs in .venv, which `setup` makes and keeps up to date.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

BIN := .venv/bin
INSTALLED := .venv/.installed
PYTHON ?= python3.11 python3 python
PIP_FLAGS ?=

.PHONY: help setup lint typecheck test test-slow demo bench clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(INSTALLED) ## Make .venv and install everything, again only when pyproject.toml or constraints.txt changed

$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing into .venv: about two minutes the first time ...'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt $(PIP_FLAGS) -e '.[dev]'
	@.ci/rendering $(BIN)/python
	@touch $@

$(BIN)/python:
	@for python in $(PYTHON); do \
	    if $$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then \
	        exec $$python -m venv .venv; \
	    fi; \
	done; \
	echo 'No Python 3.11 with venv and ensurepip found among: $(PYTHON).' \
	    'Install it (Debian: python3.11-venv) or say where it is: make setup PYTHON=/path/to/python3.11' >&2; \
	exit 1

lint: setup ## Check style and formatting
	$(BIN)/ruff check
	$(BIN)/ruff format --check

# What is shipped is checked, not the checkout: the folders at the root have other names once installed.
# sed turns the installed paths back into those of the checkout.
typecheck: setup ## Check the types of the installed package
	@rm -rf build
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --target build/typecheck .
	cd build/typecheck && ../../$(BIN)/mypy --config-file ../../pyproject.toml --cache-dir ../../.mypy_cache -p nht \
	    | sed -E 's#^nht/(transforms|envs|recipes|configs)/#\1/#'

test test-slow: export OMP_NUM_THREADS := 1
test test-slow: export WANDB_MODE := offline

test: lint typecheck ## Lint, types and all tests but the slow ones
	$(BIN)/pytest -m 'not slow'

test-slow: setup ## The slow tests: learning, processes, compilation
	$(BIN)/pytest -m slow

demo: setup ## The main job: demonstrations, map, DDPG through it and on raw joints, table, plot and videos
	@OMP_NUM_THREADS=1 ./demo.sh $(BIN)/python

bench: setup ## Measure speed and what the maps can do; the learning runs are in benchmarks/README.md
	@for file in benchmarks/speed/*.py benchmarks/maps/*.py; do echo "== $$file"; OMP_NUM_THREADS=1 $(BIN)/python "$$file"; done

clean: ## Remove what building and the tools left; .venv and runs/ stay
	rm -rf build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -path ./.venv -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
