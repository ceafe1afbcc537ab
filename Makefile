# A newcomer needs only `make run` and `make test`; `make help` lists the rest.
#
#   CUDA=ON        build the CUDA backend on a machine without a GPU, too (default: AUTO, see .setup/cuda.sh)
#   CUDA=OFF       build without the CUDA backend
#   CUDA=CHECK     only check that the CUDA backend compiles: a third of the time, ten times slower on a GPU
#   JOBS=n         parallel compilations
#   SCENE=path     scene for `make run` (default: the demo)
#   BACKEND=cuda   backend for `make accuracy`, `make stability` and `make trade` (default: cpu)
#   REFERENCES=1   `make accuracy` runs the other solvers again, instead of comparing with their stored answers
#   LONG=1         `make stability` also runs 10⁶ steps, an hour of simulated time, and millions of elements
#   RUN_ARGS=...   more arguments of `tensormass run`
#   CUDA_ARCHITECTURES=...  GPU generations to compile for, as CMake names them (default: this machine's)
#   FOLDER=name    folder of tests/ for `make test-folder`; TESTS=pattern runs only tests with such names
#   SUITE=trixie   Debian release in which `make wheel-only` tries the wheel (default: bookworm)
#   WHOLE=1       `make images` compiles in the bare Debian, too (CUDA=OFF: without the CUDA backend)
#   FUZZ_ARGS=...  arguments of `make fuzz` for Python, such as '--seconds 600 scene'; FUZZ_SECONDS=n for each C++ decoder
#   TEST_ARGS=...  test runners for `make test`, as tests/run.sh names them (default: all)

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

BUILD ?= build
JOBS ?= $(shell .setup/cores.sh)
SCENE ?= demo
BACKEND ?= cpu
RUN_ARGS ?=
FUZZ_ARGS ?=
FUZZ_SECONDS ?= 60
TEST_ARGS ?=
SUITE ?= bookworm
WHOLE ?=
COUNT ?= 100000
SEED ?= 1
# What `native` compiles: what runs. Other targets name more.
TARGETS ?= tensormassd tensormass-haptic
FOLDER ?=
TESTS ?=
# The set-up writes CUDACXX and CUDAToolkit_ROOT into this file.
-include .venv/toolchain.env
export CUDACXX CUDAToolkit_ROOT
export PATH := $(CURDIR)/.venv/bin:$(PATH)

VIEWER := clients/web/dist/index.html
VIEWER_SOURCES := $(shell find clients/web proto -name node_modules -prune -o -path clients/web/dist -prune \
                    -o -path clients/web/src/generated -prune -o -type f -print 2>/dev/null)

# .setup/cuda.sh decides about CUDA; GOAL=release makes it decide for a release. It is asked once, when a rule needs it.
# make 4.3 gives `shell` no variables of its command line.
GOAL ?= build
CHOICE = $(eval CHOICE := $(or $(shell CUDA='$(CUDA)' CUDA_ARCHITECTURES='$(CUDA_ARCHITECTURES)' .setup/cuda.sh $(GOAL)),$(error the line above says what to change)))$(CHOICE)
CUDA_SETTING = $(word 1,$(CHOICE))
CUDA_FOR = $(filter-out -,$(word 2,$(CHOICE)))
CUDA_REASON = $(wordlist 3,99,$(CHOICE))

.PHONY: help setup setup-test build native python viewer run tests benches gpu-test stability-map examples test \
        attack test-folder pictures test-only programs wheel wheel-only release images docs bench accuracy stability \
        trade asan tsan audit lint format fuzz protocol-release clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## Install what is missing to build and run
	@.setup/setup.sh build

setup-test:
	@.setup/setup.sh test

# A recursive call of make reads the toolchain.env that the set-up has just written.
build: setup ## Build what runs, into build/bin: daemon, haptic client, Python command, viewer
	@$(MAKE) native python viewer say-backend

.PHONY: say-backend
say-backend:
	@echo 'build: $(BUILD)/bin is complete; $(CUDA_REASON)'

