# `make demo` and `make test` set up everything they need in .venv by themselves.
PYTHON ?= python3
BIN := .venv/bin
# Networks this small train no faster on two threads; two processes side by side do.
export OMP_NUM_THREADS ?= 1

# RL Zoo, in two steps: parts of it ask for a pillow and a python-dateutil older than the pinned ones, with which they
# work as well, and pip would refuse. `pip install sb3-sap[zoo]`, without the pins, takes the older ones.
ZOO := rl_zoo3 sb3-team-hf-integration moviepy pytablewriter DataProperty tabledata typepy
ZOO_NEEDS := optuna requests seaborn shimmy huggingface_hub wasabi mbstrdecoder pathvalidate tcolorpy ImageIO \
	imageio-ffmpeg proglog python-dotenv decorator "psycopg[binary]"

.PHONY: demo test test-all torcs lint coverage clean

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

coverage: .venv/.installed
	$(BIN)/pytest -q -n 2 --cov --cov-report=term-missing:skip-covered

.venv/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e .[dev] $(ZOO_NEEDS)
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt --no-deps $(ZOO)
	touch $@

clean:
	rm -rf .venv build dist *.egg-info
