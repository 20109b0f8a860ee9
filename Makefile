# Every target works from a fresh clone; those that need .venv create it first. `make` lists them.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
MAKEFLAGS += --no-builtin-rules --no-print-directory
.SUFFIXES:
.DEFAULT_GOAL := help

# make venv PYTHON=/path/to/python3.12 chooses the interpreter; ARGS="..." goes on to demo, test and test-all.
PYTHON ?=
ARGS ?=
# TORCH=cpu takes PyTorch's build without a GPU, KIND=robot leaves out the simulator and the tools for development.
# They are read from the command line only; without them an environment stays what it is.
TORCH :=
KIND :=
# Processes that `make test` runs tests in; one more than two cores, because some tests wait for other processes.
WORKERS ?= 3
export PYTHON TORCH KIND

BIN := .venv/bin
STAMP := .venv/.installed-from
SORT := $(shell cat .venv/.installed-kind 2>/dev/null || echo cuda full)
WANTED := $(or $(TORCH),$(word 1,$(SORT))) $(or $(KIND),$(word 2,$(SORT)))

# An environment that was made in another folder (a moved or copied checkout) or of another sort is made anew, and a
# PYTHON named on the command line is compared with the environment's.
ifneq "$(shell cat $(STAMP) 2>/dev/null) $(SORT)$(if $(filter command line,$(origin PYTHON)),named)" "$(CURDIR) $(WANTED)"
$(STAMP): FORCE
endif

$(STAMP): pyproject.toml constraints.txt overrides.txt overrides-cpu.txt overrides-robot.txt
$(STAMP): scripts/setup_env.sh scripts/preamble.sh
	@scripts/setup_env.sh

# What the targets for development need more than a finished environment.
.PHONY: tools
tools: $(STAMP)
	@if [[ -f .venv/.installed-kind && $$(<.venv/.installed-kind) == *robot ]]; then \
	    echo "error: this .venv has no tools for development (KIND=robot); make venv KIND=full installs them" >&2; \
	    exit 1; \
	fi

.PHONY: help
help: ## List the targets
	@printf 'Targets (make TARGET):\n\n'
	@sed -nE 's/^([a-z-]+):.*## (.*)/  \1\t\2/p' Makefile | expand -t 14
	@printf '\nPYTHON=... chooses the interpreter for venv; ARGS="..." goes on to demo, test and test-all.\n'
	@printf 'TORCH=cpu: PyTorch without a GPU. KIND=robot: no simulator, for a PC at the robot. Both go with any target.\n'

.PHONY: venv
venv: $(STAMP) ## Create .venv, or bring it up to date (nothing is installed outside it)

.PHONY: vulkan
vulkan: ## Install CPU Vulkan for rendering, if missing (system packages: root or sudo)
	@scripts/install_vulkan.sh

.PHONY: browser
browser: ## Install Chromium for the tests of the viewer, if missing (system packages: root or sudo)
	@scripts/install_browser.sh

.PHONY: demo
demo: $(STAMP) ## Learn where to look, judge it on plants never seen, write a report and a film
	@$(BIN)/maniskill-tomato demo $(ARGS)

.PHONY: test
test: tools ## Run the tests that need no GPU and little time
	@$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m "not slow and not gpu" $(ARGS)

.PHONY: test-all
test-all: tools ## Run every test that this machine can run
	@$(BIN)/python -m pytest $(ARGS)

.PHONY: lint
lint: tools ## Check the style (ruff)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

.PHONY: licences
licences: tools ## Check the licences of all installed packages
	@$(BIN)/pip-licenses >/dev/null

.PHONY: format
format: tools ## Repair the style (ruff)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

.PHONY: type
type: tools ## Check the types (mypy, pyright)
	@$(BIN)/mypy
	@$(BIN)/pyright

.PHONY: reference
reference: tools ## Write the pages and drawings of docs/ that come from code
	@$(BIN)/python tools/write_reference.py
	@$(BIN)/python tools/draw_diagrams.py

.PHONY: docs
docs: tools ## Build the documentation as a site into build/docs
	@$(BIN)/python tools/build_docs.py

.PHONY: check
check: lint licences type docs test ## Everything that must pass before a commit

.PHONY: build
build: tools ## Build the wheel and try it in a clean environment
	@scripts/build_wheel.sh

.PHONY: clean
clean: ## Remove build outputs and caches (keeps .venv and runs)
	@rm -rf build dist maniskill_tomato.egg-info .pytest_cache .mypy_cache .ruff_cache
	@find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

.PHONY: distclean
distclean: clean ## Remove .venv too
	@rm -rf .venv

.PHONY: FORCE
FORCE:
