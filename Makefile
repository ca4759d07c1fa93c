# One folder holds everything: .tools/ (uv), .venv/ (the locked environment), runs/ (results).
# The system's Python is asked for pip once and is otherwise left alone, so an
# externally managed one without the venv module (Debian, Ubuntu) will do.

PYTHON     ?= python3
UV_VERSION := 0.13.9

UV  := .tools/bin/uv
BIN := .venv/bin

# Somebody else's active environment (conda, ROS, a virtualenv) stays out of ours.
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV CONDA_PREFIX
export UV_PYTHON_DOWNLOADS := never
# uv's own list of certificates does not know a company's proxy; pip and the system do.
export UV_SYSTEM_CERTS ?= true

MAKEFLAGS += --silent --no-print-directory
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help report pdf log-is-named setup test test-all check format schemas sample-logs bench paper clean lock

help: ## What can be made
	echo "gradetrace: from the log of an excavator's cameras to a trench report"
	echo
	awk -F ':.*## ' '/^[a-z%-]+:.*## / { sub("%", "NAME", $$1); sub("^(report|pdf)$$", "& LOG=FILE", $$1); \
	  printf "  make %-17s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))
	echo
	echo "  ARGS='...' is handed on, for example: make report LOG=shift.mcap ARGS='--strict'"

report: log-is-named .venv/runtime.stamp ## Turn one log into tracks and a report
	$(BIN)/gradetrace report '$(LOG)' $(ARGS)

# Where the page lies; `make pdf PAGE=runs/shift/report.html` prints one that is there already.
PAGE     ?=
CHROMIUM ?=
# Off the network, like the page itself.
PRINTING := --headless --no-sandbox --disable-gpu --disable-quic --disable-dev-shm-usage --no-first-run \
  --disable-background-networking --disable-component-update --disable-sync --disable-default-apps \
  '--host-resolver-rules=MAP * ~NOTFOUND' --virtual-time-budget=3000 --no-pdf-header-footer

pdf: $(if $(PAGE),,report) ## Turn one log into a report, and the report into report.pdf beside it
	page='$(PAGE)'; \
	if [ -z "$$page" ]; then log='$(LOG)'; log="$${log##*/}"; page="runs/$${log%.*}/report.html"; fi; \
	[ -f "$$page" ] || { \
	  echo "no report: there is no $$page; make one with: make report LOG=FILE, or name one with PAGE=FILE" >&2; exit 2; }; \
	browser='$(CHROMIUM)'; \
	for name in chromium chromium-browser google-chrome google-chrome-stable; do \
	  [ -n "$$browser" ] || browser="$$(command -v $$name || true)"; done; \
	[ -x "$$browser" ] || { \
	  echo "make pdf needs Chromium, and there is none; on Debian and Ubuntu: apt install chromium, or name one: CHROMIUM=FILE" >&2; exit 2; }; \
	folder="$$(cd "$$(dirname "$$page")" && pwd -P)"; pdf="$$folder/$$(basename "$${page%.*}").pdf"; \
	address="$$($(PYTHON) -c 'import pathlib, sys; print(pathlib.Path(sys.argv[1]).resolve().as_uri())' "$$page")"; \
	scratch="$$(mktemp -d)"; trap 'rm -rf "$$scratch"' EXIT; \
	"$$browser" $(PRINTING) --user-data-dir="$$scratch/profile" --print-to-pdf="$$scratch/page.pdf" "$$address" \
	  2> "$$scratch/said" || true; \
	[ -s "$$scratch/page.pdf" ] || { tail -n 5 "$$scratch/said" >&2; echo "$$browser printed nothing" >&2; exit 2; }; \
	cp "$$scratch/page.pdf" "$$pdf.partial" && mv "$$pdf.partial" "$$pdf"; \
	echo "pdf: $$pdf"

log-is-named:
	[ -n '$(LOG)' ] || { \
	  echo "make report needs a log, for example: make report LOG=sample_logs/trench/trench.mcap" >&2; exit 2; }

