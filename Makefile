# `make demo` and `make test` set up everything they need in .venv by themselves.
PYTHON ?= python3
BIN := .venv/bin
# Networks this small train no faster on two threads; two processes side by side do.
export OMP_NUM_THREADS ?= 1
# PyPI's torch for Linux is a CUDA build of several gigabytes; PyTorch's own index has one for the CPU, which pip prefers
# for the `+cpu` of its version. `make demo TORCH_INDEX=` takes PyPI's, and a URL any other.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# torch alone is looked up there, and before the rest: an index that cannot be reached then costs a moment, not an error.
TORCH_OPTIONS := --no-deps --retries 1 --timeout 10 $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
PIP_INSTALL := pip install -q --disable-pip-version-check
LOWEST := .venv-lowest/bin
# The release of torch beside the lowest versions of everything else. Of the lowest one, too: LOWEST_TORCH=torch==2.8.0
LOWEST_TORCH ?= -c constraints.txt torch

.PHONY: demo test test-all lowest torcs lint docs coverage release clean

demo: .venv/.installed
	$(BIN)/sb3-sap demo

test: .venv/.installed
	$(BIN)/pytest -q -n 2 -m "not slow"

test-all: test
	$(BIN)/pytest -q -n 2 -m slow

# Every extra, used with the lowest versions that setup.cfg admits, in an environment of their own.
lowest:
	$(PYTHON) -m venv --clear .venv-lowest
	$(LOWEST)/$(PIP_INSTALL) -c constraints.txt uv
	$(LOWEST)/$(PIP_INSTALL) $(TORCH_OPTIONS) $(LOWEST_TORCH)
	$(LOWEST)/uv pip install -q --python .venv-lowest --resolution lowest-direct -e .[dev,sbx]
	$(LOWEST)/python tests/lowest.py

# The reference simulator, from Debian's packages, without root.
torcs: .venv/.installed
	$(BIN)/sb3-sap torcs check 2>/dev/null || $(BIN)/sb3-sap torcs install

lint: .venv/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --config-file= --ignore-missing-imports measurements

# The site, in docs/_build.
docs: .venv/.installed
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build

coverage: .venv/.installed
	$(BIN)/pytest -q -n 2 --cov --cov-report=term-missing:skip-covered

# The version, the archives in dist/, a commit and a tag; CONTRIBUTING.md has the checklist around it.
release: .venv/.installed
	$(BIN)/python .ci/release.py "$(VERSION)"

.venv/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/$(PIP_INSTALL) $(TORCH_OPTIONS) -c constraints.txt torch
	$(BIN)/$(PIP_INSTALL) -c constraints.txt -e .[dev]
	touch $@

clean:
	rm -rf .venv .venv-lowest build dist docs/_build *.egg-info
