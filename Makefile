# make demo       throw the bunny (examples/throw_bunny.py)
# make examples   all examples, two at a time, each of which checks itself; pictures, results and what they say in out/
# make notebooks  run examples/notebooks/*.py and write them to .ipynb with their outputs
# make test       C++ and Python tests, the latter against the installed package
# make check      after a change: what it touches is compiled and tested, the rest and all that is slow is left out
# make sanitize   C++ tests in a Debug build with address and undefined-behaviour sanitizers
# make lint       formatting, lint, types, lengths of files and functions
# make docs       the documentation as a site, build/docs/index.html
# make bench      every benchmark, one CSV line per run
# make report     error against run time beside MuJoCo, docs/report/; then the limits, docs/limits.md
# make clean      remove .venv, build/ and caches
#
# Needs Python >= 3.10 with venv, a C++17 compiler and make; all else is installed into .venv.
# Each step leaves a stamp in .venv, so that a second run does only what changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export PATH := $(CURDIR)/$(BIN):$(PATH)
unexport PYTHONPATH

# Not byte-compiled: Python does that with what is imported, which is a small part of torch, and once.
INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile --constraint constraints.txt
# ON: a folder of the core is one unit, as a folder of tests always is. From nothing that takes much less; after a change
# in one file, longer: UNITY=OFF for work in one of them.
UNITY ?= ON
TREE := DIFFSIM_BUILD_TESTS=ON DIFFSIM_WERROR=ON DIFFSIM_LTO=OFF DIFFSIM_PRECOMPILE=ON DIFFSIM_GROUP_TESTS=ON \
        CMAKE_UNITY_BUILD=$(UNITY) $(if $(shell command -v ccache),CMAKE_CXX_COMPILER_LAUNCHER=ccache)
export CCACHE_SLOPPINESS := pch_defines,time_macros
CONFIGURE := $(BIN)/cmake -S . -G Ninja "-DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python" -DDIFFSIM_BUILD_PYTHON=OFF \
             $(TREE:%=-D%)
CTEST := $(BIN)/ctest --output-on-failure --parallel 2 --test-dir
# One thread of torch and BLAS for each worker: they share the processors.
PYTEST := OMP_NUM_THREADS=1 $(CURDIR)/$(BIN)/pytest --numprocesses auto --dist worksteal

# As pyproject.toml lists them under build-system, and what the C++ tests need besides.
BUILD_TOOLS := scikit-build-core pybind11 cmeel-eigen cmake ninja
# As pyproject.toml lists them under dev, and what mypy reads the types of.
LINT_TOOLS := clang-format mypy ruff torch numpy trimesh
# As pyproject.toml lists them under docs.
DOCS_TOOLS := furo myst-nb sphinx
SOURCES := pyproject.toml CMakeLists.txt \
           $(shell find csrc diffsim -type f ! -path '*/__pycache__/*' ! -name '_core*.so')
EXAMPLES ?= $(sort $(notdir $(basename $(wildcard examples/[a-z]*.py))))
CXX_FILES = $(shell find csrc tests/cpp -name '*.[ch]pp')

.PHONY: demo examples notebooks test test-cpp test-python check sanitize lint format docs bench report clean
.NOTPARALLEL:

demo: $(VENV)/.with-examples
	$(BIN)/python examples/throw_bunny.py

examples: $(VENV)/.with-examples $(VENV)/.with-rl
	@mkdir -p out && printf '%s\n' $(EXAMPLES) | OMP_NUM_THREADS=1 xargs -P 2 -I NAME sh -c \
	    '$(BIN)/python examples/NAME.py > out/NAME.log 2>&1; code=$$?; \
	    grep "^FAIL " out/NAME.log; echo "NAME: $$(tail -n 1 out/NAME.log)"; exit $$code'

notebooks: $(VENV)/.with-notebooks
	$(BIN)/python examples/notebooks/execute.py

test: test-cpp test-python

test-cpp: $(VENV)/.with-test
	$(CTEST) build/test

# From within .venv, where Python finds the installed diffsim and not the one in the source tree.
test-python: $(VENV)/.with-test
	cd $(VENV) && $(PYTEST) --durations=20 ../tests/python

# In the tree of the tests, whose package is not installed again: Python takes the one in the source tree.
check: $(VENV)/.once-tested
	$(BIN)/cmake --build build/test
	cp build/test/_core*.so diffsim/
	$(CTEST) build/test --tests-regex "$$($(BIN)/python tests/touched.py cpp)"
	PYTHONPATH=$(CURDIR) $(PYTEST) -m "not slow" $$($(BIN)/python tests/touched.py python)

sanitize: $(VENV)/.build-tools
	$(CONFIGURE) -B build/sanitize -DCMAKE_BUILD_TYPE=Debug -DDIFFSIM_SANITIZE=ON
	$(BIN)/cmake --build build/sanitize
	$(CTEST) build/sanitize

lint: $(VENV)/.lint-tools
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/clang-format --dry-run --Werror $(CXX_FILES)
	$(BIN)/mypy
	$(BIN)/python tests/python/test_sizes.py

format: $(VENV)/.lint-tools
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i $(CXX_FILES)

docs: $(VENV)/.with-test $(VENV)/.docs-tools
	$(BIN)/sphinx-build --quiet --fresh-env --fail-on-warning --keep-going docs build/docs

bench: $(VENV)/.with-bench
	@for script in $(sort $(wildcard benchmarks/[a-z]*.py)); do $(BIN)/python $$script || exit 1; done

report: $(VENV)/.with-bench
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/work_precision.py --out docs/report
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/limits.py --out docs

clean:
	rm -rf .venv build .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.build-tools: constraints.txt | $(BIN)/python
	$(INSTALL) $(BUILD_TOOLS)
	@touch $@

# What the tests need, whatever changed since.
$(VENV)/.once-tested:
	$(MAKE) $(VENV)/.with-test
	@touch $@

$(VENV)/.lint-tools: constraints.txt | $(BIN)/python
	$(INSTALL) $(LINT_TOOLS)
	@touch $@

$(VENV)/.docs-tools: constraints.txt | $(BIN)/python
	$(INSTALL) $(DOCS_TOOLS)
	@touch $@

# The package and one of its extras. Without build isolation: only what changed is compiled again, with pinned tools. Builds
# with and without link-time optimization take each other's place, and with it their stamps.
$(VENV)/.with-%: $(SOURCES) $(VENV)/.build-tools
	$(INSTALL) --no-build-isolation --config-settings=build-dir=build/wheel ".[$*]"
	@rm -f $(VENV)/.with-test
	@touch $@

# In one tree with the C++ tests, and without link-time optimization, which takes long and changes no bit.
$(VENV)/.with-test: $(SOURCES) $(shell find tests/cpp -type f) $(VENV)/.build-tools
	$(INSTALL) --no-build-isolation --config-settings=build-dir=build/test \
	    $(TREE:%=--config-settings=cmake.define.%) ".[test]"
	@rm -f $(VENV)/.with-*
	@touch $@
