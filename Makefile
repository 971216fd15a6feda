.DEFAULT_GOAL := help
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.ready

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 16

setup: $(STAMP) ## create .venv with the command boresight in it

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "Boresight needs $(PYTHON) (set PYTHON=...)"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,dev]'
	@touch $(STAMP)

demo: setup ## synthetic fleet to HTML report, in minutes
	$(BIN)/boresight demo --out demo

test: setup ## every test
	$(BIN)/python -m pytest

lint: setup ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup ## speed and accuracy ratios against the committed baseline
	$(BIN)/python -m pytest tests/benchmarks -q -p no:xdist --benchmarks

clean: ## remove what the other targets made
	rm -rf .venv demo .pytest_cache .mypy_cache .ruff_cache

.PHONY: help setup demo test lint bench clean