test: .venv/dev.stamp ## Run the tests, without the slow ones
	$(BIN)/pytest -n auto -m 'not slow' $(ARGS)

test-all: .venv/dev.stamp ## Run every test
	$(BIN)/pytest -n auto $(ARGS)

check: .venv/dev.stamp ## Look for mistakes and untidiness, change nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: .venv/dev.stamp ## Tidy the code
	$(BIN)/ruff check --quiet --fix-only .
	$(BIN)/ruff format --quiet .

schemas: .venv/dev.stamp ## Export the schemas of machine.toml and site.toml from their models
	$(BIN)/python -m pipeline.config.export

sample-logs: .venv/dev.stamp ## Render the sample logs and those the benchmarks use
	$(BIN)/python -m pipeline.synthetic $(ARGS)

BENCHMARKS = $(subst _,-,$(filter-out _%,$(basename $(notdir $(wildcard benchmarks/*.py)))))

bench: .venv/dev.stamp ## Run every benchmark and hold it against its bars
	missed=; for name in $(BENCHMARKS); do $(MAKE) bench-$$name || missed="$$missed $$name"; done; \
	if [ -n "$$missed" ]; then echo "benchmarks that missed a bar:$$missed" >&2; exit 1; fi

bench-%: .venv/dev.stamp ## Run one benchmark, for example: make bench-main-job
	$(BIN)/python -m benchmarks.$(subst -,_,$*) $(ARGS)

paper: .venv/dev.stamp ## Lay the figures and claims of the paper beside ours, on runs/paper/paper.html
	$(BIN)/python -m benchmarks.paper $(ARGS)

setup: .venv/dev.stamp ## Make the environment and do nothing more

clean: ## Remove the environment and what tools left behind; runs/ stays
	rm -rf .tools .venv build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './runs/*' -prune -exec rm -rf {} +

lock: .tools/uv-$(UV_VERSION).stamp ## Pin every dependency anew, in the newest versions that fit
	$(UV) pip compile pyproject.toml --group build --universal --generate-hashes --upgrade \
	  --custom-compile-command 'make lock' --quiet --output-file requirements.lock
	$(UV) pip compile pyproject.toml --group dev --universal --generate-hashes --upgrade --constraints requirements.lock \
	  --custom-compile-command 'make lock' --quiet --output-file requirements-dev.lock

# The environment. The development lock holds the runtime lock whole. Hashes cannot be asked of an
# editable install, so the project itself comes second, built by the locked build backend.
define install
$(UV) pip sync --quiet --python $(BIN)/python --require-hashes --only-binary :all: $(1)
$(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable .
endef

.venv/dev.stamp: requirements-dev.lock .venv/runtime.stamp
	echo "Adding the tools for development"
	$(call install,$<)
	touch $@

# Where the tools for development are already, they stay.
.venv/runtime.stamp: requirements.lock pyproject.toml .tools/uv-$(UV_VERSION).stamp
	echo "Setting up the environment in .venv (some 300 MB the first time)"
	$(BIN)/python -c '' 2>/dev/null || $(UV) venv --quiet --clear --no-project --python "$$($(PYTHON) -c 'import sys; print(sys.executable)')" .venv
	$(call install,$(or $(patsubst %,requirements-dev.lock,$(wildcard .venv/dev.stamp)),$<))
	touch $@

.tools/uv-$(UV_VERSION).stamp:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "gradetrace needs Python 3.11 or newer; name one, for example: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -c 'import pip' 2>/dev/null || { \
	  echo "$(PYTHON) has no pip; on Debian and Ubuntu: apt install python3-pip" >&2; exit 1; }
	PIP_USER=0 PIP_REQUIRE_VIRTUALENV=0 $(PYTHON) -m pip install --quiet --disable-pip-version-check \
	  --root-user-action=ignore --upgrade --target .tools uv==$(UV_VERSION)
	touch $@
