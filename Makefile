# Everything runs from .venv, which the first target that needs it makes.
PYTHON ?= python3.11
EXTRAS ?= dev
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed-$(EXTRAS)
DEMO ?= demo
BENCHMARKS := $(filter-out benchmarks/common.py,$(wildcard benchmarks/*.py))

.PHONY: help install demo test test-system check bench proto
.DEFAULT_GOAL := help

help:
	@echo "make demo         draw a small fleet, map it, say where the map is"
	@echo "make test         the tests that need nothing but this folder"
	@echo "make test-system  the tests on real recordings (set FCSLAM_DATA to their folder)"
	@echo "make check        linter, formatting, types"
	@echo "make bench        the benchmarks; those on recordings only if FCSLAM_DATA names their folder"
	@echo "make install      .venv alone; EXTRAS=dev,train,federated,sim,foxglove for more"
	@echo "make proto        generate the wire format's Python code anew"

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@echo "Installing fcslam[$(EXTRAS)] into $(VENV); the first time takes about a minute."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

demo: $(INSTALLED)
	@$(BIN)/fcslam demo --output $(DEMO)

test: $(INSTALLED)
	@$(BIN)/python -m pytest -m "not system"

test-system: $(INSTALLED)
	@$(BIN)/python -m pytest -m system -rs

check: $(INSTALLED)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

bench: $(INSTALLED)
	@set -e; for script in $(BENCHMARKS); do echo "$$script"; $(BIN)/python "$$script"; done

proto: $(INSTALLED)
	@cd src && ../$(BIN)/python -m grpc_tools.protoc --proto_path=. --python_out=. --pyi_out=. fcslam/wire/*.proto
