# Every target works as the first command in a fresh checkout: what it needs is installed first, into $(VENV).
#   make test                       with python3
#   make test PYTHON=python3.13     with another; $(VENV) is made anew when its interpreter differs
#   make test ARGS='-k startup'     more arguments for the command

PYTHON  ?= python3
VENV    ?= .venv
WORKERS ?= 2
DAY     ?= $(shell date -u +%F)
WITHIN  ?= 600
ARGS    ?=

IN_VENV := $(VENV)/bin
# As "3.11.7"; empty when there is no such command.
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null)
READY   := $(VENV)/.ready-$(VERSION)
PYTEST  := $(IN_VENV)/python -m pytest -n $(WORKERS) --dist loadfile

.PHONY: help demo workbench test test-all test-nightly test-today lint bench docs clean
.DELETE_ON_ERROR:

help:  ## this list
	@grep -hE '^[a-z%-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z%-]+):[^#]*## /  make \1	/'

demo: $(READY)  ## calibrate the simulated gyroscope; results in demo_output/
	$(IN_VENV)/bayescal demo --out demo_output $(ARGS)

workbench: $(READY)-workbench  ## the loop in a browser, on the demonstration's campaign
	mkdir -p demo_output
	$(IN_VENV)/bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --seed 1 --out demo_output/campaign.csv
	$(IN_VENV)/bayescal simulate --instrument mems_gyro --effect bias.thermal_lag=0.05 --seed 2 --out demo_output/later.csv
	$(IN_VENV)/bayescal workbench demo_output/campaign.csv --instrument mems_gyro \
	  --holdout demo_output/later.csv --out demo_output/workbench $(ARGS)

test: $(READY)-test  ## the fast tests: what a change must pass
	$(PYTEST) $(ARGS)

test-all: $(READY)-test  ## fast and slow ones
	$(PYTEST) -m "not nightly" $(ARGS)

test-nightly: $(READY)-test-nightly  ## those that kill processes, fill disks, start clusters and servers, or execute pages
	$(PYTEST) -m nightly $(ARGS)

test-today: $(READY)-test-nightly  ## of slow and nightly ones those whose turn it is on DAY; none begins after WITHIN seconds
	$(PYTEST) --no-loadscope-reorder -m "slow or nightly" --day $(DAY) --within $(WITHIN) $(ARGS)

lint: $(READY)-test-lint  ## format, lint rules and types
	$(IN_VENV)/ruff format --check .
	$(IN_VENV)/ruff check .
	$(IN_VENV)/pyright --pythonpath $(IN_VENV)/python

bench: $(READY)-test-bench  ## measure what is missing of every benchmark, and write its page
	$(IN_VENV)/python -m benchmarks $(ARGS)

bench-%: $(READY)-test-bench  ## one benchmark, such as bench-hidden-effects; goes on where it was stopped
	$(IN_VENV)/python -m benchmarks $(subst -,_,$*)

docs: $(READY)-docs  ## the documentation site, into site/
	$(IN_VENV)/python docs/build_site.py

clean:  ## remove what these targets made
	rm -rf $(VENV) build dist demo_output site .cache .pytest_cache .hypothesis .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# One stamp per interpreter and its groups: .ready-3.11.7, .ready-3.11.7-test, .ready-3.11.7-test-lint.
$(READY) $(READY)-workbench $(READY)-test $(READY)-test-nightly $(READY)-test-lint $(READY)-test-bench $(READY)-docs: \
  pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "bayescal needs Python 3.11 or later; '$(PYTHON)' is $(or $(VERSION),not a command here)." >&2; \
	  echo "Name another one: make $(MAKECMDGOALS) PYTHON=python3.13" >&2; exit 1; }
	@[ "$$($(IN_VENV)/python -c 'import platform; print(platform.python_version())' 2>/dev/null)" = "$(VERSION)" ] \
	  || { echo "making $(VENV) with Python $(VERSION)"; $(PYTHON) -m venv --clear $(VENV); }
	@# Groups of pyproject.toml are read by pip 25.1, which no venv of Python 3.11 to 3.13 begins with.
	$(IN_VENV)/python -m pip install --quiet --no-compile --upgrade 'pip>=25.1'
	$(IN_VENV)/python -m pip install --quiet --no-compile \
	  -e '.$(if $(findstring -workbench,$(notdir $@)),[workbench])' $(foreach group,$(GROUPS_OF_STAMP),--group $(group))
	@# pip would compile to bytecode on one core, and what nothing here imports too: half of an installation. What is of
	@# another Python, as templates are, does not compile and need not.
	@$(IN_VENV)/python -m compileall -qq -j 0 -x '/site-packages/(.*/tests?|$(UNUSED))/' $(VENV)/lib || true
	@touch $@

GROUPS_OF_STAMP = $(foreach group,test nightly lint bench docs,$(if $(findstring -$(group),$(notdir $@)),$(group)))
UNUSED := pymavlink/dialects|setuptools|pip|debugpy|IPython|jedi|playwright
