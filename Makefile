# The only entry for people and CI. Each target makes .venv when it is missing or older than what it is made from.
SHELL := bash
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
DOCS_INSTALLED := .venv/.installed-docs

.PHONY: help venv demo test test-slow test-crash fuzz check docs bench clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 12

venv: $(INSTALLED)  ## the virtual environment, with the versions of constraints.txt

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "ssmail needs Python 3.11 or newer; give one with: make PYTHON=python3.12" >&2; exit 1; }
	@echo "Installing ssmail and about 120 packages into .venv, a few minutes and 2 GB; most of it is PyTorch."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -c constraints.txt -e '.[dev,adapters]'
	@touch $@

demo: $(INSTALLED)  ## train SS-AIL on the Y-Junction (a few minutes) and draw its figures
	$(BIN)/ssmail train --method ssail --profile quick --seeds 0
	$(BIN)/ssmail plot fig5 fig4
	@echo "Now look at results/figures/fig5_modes.png (trajectories over the lanes) and fig4_stability.png (error over epochs)."

test: $(INSTALLED)  ## the tests, without the slow ones
	$(BIN)/pytest -n 2 -m "not slow and not crash"

test-slow: $(INSTALLED)  ## the slow tests (minutes)
	$(BIN)/pytest -m slow

test-crash: $(INSTALLED)  ## 100 SIGKILLs at random moments; each restart must end as an undisturbed run (an hour at most)
	$(BIN)/pytest -m crash

fuzz: $(INSTALLED)  ## 20,000 hostile files and arguments (half an hour at most)
	SSMAIL_FUZZ=1 timeout 30m $(BIN)/pytest -n 2 tests/hostile

check: $(INSTALLED)  ## lint, format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

$(DOCS_INSTALLED): $(INSTALLED)
	$(BIN)/pip install -c constraints.txt -e '.[docs]'
	@touch $@

docs: $(DOCS_INSTALLED)  ## the documentation site, with command and API reference, in build/docs; a warning fails it
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -j auto -c docs . build/docs
	@echo "Now open build/docs/README.html."

bench: $(INSTALLED)  ## how long commands, epochs and training steps take, and up to 100 agents (about 20 minutes)
	$(BIN)/python benchmarks/run.py

clean:  ## remove caches and build outputs; .venv and results/ stay
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
	find src cli tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
