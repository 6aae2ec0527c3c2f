# Every target sets up .venv by itself. Needed beforehand: Python 3.11 or newer, git, make.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SOURCES := cli.py cadence pipeline schemas tests benchmarks docs/generate.py
DEMO := out/demo
COVERAGE := out/coverage.json
LINES := out/lines
PARALLEL := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help setup demo test suite lint style types check ray fix docs bench clean

help:  ## Show this list.
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

setup: $(STAMP)  ## Make or update .venv with the pinned dependencies.

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: Python 3.11 or newer not found; install it or call make PYTHON=/path/to/python" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV) (the first time downloads PyTorch) ..."
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP)  ## Simulate a mission, run the whole pipeline on it, say where to look.
	$(BIN)/cadence simulate --out $(DEMO)/logs --seed 13
	$(BIN)/cadence run $(DEMO)/logs/*.mcap --out $(DEMO)/results
	@echo
	@echo "Look at:"
	@echo "  report      $$(ls $(DEMO)/results/*/report.html)    (any browser)"
	@echo "  in Foxglove $$(ls $(DEMO)/logs/*.mcap) together with $$(ls $(DEMO)/results/*/*.cadence.mcap)"
	@echo "  layout      $$(ls $(DEMO)/results/*/*.layout.json | head -1)    (Foxglove: Layouts, Import from file)"
	@echo "Next:"
	@echo "  $(BIN)/cadence evaluate $(DEMO)/results"
	@echo "  $(BIN)/cadence info YOUR_LOG.mcap"
	@echo "  $(BIN)/cadence run YOUR_LOG.mcap --out out/mine"

test: style  ## Lint, types, all tests, and no package less tested than before: what continuous integration runs.
	$(MAKE) --no-print-directory -j2 suite types
	$(BIN)/python tests/coverage_floors.py $(COVERAGE)

# Types are checked beside the tests, as that takes one core a minute. From 3.12 on Python's own monitoring counts lines for little;
# before, tests/lines does.
suite: $(STAMP)
	@rm -rf $(LINES) && mkdir -p $(LINES)
	if $(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 12))'; then \
		COVERAGE_CORE=sysmon $(BIN)/python -m pytest $(PARALLEL) --cov --cov-report=json:$(COVERAGE); \
	else \
		CADENCE_LINES="$(CURDIR)/$(LINES)" PYTHONPATH="$(CURDIR)/tests/lines$${PYTHONPATH:+:$$PYTHONPATH}" \
			$(BIN)/python -m pytest $(PARALLEL) && $(BIN)/python tests/lines/line_report.py $(LINES) $(COVERAGE); \
	fi

lint: style types  ## Lint, format check, types.

style: $(STAMP)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

types: $(STAMP)
	$(BIN)/mypy

check: lint  ## Lint, format check, types, fast tests.
	$(BIN)/python -m pytest -q tests/test_layers.py tests/test_api.py tests/test_docs.py tests/test_cli.py tests/pipeline tests/cadence

ray: $(STAMP)  ## Install Ray, and test its engine on a Ray of this machine.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,ray]'
	$(BIN)/python -m pytest tests/pipeline/batch/test_ray_engine.py tests/pipeline/test_kill.py -k ray

fix: $(STAMP)  ## Let ruff mend what it can, and format.
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

docs: $(STAMP)  ## Write docs/cli.md and docs/configuration.md from the code.
	$(BIN)/python docs/generate.py

bench: $(STAMP)  ## Run every benchmark script; each prints its section of a page.
	@for name in $$($(BIN)/python -c 'from benchmarks.publishing import PAGES; print(*sum(PAGES.values(), ()))'); do \
		echo "== $$name"; $(BIN)/python -m benchmarks.$$name || exit 1; done

clean:  ## Remove what was built and written here; keeps .venv.
	rm -rf build dist out *.egg-info .coverage* .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