run: build ## Start daemon, simulated haptic device and viewer; Ctrl-C ends them (SCENE=path)
	@exec $(BUILD)/bin/tensormass run $(RUN_ARGS) $(SCENE)

test: setup-test ## Run lint and every test: C++, Python, web, and the real page in Chromium
	@$(MAKE) TARGETS='$(TARGETS) tests' native python viewer
	@BUILD=$(BUILD) tests/run.sh $(TEST_ARGS)

test-only: ## Run the tests without set-up and build
	@BUILD=$(BUILD) tests/run.sh $(TEST_ARGS)

attack: setup-test ## Attack a daemon as strangers would, and print what each attack did before and does now
	@$(MAKE) native python
	@python tests/attack/table.py

test-folder: setup-test ## Compile and run the C++ tests of one folder (FOLDER=world)
	@$(if $(FOLDER),,$(error which folder of tests/? for example: make test-folder FOLDER=world))
	@$(MAKE) TARGETS=tests_$(FOLDER) native
	@ctest --test-dir $(BUILD)/tests/$(FOLDER) -j $(JOBS) --output-on-failure --no-tests=error $(if $(TESTS),-R '$(TESTS)')

tests: setup-test ## Compile the C++ tests
	@$(MAKE) TARGETS=tests native

benches: setup-test ## Compile the benches: tensormass-bench, tensormass-bench-stages, tensormass-bench-wake-up
	@$(MAKE) TARGETS=benches native

gpu-test: setup-test ## Compile tensormass_gpu_test, which compares a GPU with the CPU (CUDA=ON without a GPU)
	@$(MAKE) TARGETS=tensormass_gpu_test native

stability-map: setup-test ## Measure which delay and stiffness a hand bears (docs/haptics.md); two minutes
	@$(MAKE) TARGETS=tensormass-haptic-stability-map native python
	@python tests/haptic/stability_map.py

examples: setup ## Compile the haptic client of examples/haptic
	@$(MAKE) TARGETS=haptic_client native

pictures: setup-test ## Take the pictures of docs/images again, in headless Chromium
	@$(MAKE) native python viewer
	@node tests/e2e/pictures.mjs

CONFIGURED = $(BUILD)/configured-cuda-$(CUDA_SETTING)$(addprefix -,$(subst ;,-,$(CUDA_FOR)))

native: $(BUILD)/bin/tensormass
	@$(MAKE) $(CONFIGURED)
	@python .setup/build.py $(BUILD) -j $(JOBS) $(TARGETS)

$(BUILD)/configured-cuda-%:
	@echo 'build: configuring $(BUILD); $(CUDA_REASON)'
	@cmake -S . -B $(BUILD) -G Ninja --log-level=WARNING \
	  -DTENSORMASS_CUDA=$(if $(filter OFF,$(CUDA_SETTING)),OFF,ON) \
	  -DTENSORMASS_CUDA_CHECK=$(if $(filter CHECK,$(CUDA_SETTING)),ON,OFF) \
	  $(if $(CUDA_FOR),-DTENSORMASS_CUDA_ARCHITECTURES='$(CUDA_FOR)')
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
	@$(MAKE) GOAL=release native python viewer

wheel: ## Make a wheel with everything inside, for all GPU generations, and try it in a bare Debian (root)
	@.setup/setup.sh wheel
	@$(MAKE) BUILD=build-wheel programs wheel-only

