# Everything runs from here: `make run` on a fresh machine with git, make and python3 is enough.
PYTHON_VENV := .venv/bin/python
ARGS ?= scenario=E sensor=bosch

.DEFAULT_GOAL := help
.PHONY: help setup run test test-fast lint format

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup:  ## Make .venv with all packages, and install the system libraries that Open3D needs
	@scripts/setup.sh

run: setup  ## Simulate a campaign and run SLAM on it; ARGS="scenario=A sensor=velodyne" for others
	$(PYTHON_VENV) scripts/run.py $(ARGS)

test: setup  ## Run all tests
	$(PYTHON_VENV) -m pytest -n auto --dist loadfile

test-fast: setup  ## Run the tests that take less than about five seconds
	$(PYTHON_VENV) -m pytest -m "not slow"

lint: setup  ## Check style and types
	$(PYTHON_VENV) -m ruff check .
	$(PYTHON_VENV) -m ruff format --check .
	$(PYTHON_VENV) -m mypy

format: setup  ## Put the code into its agreed form
	$(PYTHON_VENV) -m ruff check --fix .
	$(PYTHON_VENV) -m ruff format .
