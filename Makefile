# The whole developer interface. Each target makes the environment it needs; `make` alone lists them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NAME ?=
# A file's tests share what is costly to set up, so they stay on one core; in the order of their names, the long ones come first.
SPREAD := -n auto --dist loadfile --no-loadscope-reorder

# Without kept bytecode each of the hundred processes that tests, demo and service start would compile gonio anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo serve test check bench gate docs format lock reference clean

help:  ## list the targets
	@grep -hE '^[a-z]+:.*?## ' $(MAKEFILE_LIST) | awk -F':.*?## ' '{printf "  make %-8s %s\n", $$1, $$2}'

demo: $(VENV)/runtime $(VENV)/dashboard  ## four real videos in over HTTP, a gait report out
	$(BIN)/gonio demo --output build/demo

serve: $(VENV)/runtime $(VENV)/dashboard  ## start the service on 127.0.0.1:8000
	$(BIN)/gonio serve

test: $(VENV)/dev $(VENV)/dashboard  ## all tests
	$(BIN)/python -m pytest $(SPREAD) $(ARGS)

check: $(VENV)/dev  ## format, lint, types, import contracts, unit and law tests
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q $(SPREAD) -m "not slow" tests/unit tests/laws tests/architecture

bench: $(VENV)/dev  ## accuracy and speed against the rivals; NAME=keypoints for one
	$(BIN)/gonio bench $(NAME)

gate: $(VENV)/dev  ## is what `make bench` measured as exact as the committed baseline?
	$(BIN)/gonio bench $(NAME) --check

docs: $(VENV)/dev reference  ## the documentation as a site, in build/site
	PYTHONPATH=docs/tools $(BIN)/zensical build --strict --clean

format: $(VENV)/dev  ## format and mend what ruff can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lock: $(VENV)/dev  ## pin every dependency again, hashed, naming no index
	$(BIN)/python -m pip install -q uv
	$(BIN)/uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --quiet \
	  --extra models --group build pyproject.toml -o requirements.lock
	$(BIN)/uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header --quiet \
	  --group dev --group build --extra models -c requirements.lock pyproject.toml -o requirements-dev.lock

reference: $(VENV)/dev  ## write the pages that are made from the code
	$(BIN)/python docs/generate.py

clean:  ## remove what the build made
	rm -rf build dist $(VENV)

# A stamp a kind: the environment is made again when its lock changes.
$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("gonio needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Try: make PYTHON=python3.11") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)

$(VENV)/runtime: requirements.lock pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

# Vite puts the page beside the code that serves it, where the wheel takes it from.
$(VENV)/dashboard: $(addprefix service/dashboard/,package-lock.json index.html vite.config.ts) $(shell find service/dashboard/src -type f) | $(BIN)/python
	npm ci --prefix service/dashboard --silent --no-fund --no-audit
	npm run build --prefix service/dashboard --silent
	touch $@

$(VENV)/dev: requirements-dev.lock $(VENV)/runtime
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements-dev.lock
	touch $@
