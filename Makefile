.DEFAULT_GOAL := help
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.ready
WORKERS ?= 2
# As the night's workers run: waiting threads of BLAS would count as CPU time.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 16

setup: $(STAMP) ## create .venv with the command boresight and all that demo and tests need

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "Boresight needs $(PYTHON) (set PYTHON=...)"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[simulate,train,ray,ops,test,dev]'
	@touch $(STAMP)

demo: setup ## synthetic fleet to HTML report, in minutes
	$(BIN)/boresight demo --out demo || [ $$? -eq 3 ] # 3: done, and something was held, as it should be

test: setup browser ## every test, with shapes and types of the annotations checked
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --durations 25 --ignore tests/benchmarks \
		--jaxtyping-packages=schemas,pipeline,beartype.beartype

# Page tests want Chromium. It is installed where that is allowed without asking, and nowhere else; tests without it are
# named in the last lines of `make test`.
browser:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get update -qq && apt-get install -y -qq chromium fonts-dejavu-core; fi || true

lint: setup ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup ## speed and memory, measured as ratios against the committed baseline
	$(ONE_THREAD) $(BIN)/python -m pytest tests/benchmarks -p no:xdist -s

bench-accept: setup ## the same, and writes what it measures into the baseline
	$(ONE_THREAD) $(BIN)/python -m pytest tests/benchmarks -p no:xdist -s --accept-baseline

licenses: setup ## write jobs/deploy/THIRD_PARTY_LICENSES.md anew
	$(BIN)/python -m tests.makers.third_party > jobs/deploy/THIRD_PARTY_LICENSES.md

clean: ## remove what the other targets made
	rm -rf .venv demo .pytest_cache .mypy_cache .ruff_cache

.PHONY: help setup demo test browser lint bench bench-accept licenses clean
