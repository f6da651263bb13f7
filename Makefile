# make demo       throw the bunny (examples/throw_bunny.py)
# make examples   all examples, each of which checks itself; pictures in out/
# make notebooks  run examples/notebooks/*.py and write them to .ipynb with their outputs
# make test       C++ and Python tests, the latter against the installed package
# make sanitize   C++ tests in a Debug build with address and undefined-behaviour sanitizers
# make lint       formatting, lint, types
# make bench      every benchmark, one CSV line per run
# make clean      remove .venv, build/ and caches
#
# Needs Python >= 3.10 with venv, a C++17 compiler and make; all else is installed into .venv.
# Each step leaves a stamp in .venv, so that a second run does only what changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export PATH := $(CURDIR)/$(BIN):$(PATH)
unexport PYTHONPATH

INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
CONFIGURE := $(BIN)/cmake -S . -G Ninja "-DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python" \
             -DDIFFSIM_BUILD_PYTHON=OFF -DDIFFSIM_BUILD_TESTS=ON -DDIFFSIM_WERROR=ON
CTEST := $(BIN)/ctest --output-on-failure --parallel 2 --test-dir

# As pyproject.toml lists them under build-system, and what the C++ tests need besides.
BUILD_TOOLS := scikit-build-core pybind11 cmeel-eigen cmake ninja
SOURCES := pyproject.toml CMakeLists.txt \
           $(shell find csrc diffsim -type f ! -path '*/__pycache__/*' ! -name '_core*.so')
CXX_FILES = $(shell find csrc tests/cpp -name '*.[ch]pp')

.PHONY: demo examples notebooks test test-cpp test-python sanitize lint format bench clean
.NOTPARALLEL:

demo: $(VENV)/.with-examples
	$(BIN)/python examples/throw_bunny.py

examples: $(VENV)/.with-examples
	@for script in $(sort $(wildcard examples/[a-z]*.py)); do echo $$script; $(BIN)/python $$script || exit 1; done

notebooks: $(VENV)/.with-notebooks
	$(BIN)/python examples/notebooks/execute.py

test: test-cpp test-python

test-cpp: $(VENV)/.build-tools
	$(CONFIGURE) -B build/test -DCMAKE_BUILD_TYPE=RelWithDebInfo
	$(BIN)/cmake --build build/test
	$(CTEST) build/test

# From within .venv, where Python finds the installed diffsim and not the one in the source tree.
test-python: $(VENV)/.with-test
	cd $(VENV) && bin/pytest ../tests/python

sanitize: $(VENV)/.build-tools
	$(CONFIGURE) -B build/sanitize -DCMAKE_BUILD_TYPE=Debug -DDIFFSIM_SANITIZE=ON
	$(BIN)/cmake --build build/sanitize
	$(CTEST) build/sanitize

lint: $(VENV)/.with-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run --Werror $(CXX_FILES)
	$(BIN)/mypy

format: $(VENV)/.with-dev
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i $(CXX_FILES)

bench: $(VENV)/.with-bench
	@for script in $(sort $(wildcard benchmarks/[a-z]*.py)); do $(BIN)/python $$script || exit 1; done

clean:
	rm -rf .venv build .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.build-tools: constraints.txt | $(BIN)/python
	$(INSTALL) $(BUILD_TOOLS)
	@touch $@

# The package and one of its extras. Without build isolation: only what changed is compiled again, with pinned tools.
$(VENV)/.with-%: $(SOURCES) $(VENV)/.build-tools
	$(INSTALL) --no-build-isolation --config-settings=build-dir=build/wheel ".[$*]"
	@touch $@
