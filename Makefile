# make help lists the targets. Needs Linux, Python 3.11 or newer and git; everything else is installed into .venv.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
# Workers of the test run: one a core, 2 to 8. One thread each: the fast suite is many small tensors.
WORKERS ?= $(shell n=$$(env -u OMP_NUM_THREADS nproc 2> /dev/null || getconf _NPROCESSORS_ONLN); echo $$((n < 2 ? 2 : n > 8 ? 8 : n)))
# Which of them: make test TESTS="tests/planners -k mppi"
TESTS ?=
BROWSER := chromium
APT := mesa-vulkan-drivers libegl1 libegl-mesa0 libgl1-mesa-dri libosmesa6 libusb-1.0-0

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup system packages robot client launcher demo test-setup test test-all docs check format clean

help: ## List the targets.
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## Create .venv and install everything (once).

# uv is several times faster than pip with wheels of this size; it is told about pip's own index settings, if there are any.
# Unlike pip it leaves compiling to the first import, or to every one where PYTHONDONTWRITEBYTECODE is set: half of a start.
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else f"error: Python 3.11 or newer is needed, {v[0]}.{v[1]} found; say which: make setup PYTHON=python3.11")'
	@[ -x $(BIN)/python ] || { echo "creating .venv"; $(PYTHON) -m venv .venv; }
	@echo "installing $$(wc -l < requirements.lock) packages into .venv (a few GB, once)"
	@$(BIN)/python -m pip install -q uv
	@UV_HTTP_TIMEOUT=300 $${PIP_INDEX_URL:+env UV_DEFAULT_INDEX="$$PIP_INDEX_URL"} $(BIN)/uv pip install -q --compile-bytecode --python $(BIN)/python -r requirements.lock \
	  || { echo "uv could not install; trying pip, which takes longer"; $(BIN)/python -m pip install -q -r requirements.lock; }
	@$(BIN)/python -m pip install -q --no-deps --no-build-isolation -e .
	@touch $(STAMP)

system: ## Install the apt packages for rendering and a browser without a screen (root, or sudo that asks nothing).
	@$(MAKE) --no-print-directory packages APT="$(APT)"
	@command -v chromium google-chrome > /dev/null || $(MAKE) --no-print-directory packages APT="$(BROWSER)"

packages:
	@missing=""; for p in $(APT); do [ "$$(dpkg-query -Wf '$${db:Status-Abbrev}' $$p 2> /dev/null)" = "ii " ] || missing="$$missing $$p"; done; \
	sudo=""; [ "$$(id -u)" = 0 ] || sudo="sudo -n"; \
	if [ -z "$$missing" ]; then echo "system packages: all there"; \
	elif ! command -v apt-get > /dev/null; then echo "no apt-get here: what draws without a screen is left out; it needs$$missing"; \
	elif [ -n "$$sudo" ] && ! sudo -n true 2> /dev/null; then \
	  echo "not root: what draws without a screen is left out; sudo apt-get install$$missing brings it"; \
	elif { $$sudo apt-get update -qq && $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing; } \
	  < /dev/null > /dev/null; then echo "installed:$$missing"; \
	else echo "apt-get could not install$$missing: what draws without a screen is left out"; fi

robot: setup ## Install the robot's client and its stand-in (Linux only).
	@$(BIN)/python -c 'import franky, franky_sim' 2> /dev/null \
	  || { echo "installing the robot's client"; $(BIN)/python -m pip install -q --no-build-isolation -c requirements.lock -e '.[franka,franka-sim]'; }

demo: setup ## Deploy the shipped checkpoint into a hidden gap, in simulation (minutes).
	@$(BIN)/python -m mpc_sgft.deploy --backend sim +experiment=demo

# What the tests need beside setup, where it can be had here; what cannot is left out and named at the end of the run.
test-setup: setup system client launcher

client: setup
	@[ "$$(uname -s)" != Linux ] || $(MAKE) --no-print-directory robot \
	  || echo "the robot's client could not be installed: its tests are left out, its types unknown"

# Alone: for AWS it wants an older cloudpickle than joblib does, so that no lock can hold both.
launcher: setup
	@$(BIN)/python -c 'import hydra_plugins.hydra_ray_launcher' 2> /dev/null \
	  || $(BIN)/python -m pip install -q --no-deps hydra-ray-launcher==1.2.2 \
	  || echo "Ray's launcher could not be installed: its test is left out"

test: test-setup ## Set up what the tests need, and run the fast ones.
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) -m "not slow" $(TESTS)

test-all: test-setup ## Run every test, the slow ones too.
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(WORKERS) $(TESTS)

docs: setup ## Build the documentation into site/ (strict).
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "site/index.html is the documentation"

check: setup client ## Formatting, linting, types.
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/pyright

format: setup ## Rewrite the files in the house format.
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

clean: ## Remove what builds leave behind; .venv and runs/ stay.
	@rm -rf build dist site *.egg-info .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
