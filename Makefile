# `make demo` and `make test` need Python >= 3.10 and nothing else: each sets up all it uses (see scripts/setup.sh).
# Paths are relative throughout, so the folder's own path may hold spaces.

BIN := .venv/bin
# Which scripts `make bench` runs; the studies of the Tooth and of photographs have commands of their own.
BENCHMARKS ?= $(filter-out benchmarks/tooth%.py benchmarks/photos.py,$(wildcard benchmarks/*.py))
FUZZ_SECONDS ?= 3600

# Tests run in one process for each core, up to four: each loads PyTorch and compiles kernels of its own.
PYTEST := $(BIN)/python -m pytest -q --durations=10 -n auto --maxprocesses=4 --dist worksteal

.PHONY: help setup demo test test-all test-cuda-emulated fuzz lint bench docs page clean distclean

help:
	@echo 'make demo       reconstruct the Tooth CT scan from rendered views; pictures in out/demo'
	@echo 'make test       lint, types and all tests but the slow ones'
	@echo 'make test-all   lint, types and all tests, with more random examples'
	@echo 'make test-cuda-emulated   the tests for GPUs on an emulated one; needs Linux on x86-64, a C and a C++ compiler'
	@echo 'make fuzz       read damaged inputs of all kinds for an hour, or FUZZ_SECONDS'
	@echo 'make lint       lint and types only'
	@echo 'make bench      print the tables of docs/results.md'
	@echo 'make docs       build the manual; begins at docs/_build/html/index.html'
	@echo 'make page       build the script of pages that show volumes in a browser, after changes in web/; needs Node'
	@echo 'make setup      only set up .venv and libLLVM (the others do it too)'
	@echo 'make clean      remove caches, builds and out/;  make distclean  .venv and web/node_modules, too'

setup:
	@sh scripts/setup.sh

demo: setup
	$(BIN)/difftetvr fit tooth -o out/demo/uniform --cells 30000 --no-move --refine none --iterations 1000 --overwrite
	$(BIN)/difftetvr fit tooth -o out/demo --cells 30000 --overwrite
	$(BIN)/difftetvr compare tooth out/demo/uniform/model.vtu out/demo/model.vtu -o out/demo/demo.png \
	    --names 'uniform grid' 'adaptive mesh'
	@echo 'out/demo/demo.png shows the truth, a uniform grid and an adaptive mesh of as many cells, and cuts through them;'
	@echo 'out/demo/model.vtu opens in ParaView.'

test: lint
	$(PYTEST) -m 'not slow'

test-all: lint
	DIFFTETVR_TESTS=thorough DIFFTETVR_FUZZ=4000 $(PYTEST)

# Kernels are translated and compiled once, into build/cuda_emulation; see tools/cuda_emulation.
test-cuda-emulated: setup
	PYTHONPATH=tools $(PYTEST) -p cuda_emulation.plugin -m gpu

fuzz: setup
	PYTHONPATH=src:tests $(BIN)/python -m fuzz --seconds $(FUZZ_SECONDS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	@for script in $(BENCHMARKS); do echo "== $$script"; $(BIN)/python "$$script" || exit 1; done

# Warnings are errors. The next time only pages are made that changed, and only examples run that changed themselves:
# after changes of the package, `make clean docs` runs them all.
docs:
	@sh scripts/setup.sh docs
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html -d docs/_build/doctrees docs docs/_build/html
	@echo 'docs/_build/html/index.html is the first page.'

page:
	cd web && npm ci --no-audit --no-fund && npm run build

clean:
	rm -rf docs/_build docs/gallery out build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find src tests examples benchmarks scripts tools -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv web/node_modules