wheel-only: ## Make the wheel of the programs in BUILD and try it, without set-up and build
	@CUDA='$(firstword $(shell CUDA='$(CUDA)' .setup/cuda.sh release))' python clients/python/make_wheel.py --build $(BUILD) --output $(BUILD)/wheel
	@tests/wheel/bare.sh $(BUILD)/wheel/*.whl $(SUITE)

release: ## Leave wheel, SDK, sources, SBOM and SHA256SUMS of this commit in dist/ (root; nothing uncommitted)
	@.setup/setup.sh wheel
	@python clients/python/make_release.py --check
	@python tests/wheel/clone.py
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

bench: benches ## Measure this machine: beams, then each stage of a step against the memory bandwidth
	@$(BUILD)/bin/tensormass-bench
	@$(BUILD)/bin/tensormass-bench-stages

accuracy: setup-test ## Check accuracy: results in tests/accuracy, page docs/accuracy.md (BACKEND=cuda, REFERENCES=1)
	@$(MAKE) native python
	@cd tests && $(if $(REFERENCES),python -m accuracy.references &&) \
	  { python -m accuracy --backend $(BACKEND) || failed=1; python -m accuracy.report && exit $${failed:-0}; }

stability: setup-test ## Check stability: results in tests/stability, page docs/stability.md (BACKEND=cuda, LONG=1)
	@$(MAKE) native python
	@cd tests && { python -m stability --backend $(BACKEND) $(if $(LONG),--long) || failed=1; \
	  python -m stability.monkey --backend $(BACKEND) --walks 500 || failed=1; \
	  python -m stability.presses --backend $(BACKEND) || failed=1; \
	  python -m stability.report && exit $${failed:-0}; }

trade: setup-test ## Measure settings of the demo scenes: results, presets, docs/accuracy.md (BACKEND=cuda); resumes if stopped
	@$(MAKE) native python
	@cd tests && python -m accuracy.trade --backend $(BACKEND) && \
	  $(if $(filter cpu,$(BACKEND)),{ ! command -v ccx > /dev/null || python -m accuracy.trade_calculix; } &&) python -m accuracy.report

asan: setup ## Run the C++ tests under the address and undefined-behaviour sanitizers
	@$(MAKE) sanitized NAME=asan SANITIZE=address,undefined

tsan: setup ## Run the C++ tests under the thread sanitizer
	@$(MAKE) sanitized NAME=tsan SANITIZE=thread

.PHONY: sanitized sanitized-build
sanitized-build:
	@cmake -S . -B build-$(NAME) -G Ninja -DTENSORMASS_CUDA=OFF -DTENSORMASS_SANITIZE=$(SANITIZE) --log-level=NOTICE \
	  -DTENSORMASS_CARGO_TARGET_DIR=$(CURDIR)/$(BUILD)/server/bus/zenoh/cargo
	@ninja -C build-$(NAME) -j $(JOBS) $(SANITIZED)

sanitized: sanitized-build
	@TSAN_OPTIONS="suppressions=$(CURDIR)/tests/support/tsan_suppressions.txt ignore_noninstrumented_modules=1" \
	  UBSAN_OPTIONS="halt_on_error=1 print_stacktrace=1" \
	  ctest --test-dir build-$(NAME) -j $(JOBS) --output-on-failure

lint: setup-test python ## Check format, style and types: C++, Python, web
	@tests/lint.sh

format: setup-test ## Format C++ and Python
	@clang-format -i $$(git ls-files '*.h' '*.cpp' '*.cc' '*.cu' '*.cuh')
	@cd clients/python && ruff format . ../../tests ../../examples

fuzz: setup-test python ## Mutate inputs of each decoder: C++ under sanitizers, Python, mesh files (FUZZ_ARGS, COUNT, SEED); failures: tests/fuzz/inputs
	@$(MAKE) sanitized-build NAME=asan SANITIZE=address,undefined SANITIZED=fuzz_tests
	@UBSAN_OPTIONS="halt_on_error=1 print_stacktrace=1" FUZZ_SECONDS=$(FUZZ_SECONDS) FUZZ_SEED=$(SEED) \
	  FUZZ_KEEP=$(CURDIR)/tests/fuzz/inputs build-asan/tests/fuzz_tests
	@cd tests && python -m fuzz $(FUZZ_ARGS)
	@PYTHONPATH=tests/python python tests/python/mesh_mutations.py --count $(COUNT) --seed $(SEED)

audit: ## Compare everything pinned with the known vulnerabilities of clients/python/advisories.json, without network
	@python clients/python/audit.py

protocol-release: setup-test ## Record the protocol as released; `make test` refuses what breaks it
	@python tests/proto/compatibility.py --release

clean: ## Remove what was built (the set-up stays)
	@rm -rf $(BUILD) build-asan build-tsan build-wheel dist clients/web/dist clients/web/src/generated clients/python/tensormass/v1
