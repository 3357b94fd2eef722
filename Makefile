# SPDX-License-Identifier: Apache-2.0
# `make run` drives past a simulated street, live; `make test` runs every check. Both set themselves up.
# make run ARGS=--view: with the viewer's page beside it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
OUT ?= out/run
ARGS ?=

.PHONY: run test slow lint clean

run: $(VENV)/.edge
	$(BIN)/rfconstruct-train street --out $(OUT) $(ARGS)

test: $(VENV)/.test lint
	$(BIN)/python -m pytest

slow: $(VENV)/.test
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/mypy

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "RFconstruct needs Python 3.11 or newer, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)

EDGE := requirements/edge.txt requirements/plot.txt requirements/import.txt requirements/view.txt requirements/build.txt
$(VENV)/.edge: $(BIN)/python pyproject.toml $(EDGE)
	$(PIP) $(EDGE:%=-r %)
	$(PIP) --no-deps --no-build-isolation --editable .
	touch $@

$(VENV)/.test: $(VENV)/.edge requirements/train.txt requirements/dev.txt
	$(PIP) -r requirements/train.txt -r requirements/dev.txt
	touch $@

clean:
	rm -rf $(VENV) out .pytest_cache .mypy_cache .ruff_cache
