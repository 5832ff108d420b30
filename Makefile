# Everything a user of this repository types. Run `make` for the list.

PYTHON ?= python3
EXTRAS ?= dev
JOBS ?= 2
PY := .venv/bin/python

# Flags for the variables that were set, and for no others: the commands keep their own defaults.
flag = $(if $($(1)),--$(2) '$($(1))')
# The same where a variable may hold several words.
flag-words = $(if $($(1)),--$(2) $(foreach word,$($(1)),'$(word)'))
FLAGS = $(call flag,TASK,task) $(call flag,PRESET,preset) $(call flag,METHOD,method) $(call flag-words,REAL,real) \
	$(call flag,PRIOR,prior) $(call flag,SEED,seed) $(call flag,SEEDS,seeds) $(ARGS)

.DEFAULT_GOAL := help
.PHONY: help setup lint type test test-all demo real-demo bench gaps pretrain finetune evaluate figures frozen docs lock clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo
	@echo "  make pretrain TASK=hammer PRESET=fast SEED=0"
	@echo "  make finetune TASK=hammer METHOD=sgft-sac REAL='mild default' SEEDS=10"
	@echo "  Anything else goes through ARGS, e.g. make pretrain TASK=hammer ARGS='--resume'; ARGS=--help lists it."

setup: ## create .venv with the locked versions (EXTRAS=dev,cuda for an NVIDIA GPU)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' || \
		{ echo "error: Python 3.12 or newer is needed, $(PYTHON) is not; name another with PYTHON=python3.12"; exit 1; } >&2
	@if command -v uv > /dev/null; then \
		uv venv --allow-existing --quiet --python $(PYTHON) .venv && \
		uv pip install --quiet --python $(PY) --constraint requirements.lock --editable '.[$(EXTRAS)]'; \
	else \
		$(PYTHON) -m venv .venv && \
		$(PY) -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable '.[$(EXTRAS)]'; \
	fi
	@echo "ready: $(PY)"

lint: $(PY) ## style and format
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

type: $(PY) ## static types
	$(PY) -m pyright

test: $(PY) ## the fast tests, four minutes on two cores
	$(PY) -m pytest -q -n $(JOBS) --dist worksteal -m "not slow and not heavy" $(ARGS)

test-all: $(PY) ## every test that this machine can run
	$(PY) -m pytest -q -n $(JOBS) --dist worksteal $(ARGS)

demo: $(PY) ## a policy fails, two rollouts mend it: two minutes on a CPU
	$(PY) -m experiments.demo $(FLAGS)

real-demo: $(PY) ## fine-tune in another engine, Bullet (needs a Python 3.11: PYTHON311=...)
	$(PY) -m experiments.real_demo $(call flag,PRIOR,prior) $(call flag,METHOD,method) $(call flag,SEED,seed) $(ARGS)

bench: $(PY) ## speeds next to their references
	$(PY) -m experiments.benchmark $(ARGS)

gaps: $(PY) ## the named differences between simulation and "real" system
	$(PY) -m experiments.gaps $(FLAGS)

pretrain: $(PY) ## TASK, PRESET, SEED: train in randomised simulation, leave a prior
	$(PY) -m experiments.pretrain $(FLAGS)

finetune: $(PY) ## TASK, METHOD, REAL, SEEDS, PRIOR: adapt to the real system
	$(PY) -m experiments.finetune $(FLAGS)

evaluate: $(PY) ## evaluate what a run has saved
	$(PY) -m experiments.evaluate $(FLAGS)

figures: $(PY) ## draw the figures again from the runs
	$(PY) -m experiments.figures $(FLAGS)

frozen: $(PY) ## every run of the frozen test, then its table (ARGS='--gpus 2 --jobs 6')
	$(PY) -m experiments.studies.frozen $(ARGS)

docs: $(PY) ## build the documentation site in build/site (EXTRAS=dev,docs)
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet
	@echo "open build/site/index.html"

lock: $(PY) ## pin requirements.lock to the versions installed in .venv
	$(PY) .ci/lock.py > requirements.lock

clean: ## remove caches and build products; runs/ and .venv stay
	rm -rf build .cache .pytest_cache .ruff_cache .hypothesis *.egg-info
	find sgft_jax envs experiments tests -name __pycache__ -type d -exec rm -rf {} +

$(PY):
	@echo "error: there is no .venv; run make setup" >&2; exit 1
