# `make run` kits; `make test` tests. Both first make .venv/, once.

# With 3.12 comes a newer Drake, and episodes take a tenth to a fifth less time than with 3.11.
SUPPORTED := import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for python in python3.12 python3 python3.11; do \
  $$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
SCENARIO ?= scenarios/kitting_seen.yaml

.PHONY: run test test-slow lint clean

run: $(READY)
	$(BIN)/python -m kitting_drake.run $(SCENARIO)

test: $(READY)
	$(BIN)/python -m pytest -n 2

test-slow: $(READY)
	$(BIN)/python -m pytest -n 2 -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV)

# The .pth file makes the checkout importable from anywhere.
$(READY): requirements.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(SUPPORTED)' 2>/dev/null || \
	  { echo "error: Python 3.11 or 3.12 is needed, with its venv module (Debian and Ubuntu: apt-get install python3-venv): say 'make PYTHON=/path/to/python3.12'"; exit 2; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.txt
	@$(BIN)/python -c 'import pathlib, sysconfig; pathlib.Path(sysconfig.get_path("purelib"), "kitting_drake.pth").write_text(str(pathlib.Path.cwd()) + "\n")'
	@touch $@
