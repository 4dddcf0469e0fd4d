# make demo [SCENE=path]   the main job on a scene, from a fresh machine to the results table
# make test [JOBS=n]       everything the tests need, then linters and tests in n processes (2)
# make test-fast           the tests that neither are slow nor need a service, in JOBS processes; no linters
# make bench               the figures of docs/benchmarks.md
# make up                  the embedded service in the foreground, with the guide (built where it is older than its pages)
# make lock [UPGRADE=name] write requirements.lock anew; UPGRADE=all moves every package to its newest release
# make catalogue           schemas/catalogue.json and the tables of it in docs/
# make docs                the guide of docs/, which a running service serves at /docs/guide
# make reference           docs/reference/, made of the command line's parser and of the catalogue
# make wheels              both distributions in dist/, with the guide in them
# make sdk                 the synchronous half of the SDK, made of the asynchronous one
# make audit               the SBOM (build/sbom.cdx.json), and known vulnerabilities of the locked packages
SHELL := /bin/bash
SCENE ?= sample/soft_beam
DATA ?= .demo
JOBS ?= 2
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1
SITE ?= services/guide/site
MKDOCS := NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --clean --site-dir $(SITE)

.PHONY: demo test test-fast bench lint lint-types lint-style lint-imports lint-security up clean install dev catalogue docs reference wheels sdk lock audit

install:
	@scripts/bootstrap.sh

dev:
	@scripts/bootstrap.sh --dev

demo: install
	@$(BIN)/physworld run "$(SCENE)" --data "$(DATA)" --json "$(DATA)/report.json"

up: install $(SITE)/index.html
	@exec $(BIN)/physworld up --data "$(DATA)"

lint: dev
	@$(MAKE) --no-print-directory --jobs=2 lint-types lint-style lint-imports lint-security

lint-types:
	$(BIN)/mypy

lint-style:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

lint-imports:
	$(BIN)/lint-imports

lint-security:
	$(BIN)/bandit --quiet --recursive --configfile pyproject.toml physworld scenes schemas storage workers services clients/python

# what the tests start, processes of the service above all, finds its modules compiled, whatever the shell says
test test-fast: export PYTHONDONTWRITEBYTECODE :=

test: lint
	$(BIN)/python -m pytest --numprocesses=$(JOBS) --dist=loadfile --no-loadscope-reorder

test-fast: dev
	$(BIN)/python -m pytest --numprocesses=$(JOBS) --dist=loadfile --no-loadscope-reorder --durations=10 -m "not slow and not service and not browser"

bench:
	@scripts/bootstrap.sh --bench
	$(BIN)/python -m benchmarks

catalogue: dev
	$(BIN)/python -m scripts.catalogue

docs: dev
	$(MKDOCS) --strict

# a service runs without its guide too: a page that does not build stops nothing
$(SITE)/index.html: mkdocs.yml scripts/guide_pages.py README.md CONTRIBUTING.md CHANGELOG.md SECURITY.md $(shell find docs -type f) | install
	-@$(MKDOCS) --quiet && echo "guide: built"

reference: dev
	$(BIN)/python -m scripts.make_reference

wheels: docs
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist . ./clients/python

sdk: dev
	$(BIN)/python scripts/make_sdk.py

lock:
	@test -x $(BIN)/python || python3 -m venv .venv
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/python scripts/lock.py --upgrade "$(UPGRADE)"

audit: dev
	@mkdir -p build
	$(BIN)/cyclonedx-py requirements --output-file build/sbom.cdx.json requirements.lock
	$(BIN)/pip-audit --requirement requirements.lock --disable-pip --no-deps --strict

clean:
	rm -rf .venv .bootstrap .demo .pytest_cache .ruff_cache .mypy_cache .hypothesis .import_linter_cache build services/guide/site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -name '*.egg-info' -type d -prune -exec rm -rf {} +
