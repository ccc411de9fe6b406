# Needs Python 3.11 or newer, git and make; everything else is installed into $(VENV).
#
#   make PYTHON=python3.12 test     another Python for a new environment
#   make VENV=/tmp/env test         another place for it
#   make test ARGS="-k autoreset"   arguments for pytest, the demo or the benchmarks
#   make test-newest SPEED=slow     the slow tests, with the newest releases

PYTHON ?= python3
VENV ?= .venv
ARGS ?=

RUN := $(VENV)/bin/python
PIP := $(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Two processes; the one that is done first takes over tests of the other.
WORKERS := -n 2 --dist worksteal

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-all test-slow test-optimized test-newest test-oldest test-gpu test-programs test-clients gpu-report lint format bench golden docs docs-serve clean

help: ## show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1|/' | \
		awk -F'|' '{ printf "%-18s %s\n", $$1, $$2 }'

demo: $(VENV)/.installed-demo ## train a PyTorch agent from pixels; results in runs/demo
	$(RUN) examples/train_inverted_pendulum.py --output-dir runs/demo $(ARGS)

# Tests of what compilation could change.
OPTIMIZED := tests/golden tests/renderer tests/physics tests/envs tests/agents/test_updates.py tests/agents/test_drqv2.py

# Tests of what needs no torch.
TORCHLESS := tests/renderer tests/distractors tests/envs tests/physics tests/scene tests/agents \
	tests/platform tests/golden tests/test_video.py tests/test_validation.py tests/test_compilation.py tests/test_architecture.py
# The first that runs; pyenv may have one that is not chosen.
find_python = $(firstword $(shell for python in python$(1) $(HOME)/.pyenv/versions/$(1).*/bin/python; \
	do $$python -c "" 2>/dev/null && echo $$python; done) python$(1))
NEWEST_PYTHON ?= $(call find_python,3.13)
OLDEST_PYTHON ?= $(call find_python,3.11)
SPEED ?= not slow
# Or cuda13, as the GPU's driver wants.
CUDA ?= cuda12

test: $(VENV)/.installed-dev ## run the tests that take minutes at most
	$(RUN) -m pytest $(WORKERS) -m "not slow and not gpu and not gpu_program" $(ARGS)

# One after the other, to the last, whatever fails.
LANES := test-slow test-optimized test-newest test-oldest test-clients test-programs

test-all: ## run everything else that needs no GPU: slow, optimised, newest and oldest releases, clients, programs
	@failed=""; for lane in $(LANES); do began=$$(date +%s); \
		$(MAKE) --no-print-directory $$lane || failed="$$failed $$lane"; \
		echo "$$lane took $$(( $$(date +%s) - began )) s"; done; \
		test -z "$$failed" || { echo "failed:$$failed"; exit 1; }

test-slow: $(VENV)/.installed-dev ## run the tests that take longer
	$(RUN) -m pytest $(WORKERS) -m "slow and not gpu" $(ARGS)

test-optimized: $(VENV)/.installed-dev ## compile as users do: images, physics, environments, equal seeds of training
	PIXELBRAX_TESTS_OPTIMIZE=1 $(RUN) -m pytest $(WORKERS) -m "not slow and not gpu" $(OPTIMIZED) $(ARGS)

test-newest: .venv-newest/.installed ## run those that need no torch with the newest releases
	.venv-newest/bin/python -m pytest $(WORKERS) -m "$(SPEED) and not gpu" $(TORCHLESS) $(ARGS)

test-oldest: .venv-oldest/.installed ## run those that need no torch with the oldest releases
	.venv-oldest/bin/python -m pytest $(WORKERS) -m "$(SPEED) and not gpu" $(TORCHLESS) $(ARGS)

test-gpu: $(VENV)/.installed-dev ## run the tests that need an NVIDIA GPU, on a machine that has one
	$(PIP) "jax[$(CUDA)]"
	PIXELBRAX_TESTS_OPTIMIZE=1 PIXELBRAX_TESTS_DEVICE=cuda XLA_CLIENT_MEM_FRACTION=0.3 \
		XLA_FLAGS="--xla_gpu_deterministic_ops=true" \
		$(RUN) -m pytest -m gpu tests/gpu $(ARGS)

# mjx.render needs warp-lang; where it does not install, the report says so.
gpu-report: $(VENV)/.installed-dev ## measure on an NVIDIA GPU in 25 minutes; tables and plots in runs/gpu-report
	$(if $(findstring --rehearse,$(ARGS)),,$(PIP) "jax[$(CUDA)]")
	-$(if $(findstring --rehearse,$(ARGS)),,$(PIP) "mujoco-mjx[warp]")
	$(RUN) -m tests.benchmarks.gpu_report $(ARGS)

test-programs: $(VENV)/.installed-dev .venv-newest/.installed ## compile for an H100 and a TPU that need not be here
	$(RUN) -m pytest -m gpu_program tests/test_gpu_program.py $(ARGS)
	.venv-newest/bin/python -m pytest -m gpu_program tests/test_gpu_program.py $(ARGS)

test-clients: .venv-clients/.installed ## run third-party agents and wrappers on the environments
	.venv-clients/bin/python -m pytest $(WORKERS) tests/clients $(ARGS)

lint: $(VENV)/.installed-dev ## check style, types and spelling
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(VENV)/bin/codespell

format: $(VENV)/.installed-dev ## rewrite the code in the project's style
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

bench: $(VENV)/.installed-dev ## measure throughput
	$(RUN) -m tests.benchmarks.run $(ARGS)

golden: $(VENV)/.installed-dev ## accept how tasks, looks and cameras are drawn now; ARGS="ant" for some
	$(RUN) -m tests.golden.images $(ARGS)

docs: $(VENV)/.installed-docs ## build the documentation into site/, every warning an error
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict

docs-serve: $(VENV)/.installed-docs ## read the documentation in a browser while writing it
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs serve

clean: ## remove the environment, builds and caches; keeps runs/
	rm -rf $(VENV) .venv-ci .venv-clients .venv-newest .venv-oldest .venv-peers build dist site MUJOCO_LOG.TXT .jax_cache .mypy_cache .pytest_cache .ruff_cache
	find pixelbrax_jax pixelbrax_gym tests examples -name __pycache__ -prune -exec rm -rf {} +

# One environment for all; each set of extras is installed when it is first needed, and again
# when what it is made of has changed.
$(VENV)/.installed-%: $(VENV)/.created pyproject.toml constraints.txt
	@echo "Installing PixelBrax with its $* extras into $(VENV); the first time takes minutes ..."
	@$(PIP) -e ".[$*]"
	@# Tests read its models alone; what else it requires has no wheels for newer Pythons.
	@if test "$*" = dev && ! $(RUN) -c "import sys; sys.exit(sys.version_info >= (3, 13))"; then \
		$(PIP) --no-deps dm_control; fi
	@touch $@

# With no constraints pip takes the newest releases. Of dm_control only models are read; what else it
# requires has no wheels for this Python.
.venv-newest/.installed: pyproject.toml
	@echo "Installing PixelBrax with the newest releases into .venv-newest ..."
	@$(NEWEST_PYTHON) -m venv --clear .venv-newest
	@.venv-newest/bin/python -m pip install --quiet --disable-pip-version-check -e ".[test]"
	@.venv-newest/bin/python -m pip install --quiet --disable-pip-version-check --no-deps dm_control
	@touch $@

.venv-oldest/.installed: pyproject.toml tests/oldest_releases.py
	@echo "Installing PixelBrax with the oldest releases into .venv-oldest ..."
	@$(OLDEST_PYTHON) -m venv --clear .venv-oldest
	@.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check packaging
	@.venv-oldest/bin/python tests/oldest_releases.py > .venv-oldest/constraints.txt
	@.venv-oldest/bin/python -m pip install --quiet --disable-pip-version-check \
		-c .venv-oldest/constraints.txt -e ".[test]"
	@touch $@

.venv-clients/.installed: pyproject.toml constraints.txt tests/clients/requirements.txt
	@echo "Installing PixelBrax and its clients into .venv-clients; the first time takes minutes ..."
	@$(PYTHON) -m venv --clear .venv-clients
	@.venv-clients/bin/python -m pip install --quiet --disable-pip-version-check \
		-c constraints.txt -e ".[dev,warp]"
	@.venv-clients/bin/python -m pip install --quiet --disable-pip-version-check \
		--no-deps -r tests/clients/requirements.txt
	@touch $@

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("PixelBrax needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; try: make PYTHON=python3.12 ...")'
	@echo "Creating $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@touch $@
