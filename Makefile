# make demo: install, then train and evaluate a small ray-traced scene.
# make test: install if need be, then what CI runs.   make test-all: every seed, and the viewer's tests in a browser.
# make coverage: lines that the tests run.   make mutants: small faults that the tests
# notice, all in half an hour, or make mutants SAMPLE=40.
# make browser: the viewer, the exported page and other viewers in a headless Chromium (apt-get install chromium); it
# needs a quiet machine.   make browser SCENE=scene.sundae adds a packed capture; by default, that of make demo if any.
# make web: check the page's sources in web/ and build it (Node 20 or newer).
PYTHON ?= python3
WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# Files stay whole, because their tests share trained runs. tests/conftest.py puts long files first.
SIDE_BY_SIDE := --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder

# Tests start some forty processes of Python; compiled modules save each a quarter of a second.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all lint types pytest browser web coverage mutants install clean

install: $(INSTALLED)

# constraints.txt lists the whole set: pip has nothing to resolve, unless pip check finds that this Python needs more.
# pip compiles one file after the other; compileall uses all cores.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' || \
		{ echo "$(PYTHON) is not Python 3.11 or 3.12; name one: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-deps --no-compile --requirement constraints.txt
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/pip check || $(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]"
	$(BIN)/python -m compileall -q -j 0 $(VENV)/lib || true
	touch $@

demo: $(INSTALLED)
	$(BIN)/sundae demo .demo --overwrite

# mypy runs beside pytest; make waits for both and fails if one does.
test: lint
	$(MAKE) --no-print-directory --jobs 2 types pytest

test-all: export SUNDAE_ALL_SEEDS := 1
test-all: test browser

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/mypy

pytest: $(INSTALLED)
	$(BIN)/python -m pytest -q -m "not browser" $(SIDE_BY_SIDE)

# Without npm the checks that need its packages skip themselves.
browser: export SUNDAE_BROWSER_SCENE := $(abspath $(or $(SCENE),$(wildcard .demo/scene.sundae)))
browser: $(INSTALLED) $(if $(shell command -v npm),web/node_modules web/tests/node_modules)
	$(BIN)/python -m pytest -q -m browser

web: web/node_modules
	cd web && npm run --silent check && npm run --silent build

%/node_modules: %/package-lock.json
	cd $* && npm ci --silent --no-audit --no-fund
	touch $@

coverage: $(INSTALLED)
	$(BIN)/coverage erase
	$(BIN)/coverage run -m pytest -q -m "not browser" $(SIDE_BY_SIDE)
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --skip-covered --show-missing

mutants: $(INSTALLED)
	$(BIN)/python benchmarks/mutants.py $(if $(SAMPLE),--sample $(SAMPLE))

clean:
	rm -rf $(VENV) web/node_modules web/tests/node_modules .demo build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage*
