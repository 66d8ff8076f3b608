# `make demo` and `make test` set up everything they need in .venv by themselves.
PYTHON ?= python3
BIN := .venv/bin
# Networks this small train no faster on two threads; two processes side by side do.
export OMP_NUM_THREADS ?= 1

.PHONY: demo test test-all torcs lint docs coverage clean

demo: .venv/.installed
	$(BIN)/sb3-sap demo

test: .venv/.installed
	$(BIN)/pytest -q -n 2 -m "not slow"

test-all: test
	$(BIN)/pytest -q -n 2 -m slow

# The reference simulator, from Debian's packages, without root.
torcs: .venv/.installed
	$(BIN)/sb3-sap torcs check 2>/dev/null || $(BIN)/sb3-sap torcs install

lint: .venv/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --config-file= --ignore-missing-imports benchmarks

# The site, in docs/_build.
docs: .venv/.installed
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build

coverage: .venv/.installed
	$(BIN)/pytest -q -n 2 --cov --cov-report=term-missing:skip-covered

.venv/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e .[dev]
	touch $@

clean:
	rm -rf .venv build dist docs/_build *.egg-info
