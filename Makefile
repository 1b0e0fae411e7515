# make reproduce [PROFILE=miniature] [KITTI_ROOT=dir] [ODOMETRY_ROOT=dir] [MAKE3D_ROOT=dir] [LABELS_ROOT=dir] [TEST_LIST=file]
#                [SEEDS=0,1,2] [ALLOW_LEAK=1] · make test · make help
PROFILE ?= miniature
PYTHON ?= python3.11
VENV := .venv
export PATH := $(CURDIR)/$(VENV)/bin:$(PATH)
export PYTHONPATH := $(CURDIR)
export HF_HUB_DISABLE_TELEMETRY := 1
# threads that wait must sleep: spinning ones make a busy machine ten times slower
export OMP_WAIT_POLICY := PASSIVE
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help env reproduce status test fast soak mutants lab lint browser lock bench bench-gpu publish notebooks clean

help: ## what can be made
	@echo "make reproduce [PROFILE=miniature] [KITTI_ROOT=dir] [ODOMETRY_ROOT=dir] [MAKE3D_ROOT=dir] [LABELS_ROOT=dir] [TEST_LIST=file]"
	@echo "               [SEEDS=0,1,2] [ALLOW_LEAK=1], and:"
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

# a folder's name reaches the shell as it was given, with all of $ # ' and blanks
quoted = '$(subst ','\'',$(value $(1)))'

# commands in .venv/bin name their Python by its full path
env: $(STAMP) ## make .venv from environment.lock
	@grep -qsF "$$(realpath $(VENV))/bin/python" $(VENV)/bin/pip || $(VENV)/bin/pip --version > /dev/null 2>&1 || \
	    { echo "error: $(VENV) was made where this folder was before; 'rm -r $(VENV) && make env' makes it anew" >&2; exit 1; }

$(STAMP): environment.lock pyproject.toml
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --requirement environment.lock
	$(VENV)/bin/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

REPRODUCE = dualdepth reproduce --profile $(call quoted,PROFILE) --kitti-root $(call quoted,KITTI_ROOT) --test-list $(call quoted,TEST_LIST) \
    --seeds $(call quoted,SEEDS) --odometry-root $(call quoted,ODOMETRY_ROOT) --make3d-root $(call quoted,MAKE3D_ROOT) \
    --labels-root $(call quoted,LABELS_ROOT) $(if $(filter 1,$(ALLOW_LEAK)),--allow-leak)

reproduce: env ## run every notebook of a profile: data, training, tables, figures
	@$(REPRODUCE)

status: env ## which steps `make reproduce` with the same settings would run, and why
	@said=$$($(REPRODUCE) -- --dry-run) && echo "$$said" | grep -E '^((local)?rule|    (wildcards|reason)|Nothing to be done)'

test: env lint ## lint, unit tests, the tiny chain, notebooks against their stored outputs
	pytest -m "not soak" $(SIDE_BY_SIDE) --dist worksteal
	dualdepth reproduce --profile tiny
	pytest --nbval $(SIDE_BY_SIDE) --dist loadscope $(filter-out $(REPORT),$(NOTEBOOKS))
	pytest --nbval --numprocesses 0 $(REPORT)
	@echo "all tests passed; the notebooks' data and weights are in work/tiny, tables and figures in results/tiny"

fast: env ## the fast ring of the unit tests, a minute; with the environment at hand `pytest` does the same
	pytest

mutants: env ## break lines of the science one at a time, and see that the tests notice each
	python -m tools.mutants

soak: env ## the long form of the tests of reliability, to results/published/reliability.csv: make soak [PARTS="kills fuzz"]
	python -m tests.reliability.soak $(PARTS)

# one more than CI has cores: much of a test is waiting
SIDE_BY_SIDE := --numprocesses 3
NOTEBOOKS := $(sort $(wildcard notebooks/*.ipynb))
# reads the tables that the others write
REPORT := notebooks/14_report.ipynb

lint: env ## ruff
	ruff check .
	ruff format --check .

lab: env ## JupyterLab on this machine's own address
	jupyter lab --ip 127.0.0.1 $$(test $$(id -u) != 0 || echo --allow-root) notebooks

bench: env ## speed of loader, training step, inference
	python -m tools.bench

bench-gpu: ## on a GPU: speed, memory, repeatability of both stages, hours of the paper's run; with .venv if it is there, else python3's packages
	python3 -m tools.bench_gpu

browser: ## install Debian's Chromium, for the tests that look at pages
	@sudo=$$(test $$(id -u) = 0 || echo sudo); $$sudo apt-get update -qq && $$sudo apt-get install -y -qq --no-install-recommends chromium chromium-driver

lock: ## make environment.lock from pyproject.toml
	rm -rf work/lock && $(PYTHON) -m venv work/lock
	work/lock/bin/python -m pip install --quiet --upgrade 'setuptools>=77' '.[notebooks,dev,export]'
	work/lock/bin/python -m pip freeze --all --exclude pip --exclude dualdepth | grep -viE '^(nvidia|triton|cuda)' | sed 's/+cpu$$//' > work/environment.lock
	grep -q '^torch==' work/environment.lock && mv work/environment.lock environment.lock
	rm -rf work/lock build

notebooks: env ## store the executed tiny notebooks as the committed ones
	python -m tools.publish notebooks

publish: env ## copy a profile's tables and figures to results/published
	python -m tools.publish results --profile $(call quoted,PROFILE)

clean: ## remove what a profile's runs made; downloads and .venv stay
	@name=$$(basename $(call quoted,PROFILE) | sed 's/\.ya\?ml$$//'); case "$$name" in \
	    ''|/|.*|kitti|published|lock|home) echo "error: '$$name' is no profile's name" >&2; exit 2 ;; esac; rm -rf "work/$$name" "results/$$name"
