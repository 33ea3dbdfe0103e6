# Everything sets itself up in .venv and is quick when that stands. PYTHON chooses the interpreter (3.11 or newer).
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BENCH_VENV := .venv-bench
RUN := $(VENV)/bin
READY := $(VENV)/.ready
BENCH_READY := $(BENCH_VENV)/.ready
TEST_JOBS ?= 2

.DEFAULT_GOAL := help
.PHONY: help demo test lint docs bench clean

help:
	@echo "make demo   simulate a walking talker, track, score and draw it  (AUDIO=file ARRAY=array.yaml: your own recording)"
	@echo "make test   run the tests"
	@echo "make lint   ruff and mypy --strict"
	@echo "make docs   build the documentation; a warning is an error"
	@echo "make bench  speed and memory beside other libraries, in an environment of its own"

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --upgrade pip
	$(RUN)/python -m pip install --quiet --editable '.[all]'
	touch $@

$(BENCH_READY): pyproject.toml
	$(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet --upgrade pip
	$(BENCH_VENV)/bin/python -m pip install --quiet --editable '.[bench]'
	@# it asks for Python 3.12 and for what it does not import; without it its rows have no figure
	-$(BENCH_VENV)/bin/python -m pip install --quiet --ignore-requires-python --no-deps pydpf
	touch $@

# AUDIO, ARRAY and SPEECH are files; OUT is the folder for what comes out.
OUT ?= build/demo
demo: $(READY)
	$(RUN)/python -m experiments.demo --out '$(OUT)' \
		$(if $(AUDIO),--audio '$(AUDIO)') $(if $(ARRAY),--array '$(ARRAY)') $(if $(SPEECH),--speech '$(SPEECH)')

# One thread a test process: two that compete for two cores can be many times slower.
test: $(READY)
	OMP_NUM_THREADS=1 $(RUN)/python -m pytest -n $(TEST_JOBS) $(PYTEST_ARGS)

lint: $(READY)
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

docs: $(READY)
	$(RUN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo "documentation: build/docs/index.html"

bench: $(BENCH_READY)
	$(BENCH_VENV)/bin/python -m benchmarks $(BENCH_ARGS)

clean:
	rm -rf build .mypy_cache .pytest_cache .ruff_cache
