# `make demo` and `make test` set up their own environment in .venv; nothing outside this folder is written.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
WORKERS := --numprocesses auto --dist loadscope

.PHONY: demo test test-fast lint docs notebooks bench papers blind wheel-check clean

$(STAMP): pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed; run make PYTHON=python3.x" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	touch $@

demo: $(STAMP)
	$(BIN)/python examples/demo.py demo-output

# All tests, with a worker on each core. Tests of one module stay together, because they share fixtures.
test: $(STAMP) lint
	$(BIN)/python -m pytest $(WORKERS)

# For development: all tests but those marked slow.
test-fast: $(STAMP) lint
	$(BIN)/python -m pytest $(WORKERS) -m "not slow"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/html

notebooks: $(STAMP)
	$(BIN)/sphinx_gallery_py2jupyter examples/[0-9]_*.py

bench: $(STAMP)
	$(BIN)/python benchmarks/speed.py

papers: $(STAMP)
	$(BIN)/python benchmarks/papers/run.py

blind: $(STAMP)
	mkdir -p blind-benchmark
	$(BIN)/python -m benchmarks.blind.generate blind-benchmark/recordings blind-benchmark/keys --workers 2
	$(BIN)/python -m benchmarks.blind.score blind-benchmark/recordings blind-benchmark/keys/keys.json blind-benchmark/out --page docs/results/blind_benchmark.md

wheel-check: $(STAMP)
	$(BIN)/python benchmarks/wheel.py

clean:
	rm -rf $(VENV) demo-output docs/html docs/api docs/gallery
