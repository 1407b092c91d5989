PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out

.PHONY: demo test test-all lint clean

demo: $(VENV)/installed
	$(BIN)/stereo-ore run data/paper_03 --calib data/paper_03/calibration.yaml --site data/paper_03/site.yaml \
	    --out $(OUT)/demo --overwrite

test: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-all: $(VENV)/installed
	$(BIN)/python -m pytest -n 2

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/installed: pyproject.toml
	@.ci/system-libraries
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) || { echo "as root: apt-get install python3-venv" >&2; exit 1; }
	$(BIN)/pip install -q -e ".[test]"
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/pip install -q -e ".[dev]"
	@touch $@

clean:
	rm -rf $(VENV) $(OUT)
