# A newcomer needs only `make run` and `make test`; `make help` lists the rest.
#
#   CUDA=OFF       build without the CUDA backend
#   CUDA=CHECK     only check that the CUDA backend compiles: a third of the time, ten times slower on a GPU
#   JOBS=n         parallel compilations
#   SCENE=path     scene for `make run` (default: the demo)
#   BACKEND=cuda   backend for `make accuracy`, `make stability` and `make trade` (default: cpu)
#   REFERENCES=1   `make accuracy` runs the other solvers again, instead of comparing with their stored answers
#   LONG=1         `make stability` also runs 10⁶ steps, an hour of simulated time, and millions of elements
#   RUN_ARGS=...   more arguments of `tensormass run`
#   CUDA_ARCHITECTURES=...  GPU generations to compile for, as CMake names them (default: CMakeLists.txt has it)
#   SUITE=trixie   Debian release in which `make wheel-only` tries the wheel (default: bookworm)
#   WHOLE=1       `make images` compiles in the bare Debian, too (CUDA=OFF: without the CUDA backend)
#   TEST_ARGS=...  test runners for `make test`: ctest, pytest, vitest, e2e (default: all)

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

CUDA ?= ON
BUILD ?= build
JOBS ?= $(shell nproc)
SCENE ?= demo
BACKEND ?= cpu
RUN_ARGS ?=
TEST_ARGS ?=
CUDA_ARCHITECTURES ?=
SUITE ?= bookworm
WHOLE ?=
# Ampere (A100 and, as 8.x, RTX 30), Ada, Hopper, Blackwell. Newer GPUs compile the PTX of 100 when the daemon starts.
RELEASE_CUDA_ARCHITECTURES := 80-real;89-real;90-real;100
# The set-up writes CUDACXX and CUDAToolkit_ROOT into this file.
-include .venv/toolchain.env
export CUDA CUDACXX CUDAToolkit_ROOT
export PATH := $(CURDIR)/.venv/bin:$(PATH)

VIEWER := clients/web/dist/index.html
VIEWER_SOURCES := $(shell find clients/web proto -name node_modules -prune -o -path clients/web/dist -prune \
                    -o -path clients/web/src/generated -prune -o -type f -print 2>/dev/null)

.PHONY: help setup setup-test build native python viewer run test pictures test-only programs wheel wheel-only release \
        images docs bench accuracy stability trade asan tsan lint format protocol-release clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## Install what is missing to build and run
	@.setup/setup.sh build

setup-test:
	@.setup/setup.sh test

# A recursive call of make reads the toolchain.env that the set-up has just written.
build: setup ## Build everything that runs, into build/bin
	@$(MAKE) native python viewer

run: build ## Start daemon, simulated haptic device and viewer; Ctrl-C ends them (SCENE=path)
	@exec $(BUILD)/bin/tensormass run $(RUN_ARGS) $(SCENE)

test: setup-test ## Run every test: C++, Python, web, and the real page in Chromium
	@$(MAKE) native python viewer
	@BUILD=$(BUILD) tests/run.sh $(TEST_ARGS)

pictures: build ## Take the pictures of docs/images again, in headless Chromium
	@node tests/e2e/pictures.mjs

test-only: ## Run the tests without set-up and build
	@BUILD=$(BUILD) tests/run.sh $(TEST_ARGS)

CONFIGURED := $(BUILD)/configured-cuda-$(CUDA)$(addprefix -,$(subst ;,-,$(CUDA_ARCHITECTURES)))

native: $(CONFIGURED) $(BUILD)/bin/tensormass
	@ninja -C $(BUILD) -j $(JOBS) $(NATIVE_TARGETS)

$(CONFIGURED):
	@echo "build: configuring $(BUILD) (CUDA $(CUDA))"
	@cmake -S . -B $(BUILD) -G Ninja --log-level=NOTICE \
	  -DTENSORMASS_CUDA=$(CUDA:CHECK=ON) -DTENSORMASS_CUDA_CHECK=$(if $(filter CHECK,$(CUDA)),ON,OFF) \
	  $(if $(CUDA_ARCHITECTURES),-D,-U)TENSORMASS_CUDA_ARCHITECTURES$(if $(CUDA_ARCHITECTURES),='$(CUDA_ARCHITECTURES)')
	@rm -f $(BUILD)/configured-cuda-*
	@touch $@

$(BUILD)/bin/tensormass: Makefile
	@mkdir -p $(@D)
	@printf '#!/bin/sh\n# Runs the Python command; the programs in this folder come first on PATH.\nhere=$$(cd "$$(dirname "$$0")" && pwd)\nexec env PATH="$$here:$$PATH" "%s" -m tensormass "$$@"\n' '$(CURDIR)/.venv/bin/python' > $@
	@chmod +x $@

python:
	@python clients/python/generate.py

viewer: $(VIEWER)

$(VIEWER): $(VIEWER_SOURCES)
	@echo "build: web viewer"
	@cd clients/web && npm run --silent build -- --logLevel warn
	@touch $@

