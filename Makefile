# Everything runs from .venv; the first target that needs it creates it.
PYTHON ?= $(or $(shell for version in 3.11 3.12 3.13; do \
    python$$version -c "import ensurepip, venv" 2>/dev/null && { echo python$$version; break; }; done),no-python-of-3.11-to-3.13)
EXTRAS ?= dev
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed-$(EXTRAS)
COMPILED := $(VENV)/.compiled-$(EXTRAS)
DEMO ?= demo
comma := ,
# What the demo and the commands of README need: a third of what developers need. A developer's .venv has it already.
DEMO_EXTRAS := $(if $(wildcard $(VENV)/.installed-dev),dev,service$(comma)sim)
SECONDS ?= 60
# What draws the pictures of simulated cameras where there is no display and no graphics card.
GL_PACKAGES := libegl1 libegl-mesa0 libgl1-mesa-dri
HAS_GL := $(BIN)/python -c "from fcslam.lab.simulation.engine import gl_context; gl_context(16, 16).free()" 2>/dev/null
AS_ROOT := $(if $(filter 0,$(shell id -u)),,sudo -n)
APT_GET := $(AS_ROOT) env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Acquire::http::Timeout=20 -o Acquire::Retries=1
# A real ROS as the peer of tests, in an environment of its own: rclpy from PyPI.
ROS_VENV := .venv-ros
RCLPY := ros-rclpy==9.1.2 ros-rmw-fastrtps-cpp==9.3.3 ros-sensor-msgs==5.5.1 ros-nav-msgs==5.5.1 ros-std-srvs==5.5.1
# What the tests of the page drive; axe-core looks for faults of accessibility.
AXE := axe-core@4.14.1
# The linter of the page's script.
BIOME := @biomejs/cli-linux-x64@2.3.8
HAS_BROWSER := $(BIN)/python -c "import playwright, shutil, sys; sys.exit(not shutil.which('chromium'))" 2>/dev/null
# torch's build for processors is a tenth of the size of the one that PyPI has.
TORCH_CPU := --index-url https://download.pytorch.org/whl/cpu --no-deps --retries 1 --timeout 15 torch
# What is imported is compiled then: a third of the time of an installation, and most modules are never imported.
PIP := $(BIN)/python -m pip install -qq --no-compile --disable-pip-version-check -c constraints.txt
# uv takes a fifth of pip's time. It does not read pip's settings, so pip installs where uv cannot.
INSTALL = { { $(PIP) uv && $(BIN)/uv pip install -q --python $(BIN)/python -c constraints.txt $(1); } 2>/dev/null || $(PIP) $(1); }
HAS_MKDOCS := $(BIN)/python -c "import material, mkdocs, mkdocstrings_handlers.python" 2>/dev/null
HAS_SCALE := $(BIN)/python -c "import distributed, psycopg" 2>/dev/null
HAS_LEARNING := $(BIN)/python -c "import flwr, onnx, torch" 2>/dev/null
# One worker more than cores, as some tests wait. Workers share cores, so a library that starts its own threads gains
# nothing and slows the others. `nproc` obeys OMP_NUM_THREADS.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n $(shell expr $$(env -u OMP_NUM_THREADS nproc) + 1) --maxprocesses 8 --dist worksteal
BENCHMARKS := $(filter-out benchmarks/common.py benchmarks/convert_logs.py benchmarks/processes.py benchmarks/quick.py,$(wildcard benchmarks/*.py))

.PHONY: help install packages gl learning demo simulated-demo test test-fast test-system test-all test-training test-attack ros-test browser-test scale-test check bench bench-quick docs proto fuzz lock sbom audit
.DEFAULT_GOAL := help
# Where this is set, each process of a test compiles the package and the tests anew.
export PYTHONDONTWRITEBYTECODE :=

help:
	@echo "make demo         simulate a fleet, map it, evaluate it against ground truth, draw the result"
	@echo "make test         all tests that need no real server and no recordings"
	@echo "make test-fast    the same without the slow tests"
	@echo "make test-system  the tests with real servers and on recordings (set FCSLAM_DATA to their folder)"
	@echo "make test-all     test and test-system in one run"
	@echo "make test-training federated training, with attackers and with real processes; run make learning first"
	@echo "make test-attack  the tests that play an attacker against own servers on this machine"
	@echo "make fuzz         broken packets, files, requests and messages; SECONDS=60 of each kind"
	@echo "make ros-test     install a real ROS 2 as the peer of the tests of live robots"
	@echo "make browser-test install a browser for the tests of the page, if permitted"
	@echo "make scale-test   install what tests of a cluster and of several instances need, and run them"
	@echo "make check        linter, formatting, types, spelling"
	@echo "make bench        the benchmarks; those on recordings need FCSLAM_DATA"
	@echo "make bench-quick  speed and accuracy beside the committed figures, in minutes; needs FCSLAM_DATA"
	@echo "make install      create .venv; EXTRAS=dev,train,federated,sim adds packages"
	@echo "make packages     the same, but no code is compiled"
	@echo "make learning     install torch and Flower, for training the detector, if they are available"
	@echo "make gl           install the GL library of the simulated cameras, if permitted"
	@echo "make lock         write deploy/requirements.lock: what a service and a robot install, with hashes"
	@echo "make sbom         write sbom.json, the software bill of materials of deploy/requirements.lock (CycloneDX)"
	@echo "make audit        look for known vulnerabilities of deploy/requirements.lock; needs the Internet"
	@echo "make docs         write the reference pages from the code, and the documentation to site/"
	@echo "make proto        generate the Python code of the wire format"

install: $(COMPILED)

packages: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@echo "Installing fcslam[$(EXTRAS)] into $(VENV): $(if $(findstring dev,$(EXTRAS)),2 GB,1 GB) on the disk, one to eight minutes by network and processor."
	@$(PYTHON) -m venv $(VENV) || { echo "Install Python 3.11, 3.12 or 3.13 with its venv, or name one: make install PYTHON=..."; exit 1; }
	@$(call INSTALL,-e ".[$(EXTRAS)]")
	@touch $@

$(COMPILED): $(INSTALLED)
	@find src -name '*.nb[ic]' -delete  # compiled code that names classes by where they were
	@$(BIN)/fcslam tools warm-up
	@touch $@

# Never fails: without a GL library there are LiDARs.
gl: $(INSTALLED)
	@if ! $(HAS_GL); then \
	    if command -v apt-get >/dev/null && $(AS_ROOT) true 2>/dev/null; then \
	        echo "Installing a GL library for the simulated cameras: $(GL_PACKAGES)"; \
	        { $(APT_GET) update; $(APT_GET) install --no-install-recommends $(GL_PACKAGES); } >/dev/null 2>&1 || true; \
	    fi; \
	    $(HAS_GL) || echo "No GL library, so no cameras. To have them: sudo apt-get install $(GL_PACKAGES)"; \
	fi

# Never fails: without torch and Flower the tests of training are skipped.
learning: $(INSTALLED)
	@if ! $(HAS_LEARNING); then \
	    echo "Installing torch and Flower into $(VENV), for training the detector: 1 GB on the disk, one to five minutes."; \
	    { $(PIP) $(TORCH_CPU) && $(call INSTALL,-e ".[$(EXTRAS)$(comma)federated]"); } 2>/dev/null || true; \
	    $(HAS_LEARNING) || echo "No torch or no Flower, so no training. To have them: make install EXTRAS=$(EXTRAS),federated"; \
	fi

demo:
	@$(MAKE) --no-print-directory EXTRAS=$(DEMO_EXTRAS) simulated-demo

simulated-demo: $(COMPILED) gl
	@$(BIN)/fcslam demo --output $(DEMO) $$($(HAS_GL) || echo --no-camera)

test: $(COMPILED)
	@$(PYTEST) -m "not system and not training"

test-fast: $(COMPILED)
	@$(PYTEST) -m "not system and not training and not slow"

test-system: $(COMPILED)
	@$(PYTEST) -m system -rs

test-all: $(COMPILED)
	@$(PYTEST) -m "not training" -rs

# Needs what `make learning` installs.
test-training: $(COMPILED)
	@$(PYTEST) -m training -rs

test-attack: $(COMPILED)
	@$(PYTEST) -m attack -rs

# Never fails: without ROS the tests of live robots are skipped.
ros-test: $(INSTALLED)
	@$(PIP) -e ".[$(EXTRAS),ros2]"
	@$(PYTHON) -m venv $(ROS_VENV)
	@$(ROS_VENV)/bin/python -m pip install -qq --disable-pip-version-check $(RCLPY) || echo "No rclpy for this Python."

# Never fails: without a browser the tests of the page are skipped.
browser-test: $(INSTALLED)
	@$(HAS_BROWSER) || { \
	    echo "Installing Chromium and Playwright for the tests of the page."; \
	    $(PIP) playwright || true; \
	    $(AS_ROOT) true 2>/dev/null && command -v apt-get >/dev/null && { $(APT_GET) update; $(APT_GET) install --no-install-recommends chromium; } >/dev/null 2>&1 || true; \
	    $(HAS_BROWSER) || echo "No browser. To have one: sudo apt-get install chromium"; \
	}
	@test -e $(VENV)/axe/package/axe.min.js || { mkdir -p $(VENV)/axe && cd $(VENV)/axe && npm pack --silent $(AXE) >/dev/null 2>&1 && \
	    tar xzf axe-core-*.tgz package/axe.min.js; } || echo "No axe-core from npm, so accessibility is not tested."

# Without Dask the tests of a cluster are skipped, without PostgreSQL those of a store that instances share.
scale-test: $(COMPILED)
	@$(HAS_SCALE) || $(PIP) -e ".[$(EXTRAS),distributed,postgres]" || echo "No Dask or no psycopg for this Python."
	@ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || { \
	    echo "Installing PostgreSQL for the tests of several instances."; \
	    $(AS_ROOT) true 2>/dev/null && command -v apt-get >/dev/null && { $(APT_GET) update; $(APT_GET) install --no-install-recommends postgresql; } >/dev/null 2>&1 || \
	    echo "No PostgreSQL. To have it: sudo apt-get install postgresql"; \
	}
	@$(PYTEST) -rs tests/cluster tests/service/shared tests/mission/test_mission_store.py tests/cli/test_serve_shared.py tests/test_scale_page.py

fuzz: $(COMPILED)
	@folder=$$(mktemp -d) && trap 'rm -r "$$folder"' EXIT && \
	    $(ONE_THREAD) $(BIN)/python benchmarks/fuzz.py --seconds $(SECONDS) --results "$$folder"

check: $(INSTALLED)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/codespell .
	@test -x $(VENV)/biome/package/biome || { mkdir -p $(VENV)/biome && cd $(VENV)/biome && npm pack --silent $(BIOME) >/dev/null 2>&1 && \
	    tar xzf *.tgz && chmod +x package/biome; } || echo "No Biome from npm, so the page's script is not checked."
	@test ! -x $(VENV)/biome/package/biome || $(VENV)/biome/package/biome lint --error-on-warnings

bench: $(COMPILED)
	@set -e; for script in $(BENCHMARKS); do echo "$$script"; $(BIN)/python "$$script"; done

bench-quick: $(COMPILED)
	@$(BIN)/python benchmarks/quick.py

docs: $(INSTALLED)
	@$(HAS_MKDOCS) || $(PIP) -e ".[$(EXTRAS),docs]"
	@$(BIN)/python tools/settings_reference.py
	@$(BIN)/python tools/reference_pages.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "To read it with search: python3 -m http.server --directory site, then open http://127.0.0.1:8000"

# constraints.txt says the versions; this adds the hashes.
lock: $(INSTALLED)
	@$(BIN)/uv pip compile -q pyproject.toml --extra service --extra camera --group build --constraint constraints.txt --generate-hashes --no-annotate --no-header \
	    --python-version 3.11 --python-platform x86_64-manylinux_2_28 --only-binary :all: -o deploy/requirements.lock

sbom: $(INSTALLED)
	@$(BIN)/python tools/sbom.py >sbom.json

audit: $(INSTALLED)
	@$(BIN)/python tools/audit.py

proto: $(INSTALLED)
	@cd src && ../$(BIN)/python -m grpc_tools.protoc --proto_path=. --python_out=. --pyi_out=. fcslam/wire/*.proto
