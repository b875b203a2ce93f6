# demo and test are all a newcomer needs; both set up first. Python 3.11 or newer and a C++ compiler are assumed, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := packages/naospec packages/naopolicies packages/naosim packages/naosprint packages/naojobs packages/naoctl services/api services/worker
SOURCES := $(foreach package,$(PACKAGES),$(package)/pyproject.toml) $(wildcard packages/*/CMakeLists.txt packages/*/cpp/*)
INSTALLED := $(VENV)/.installed

# Without bytecode each of the tests' thousand processes would compile our packages again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo up test check lint js format types e2e soak world fuzz audit readme docs wheels bench sanitize clean
help:  ## list the targets
	@grep -hE '^[a-z0-9]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(INSTALLED)  ## set up .venv with pinned dependencies and all packages (about 2 minutes)

# pip's cache makes the second set-up quick; CPU-only PyTorch is pinned, so no CUDA comes along.
$(INSTALLED): requirements.txt docs/requirements.txt $(SOURCES)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --disable-pip-version-check -r requirements.txt -r docs/requirements.txt
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation $(addprefix -e ,$(PACKAGES))
	@touch $@

# ROBOT=t1 or ROBOT=k1 trains one of the league's new robots, in under 5 minutes.
demo: $(INSTALLED)  ## train a real sprint job on this machine, watch it, evaluate it (under 10 minutes)
	$(BIN)/naoctl demo $(if $(ROBOT),--robot $(ROBOT))

up: $(INSTALLED)  ## start API, worker, Postgres, broker and dashboard on this machine; Ctrl-C stops them
	$(BIN)/naoctl up

# Processes of the tests: one more than cores, which fills the time in which tests wait. Each needs up to 1.5 GB.
N := $(shell n=$$(($$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1) + 1)); echo $$((n < 6 ? n : 6)))
test: $(INSTALLED)  ## unit and integration tests with real Postgres, broker, store and processes (under 20 minutes)
	$(BIN)/python -m pytest -m "not e2e" -n $(N) --dist loadfile --no-loadscope-reorder

check: lint types test  ## everything that must pass before a change lands

lint: $(INSTALLED) js  ## linters and formatters of Python and JavaScript
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Biome checks the dashboard's scripts. It is the one thing that comes from npm, and only for development.
BIOME := services/api/node_modules/.package-lock.json
$(BIOME): services/api/package-lock.json
	npm install --prefix services/api --no-save --silent --no-audit --no-fund

ifneq ($(shell command -v npm),)
js: $(BIOME)
	cd services/api && npm run --silent check
else
js:
	@echo "The dashboard's scripts were NOT checked: npm is not installed. Python is checked as usual."
endif

format: $(INSTALLED)  ## format Python and JavaScript
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	@if command -v npm >/dev/null; then $(MAKE) --silent $(BIOME) && cd services/api && npm run --silent format; fi

types: $(INSTALLED)
	$(BIN)/mypy $(foreach package,$(PACKAGES),$(package)/src) benchmarks docs tools

soak: $(INSTALLED)  ## break a whole service of real processes 30 times, then check that nothing was lost (5 to 15 minutes)
	$(BIN)/python benchmarks/service/soak.py --faults 30 --seed 30 --longest 3 --updates 150

world: $(INSTALLED)  ## ten faults of the world around a service, two at a time: clocks, suspended parts, disks (about 2 minutes)
	$(BIN)/python benchmarks/service/soak.py --world --faults 10 --seed 9 --longest 8 --updates 150

fuzz: $(INSTALLED)  ## hostile requests to the API and hostile checkpoints, for two minutes; FUZZ_SEED begins elsewhere
	FUZZ_EXAMPLES=$${FUZZ_EXAMPLES:-12} FUZZ_S=$${FUZZ_S:-60} $(BIN)/python -m pytest -q --timeout 400 \
	  tests/integration/api/test_schema.py tests/unit/naosprint/rl/test_hostile.py -k "mutated or breaks"

# E2E=tests/e2e/compose runs those of one folder, K="healthy" those whose names match.
e2e: $(INSTALLED)  ## the documents' commands; browser and container tests, where chromium or a container engine is at hand
	$(BIN)/python -m pytest -m e2e $(E2E) $(if $(K),-k "$(K)")

# Trivy scans images that exist already; `docker compose build` makes them.
# Strict: a package that the advisory service does not know is an error, not a pass.
AUDIT := build/audit
audit: $(INSTALLED)  ## known vulnerabilities in Python packages, dev tools and images (needs the network)
	@test -x $(AUDIT)/bin/pip-audit || { $(PYTHON) -m venv $(AUDIT) && $(AUDIT)/bin/pip install -q pip-audit==2.10.1; }
	$(AUDIT)/bin/pip-audit --strict --disable-pip --no-deps -r requirements.txt -r docs/requirements.txt
	cd services/api && npm audit
	@if command -v trivy >/dev/null; then \
	  for image in api worker simserver rcssservermj; do trivy image --exit-code 1 --ignore-unfixed --severity HIGH,CRITICAL naosprint/$$image:0.2.0 || exit 1; done; \
	else echo "The images were NOT scanned: trivy is not installed."; fi

readme:  ## type what the README says into a fresh clone (about 10 minutes)
	$(PYTHON) docs/check_documents.py

docs: $(INSTALLED)  ## the documentation's site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

wheels: $(INSTALLED)  ## wheels of all packages in dist, for the Python of .venv; `pip install dist/*.whl` needs no checkout
	rm -rf dist packages/*/build/lib services/*/build/lib
	$(BIN)/python -m pip wheel -q --disable-pip-version-check --no-deps --no-build-isolation -w dist $(PACKAGES) services/all
	rm -rf packages/*/build/lib packages/*/build/bdist* services/*/build

bench: $(INSTALLED)  ## the engine beside libode (needs libode-dev)
	$(BIN)/naosim bench
	$(BIN)/python benchmarks/engine/run.py
	$(BIN)/python benchmarks/engine/run_mujoco.py

sanitize: $(INSTALLED)  ## the engine's tests under AddressSanitizer and UBSan (some minutes)
	packages/naosim/sanitize.sh

clean:  ## remove what was built; jobs and their data are not touched
	rm -rf $(VENV) build .mypy_cache .pytest_cache .ruff_cache packages/naosim/build
