.DEFAULT_GOAL := help
PYTHON ?= python3.11
BIN := .venv/bin
STAMP := .venv/.ready
WORKERS ?= 2
EVERYTHING ?=
comma := ,
# As the night's workers run: waiting threads of BLAS would count as CPU time.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# Many short processes: what one of them compiled, the next ones load.
unexport PYTHONDONTWRITEBYTECODE

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 20

setup: $(STAMP) ## create .venv with the command boresight and all that demo and tests need

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "Boresight needs $(PYTHON) (set PYTHON=...)"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[simulate,train,ray,ops,video,viz,test,dev]'
	@touch $(STAMP)

view: setup ## open3d beside it (a gigabyte): the 3D view of a vehicle-day, and the tests of it
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[view]'

# Other programs that open what is written, in one environment of their own: their pins do not agree with ours. `make
# test` runs what needs them once it is there.
READERS := .venv-readers
READERS_OF := nuscenes-devkit==1.2.0 t4-devkit==0.1.0 yourdfpy==0.0.60 xacro==2.1.1 kubernetes-validate==1.37.0 "pyarrow<20" "pandas<3"
BARE_READERS := pykitti==0.3.1 vod-tudelft==1.0.3# without their requirements, of which reading needs none
export BORESIGHT_READERS ?= $(wildcard $(CURDIR)/$(READERS)/bin/python)

# The environment appears whole or not at all; pip names what it did not find, and `make test` what it leaves out for
# that. Under CI nothing may be left out. --no-compile: most of it is never imported.
readers: $(READERS) ## devkits of data sets, a URDF reader, Kubernetes' schema (1 GB), and the tests of them
$(READERS): Makefile
	rm -rf $@ $@.new
	$(PYTHON) -m venv $@.new
	pip="$@.new/bin/python -m pip install --quiet --no-compile"; \
	$$pip $(READERS_OF) && $$pip --no-deps $(BARE_READERS) && mv $@.new $@ \
		|| { echo "$@ is not there: tests that need it are left out"; test -z "$$CI"; }

demo: setup ## synthetic fleet to HTML report, in minutes
	$(BIN)/boresight demo --out demo || [ $$? -eq 3 ] # 3: done, and something was held, as it should be

# Files go to workers whole, for what their tests share; tests/conftest.py puts the heaviest first.
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --durations 25
# Each function's first calls, and one in many after them: every call would double what the tests cost.
SHAPES := -p tests.shapes --jaxtyping-packages=schemas$(comma)pipeline$(comma)beartype.beartype

test: setup browser ## tests of less than ten seconds; EVERYTHING=1 runs the slow ones too, and checks shapes and types
	$(PYTEST) $(if $(EVERYTHING),$(SHAPES),-m "not slow")

# Page tests want Chromium. It is installed where that is allowed without asking, and nowhere else; tests without it are
# named in the last lines of `make test`.
browser:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get update -qq && apt-get install -y -qq chromium fonts-dejavu-core; fi || true

lint: setup ## style, types, and the lines of each room against tests/budgets.toml
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tests.budgets

# Days, lakes and lines of results stay: it goes on where it was stopped, and code of other commits does not count.
STUDY = $(ONE_THREAD) $(BIN)/python -m tests.benchmarks.studies
benchmark: setup ## measure what the README's rows state on this commit, in about two hours on two cores
	for study in table1 coverage worlds worlds-full worlds-motion starts faults; do \
		$(STUDY).run $$study --root benchmark --workers $(WORKERS) || exit 1; done
	{ $(STUDY).nights --root benchmark --fleets van surveyed no_lidar && $(STUDY).real --root benchmark \
		&& $(STUDY).ssl --root benchmark --parts real --networks untrained trained; } & beside=$$!; \
		$(STUDY).nights --root benchmark --fleets demo && $(STUDY).ssl --root benchmark --parts fleet; \
		mine=$$?; wait $$beside && exit $$mine

results: setup ## write the result tables of both READMEs from what was measured
	$(BIN)/python -m tests.benchmarks.results_table

accuracy-accept: setup ## measure the fixed days of tests/accuracy and write their baseline
	$(ONE_THREAD) $(BIN)/python -m tests.accuracy.accept --accept

licenses: setup ## write jobs/deploy/THIRD_PARTY_LICENSES.md anew
	$(BIN)/python -m tests.makers.third_party > jobs/deploy/THIRD_PARTY_LICENSES.md

# Tools that look at the environment from outside, in one of their own: they would be part of what they describe.
LOOKERS := .venv-audit
$(LOOKERS)/.ready: Makefile
	test -x $(LOOKERS)/bin/python || $(PYTHON) -m venv $(LOOKERS)
	$(LOOKERS)/bin/python -m pip install --quiet cyclonedx-bom==7.5.0 pip-audit==2.10.1
	@touch $@

sbom: setup $(LOOKERS)/.ready ## write sbom.json: the environment as CycloneDX, checked against its schema
	$(LOOKERS)/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type application --output-reproducible \
		--validate --of JSON -o sbom.json $(BIN)/python

audit-dependencies: $(LOOKERS)/.ready ## known vulnerabilities of what constraints.txt pins (asks pypi.org)
	$(LOOKERS)/bin/pip-audit --strict --no-deps --disable-pip -r constraints.txt

clean: ## remove what the other targets made
	rm -rf .venv $(LOOKERS) $(READERS) sbom.json demo .pytest_cache .mypy_cache .ruff_cache

.PHONY: help setup view readers demo test browser lint benchmark results accuracy-accept licenses sbom audit-dependencies clean
