# Everything is installed into .venv, from python3 (>= 3.11) and make alone.
PYTHON ?= python3
BIN := .venv/bin
ARGS ?=

.PHONY: demo road-test test test-all check bench picture clean

demo: .venv/installed  ## ten simulated minutes of driving, replayed: the table
	$(BIN)/egoloc demo $(ARGS)

road-test: .venv/installed  ## 16,500 simulated kilometres; goes on where it was stopped
	$(BIN)/egoloc replay scenario:road-test,drives=550 --out runs/road-test --states-hz 1 --decisions rejected --resume $(ARGS)

test: .venv/installed-dev  ## the fast tests
	$(BIN)/pytest $(ARGS)

test-all: .venv/installed-dev  ## also the slow ones
	$(BIN)/pytest -m "slow or not slow" $(ARGS)

check: .venv/installed-dev  ## what pre-commit checks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed-bench  ## speed, side by side with other libraries
	$(BIN)/egoloc bench filter $(ARGS)
	$(BIN)/egoloc bench live $(ARGS)
	$(BIN)/egoloc bench mcap $(ARGS)
	$(BIN)/egoloc bench replay $(ARGS)
	$(BIN)/egoloc bench maps $(ARGS)

picture: .venv/installed  ## docs/images/view.png; needs a Vulkan driver (Debian: mesa-vulkan-drivers)
	$(BIN)/egoloc demo --out runs/demo
	$(BIN)/egoloc view runs/demo --no-open
	$(BIN)/python docs/picture.py runs/demo/run.rrd docs/images/view.png 155

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --editable .
	touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/pip install --quiet --editable ".[dev]"
	touch $@

.venv/installed-bench: .venv/installed-dev
	$(BIN)/pip install --quiet --editable ".[bench]"
	touch $@
