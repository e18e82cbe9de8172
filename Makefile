# The commands of this repository; 'make help' lists them.

PYTHON ?= python3
PYTEST_ARGS ?=
DEMO_ARGS ?=
PAPER_ARGS ?=
FAST ?=
UV ?= $(firstword $(wildcard .venv/bin/uv) uv)
LOCK_ARGS ?=

# Only of the command line: a variable ROS of the shell may be meant for something else.
ifeq ($(origin ROS),command line)
export CMP_TACTILE_ROS := $(ROS)
endif

.DEFAULT_GOAL := help
.PHONY: help build demo docs paper test check lock clean

help: ## List the commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-7s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

build: ## Install ROS 2 if it is missing, and build the packages if they have changed
	@command -v "$(PYTHON)" >/dev/null || { \
		echo "set-up: found no $(PYTHON), expected Python 3.10 to 3.14 (Debian, Ubuntu: sudo apt install python3)" >&2; \
		exit 1; }
	@"$(PYTHON)" setup/bootstrap.py

demo: build ## Simulate a grasp, play it through the ROS 2 nodes, and write demo_output/ (DEMO_ARGS=...)
	@setup/run cmp_tactile demo $(DEMO_ARGS)

docs: build ## Build these documents and an API reference into site/; open site/index.html
	@mkdir -p log && "$(UV)" venv --quiet --allow-existing --python "$(PYTHON)" .venv-docs 2>log/docs.log && \
		"$(UV)" pip install --quiet --python .venv-docs/bin/python --require-hashes --no-deps \
			--only-binary :all: -r setup/locked-docs.txt 2>>log/docs.log || \
		{ echo "docs: MkDocs could not be installed; log/docs.log has the reason" >&2; exit 1; }
	@setup/run python3 docs/site/pages.py build/site_source
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet --strict --config-file docs/site/mkdocs.yml
	@echo "site/index.html"

paper: build ## Run the paper's experiments: 30 minutes on 2 cores (FAST=1: fewer and smaller; PAPER_ARGS=...)
	@setup/run sh -c 'PYTHONPATH="$$PWD/benchmarks:$$PYTHONPATH" exec python3 -m paper "$$@"' paper \
		$(if $(FAST),--fast) $(PAPER_ARGS)

test: build ## Run all tests: 15 to 25 minutes (PYTEST_ARGS="-k grid" for some of them; ROS=jazzy for Jazzy)
	@setup/run python3 -m pytest -n auto --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

check: build ## Check style, types and imports (docs/architecture.md)
	@setup/run ruff check
	@setup/run ruff format --check
	@setup/run mypy
	@setup/run lint-imports --no-cache
	@setup/run python3 benchmarks/house.py

lock: ## Renew setup/locked-*.txt, the versions to install (LOCK_ARGS=--upgrade for the newest)
	@command -v "$(UV)" >/dev/null || { echo "lock: found no $(UV): run 'make build', or pip install uv" >&2; exit 1; }
	@uv=$$(realpath "$$(command -v '$(UV)')") && cd setup && lock() { \
		"$$uv" pip compile --quiet --no-config --no-python-downloads --universal --python-version 3.10 \
			--generate-hashes --only-binary :all: --no-binary empy --custom-compile-command 'make lock' \
			$(LOCK_ARGS) "$$@"; } && \
	lock requirements-build.txt --output-file locked-build.txt && \
	lock requirements-docs.txt --output-file locked-docs.txt && \
	for distro in kilted jazzy; do \
		lock requirements-build.txt requirements-$$distro.txt requirements-libraries.txt \
			--output-file locked-$$distro.txt || exit 1; \
	done

clean: ## Remove everything that these commands made, also the environment in .venv
	@rm -rf .venv .venv-docs .venv-jazzy .setup.lock build build-jazzy install install-jazzy log log-jazzy
	@rm -rf demo_output site .mypy_cache .pytest_cache .ruff_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
