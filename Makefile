# make demo [SCENE=path]   the main job on a scene, from a fresh machine to the results table
# make test [JOBS=n]       everything the tests need, then linters and tests in n processes (2)
# make bench               the figures of docs/benchmarks.md
# make up                  the embedded service in the foreground
SHELL := /bin/bash
SCENE ?= sample/soft_beam
DATA ?= .demo
JOBS ?= 2
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1

.PHONY: demo test bench lint up clean install dev

install:
	@scripts/bootstrap.sh

dev:
	@scripts/bootstrap.sh --dev

demo: install
	@$(BIN)/physworld run "$(SCENE)" --data "$(DATA)" --json "$(DATA)/report.json"

up: install
	@exec $(BIN)/physworld up --data "$(DATA)"

lint: dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/python -m pytest --numprocesses=$(JOBS) --dist=loadfile

bench:
	@scripts/bootstrap.sh --bench
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv .bootstrap .demo .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -name '*.egg-info' -type d -prune -exec rm -rf {} +