# What wheel and images hold, without set-up. A recursive call reads the toolchain.env of a set-up that has just ended.
programs:
	@$(MAKE) NATIVE_TARGETS='tensormassd tensormass-haptic' CUDA_ARCHITECTURES='$(RELEASE_CUDA_ARCHITECTURES)' \
	  native python viewer

wheel: ## Make a wheel with everything inside, for all GPU generations, and try it in a bare Debian (root)
	@.setup/setup.sh wheel
	@$(MAKE) BUILD=build-wheel programs wheel-only

wheel-only: ## Make the wheel of the programs in BUILD and try it, without set-up and build
	@python clients/python/make_wheel.py --build $(BUILD) --output $(BUILD)/wheel
	@tests/wheel/bare.sh $(BUILD)/wheel/*.whl $(SUITE)

release: ## Leave wheel, SDK, sources and SHA256SUMS of this commit in dist/ (root; nothing uncommitted)
	@.setup/setup.sh wheel
	@python clients/python/make_release.py --check
	@$(MAKE) wheel
	@python clients/python/make_release.py --wheel build-wheel/wheel --output dist

images: ## Run the steps of docker/Dockerfile in a bare Debian (root; BUILD's programs, or WHOLE=1: builds there)
	@BUILD=$(BUILD) TENSORMASS_IMAGES=$(if $(WHOLE),whole,built) python -m pytest -q -rs tests/docker

docs: ## Build the documentation site with its search into build/docs/html; a broken link or an undescribed name fails
	@.setup/setup.sh docs
	@$(MAKE) python
	@rm -rf build/docs && mkdir -p build/docs
	@doxygen docs/site/Doxyfile
	@python -m sphinx -q -W --keep-going -b html -c docs/site . build/docs/html
	@python docs/site/check_links.py build/docs/html
	@echo "docs: open build/docs/html/index.html"

bench: build ## Measure this machine: beams, then each stage of a step against the memory bandwidth
	@$(BUILD)/bin/tensormass-bench
	@$(BUILD)/bin/tensormass-bench-stages

accuracy: setup-test ## Check accuracy: results in tests/accuracy, page docs/accuracy.md (BACKEND=cuda, REFERENCES=1)
	@$(MAKE) native python
	@cd tests && $(if $(REFERENCES),python -m accuracy.references &&) \
	  { python -m accuracy --backend $(BACKEND) || failed=1; python -m accuracy.report && exit $${failed:-0}; }

stability: setup-test ## Check stability: results in tests/stability, page docs/stability.md (BACKEND=cuda, LONG=1)
	@$(MAKE) native python
	@cd tests && { python -m stability --backend $(BACKEND) $(if $(LONG),--long) || failed=1; \
	  python -m stability.report && exit $${failed:-0}; }

trade: setup-test ## Measure settings of the demo scenes: results, presets, docs/accuracy.md (BACKEND=cuda); resumes if stopped
	@$(MAKE) native python
	@cd tests && python -m accuracy.trade --backend $(BACKEND) && \
	  $(if $(filter cpu,$(BACKEND)),{ ! command -v ccx > /dev/null || python -m accuracy.trade_calculix; } &&) python -m accuracy.report

asan: setup ## Run the C++ tests under the address and undefined-behaviour sanitizers
	@$(MAKE) sanitized NAME=asan SANITIZE=address,undefined

tsan: setup ## Run the C++ tests under the thread sanitizer
	@$(MAKE) sanitized NAME=tsan SANITIZE=thread

.PHONY: sanitized
sanitized:
	@cmake -S . -B build-$(NAME) -G Ninja -DTENSORMASS_CUDA=OFF -DTENSORMASS_SANITIZE=$(SANITIZE) --log-level=NOTICE \
	  -DTENSORMASS_CARGO_TARGET_DIR=$(CURDIR)/$(BUILD)/server/bus/zenoh/cargo
	@ninja -C build-$(NAME) -j $(JOBS)
	@TSAN_OPTIONS="suppressions=$(CURDIR)/tests/support/tsan_suppressions.txt ignore_noninstrumented_modules=1" \
	  UBSAN_OPTIONS="halt_on_error=1 print_stacktrace=1" \
	  ctest --test-dir build-$(NAME) -j $(JOBS) --output-on-failure

lint: setup-test python ## Check format, style and types: C++, Python, web
	@clang-format --dry-run --Werror $$(git ls-files '*.h' '*.cpp' '*.cc' '*.cu' '*.cuh')
	@cd clients/python && ruff check . ../../tests ../../examples && ruff format --check . ../../tests ../../examples && mypy
	@cd clients/web && npm run --silent lint

format: setup-test ## Format C++ and Python
	@clang-format -i $$(git ls-files '*.h' '*.cpp' '*.cc' '*.cu' '*.cuh')
	@cd clients/python && ruff format . ../../tests ../../examples

protocol-release: setup-test ## Record the protocol as released; `make test` refuses what breaks it
	@python tests/proto/compatibility.py --release

clean: ## Remove what was built (the set-up stays)
	@rm -rf $(BUILD) build-asan build-tsan build-wheel dist clients/web/dist clients/web/src/generated clients/python/tensormass/v1
