# `make` alone lists the targets. Everything runs in .venv, which `setup` makes and keeps up to date; another Python beside it:
# make test VENV=.venv-3.13 PYTHON=python3.13
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PYTHON ?= python3.11 python3.12 python3.13 python3 python
PIP_FLAGS ?=
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: help setup lint typecheck docs test suite test-slow test-versions demo bench clean

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "%-14s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(INSTALLED) ## Make .venv and install everything, again only when pyproject.toml or constraints.txt changed

$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing into $(VENV): about two minutes the first time, four with a CUDA build of PyTorch ...'
	@$(INSTALL) $(PIP_FLAGS) -e '.[dev]'
	@$(INSTALL) --no-deps dm_control # for Python 3.13, see pyproject.toml; elsewhere it is there already
	@.ci/rendering $(BIN)/python
	@touch $@

$(BIN)/python:
	@python=$$(.ci/python $(PYTHON)) || { \
	    echo 'No Python 3.11 or newer with venv and ensurepip found among: $(PYTHON).' \
	        'Install one (Debian: python3-venv) or say where it is: make setup PYTHON=/path/to/python3.12' >&2; \
	    exit 1; \
	}; \
	"$$python" -m venv $(VENV)

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

docs: setup ## Build the site: warnings are errors, links are checked, notebooks are run
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo 'The site: site/index.html; with its search: $(BIN)/python -m http.server -d site'

docs suite test-slow: export OMP_NUM_THREADS := 1
docs suite test-slow: export WANDB_MODE := offline

test: lint typecheck docs suite ## Lint, types, the site and all tests but the slow ones

suite: setup ## All tests but the slow ones; TESTS=tests/nht: those in there
	$(BIN)/pytest -m 'not slow' $(TESTS)

test-slow: setup ## The slow tests: learning, processes, compilation
	$(BIN)/pytest -m slow $(TESTS)

# Each with the versions that constraints.txt has for it. A CUDA build of PyTorch is 6 GB: once tested, rm -r .venv-3.*
test-versions: ## All tests but the slow ones in each Python found, 3.11 to 3.13, in environments of their own
	@for version in 3.11 3.12 3.13; do \
	    if python=$$(.ci/python "python$$version"); then \
	        $(MAKE) suite "VENV=.venv-$$version" "PYTHON=$$python"; \
	    else \
	        echo "No Python $$version here."; \
	    fi; \
	done

demo: setup ## The main job: demonstrations, map, DDPG through it and on raw joints, table, plot and videos
	@OMP_NUM_THREADS=1 ./demo.sh $(BIN)/python

bench: setup ## Measure speed and what the maps can do; the learning runs are in benchmarks/README.md
	@for file in benchmarks/speed/*.py benchmarks/maps/*.py; do echo "== $$file"; OMP_NUM_THREADS=1 $(BIN)/python "$$file"; done

clean: ## Remove what building and the tools left; .venv* and runs/ stay
	rm -rf build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -path './.venv*' -prune -o -name __pycache__ -type d -print0 | xargs -0 rm -rf
