# make demo | test | bench | lint: each sets up .venv first, once. Another Python: make test PYTHON=/path/to/python3.12
# LOCKED=1 installs exactly what .ci/lock.txt names, as CI does.

PYTHON ?=
BIN := .venv/bin
EXTRAS := test,lint,bluetooth-simulator,hotplug
CANDIDATES := $(or $(PYTHON),python3 python3.14 python3.13 python3.12 python3.11)

.PHONY: help demo test bench soak faults fuzz cost-per-byte mesh-proof mesh-scale lint lock audit clean

help:
	@echo "make demo    a broker and simulated robots of every protocol, for a look"
	@echo "make test    all tests"
	@echo "make bench   the figures of the README"
	@echo "make soak    a broker under load and faults for long: MINUTES=10; fails if it uses more and more"
	@echo "make faults  every fault on every kind of link, and how long it takes to recover; as root for all"
	@echo "make fuzz    attack all that hears strangers: SECONDS=60 in all; ARGUMENTS=--keep keeps what reached something new"
	@echo "make cost-per-byte   what a byte costs each codec at worst"
	@echo "make mesh-proof   how the mesh heals, as root: EVENTS=100 a network, SEED=1"
	@echo "make mesh-scale   how the mesh grows from 5 to 50 brokers, simulated"
	@echo "make lint    ruff, mypy, the import rules"
	@echo "make lock    what CI installs, anew: .ci/lock.txt; ARGUMENTS=--upgrade takes the newest"
	@echo "make audit   whether what CI installs has known vulnerabilities"
	@echo "make clean   remove what was set up"

demo: .venv/.ready
	@$(BIN)/psiu-broker demo

test: .venv/.ready
	$(BIN)/pytest $(PYTEST_ARGS)

bench: .venv/.ready
	@$(BIN)/python -m tests.bench

soak: .venv/.ready
	@$(BIN)/python -m tests.soak --minutes $(or $(MINUTES),10) --seed $(or $(SEED),1)

faults: .venv/.ready
	@PSIU_FAULTS=all $(BIN)/pytest tests/system/faults -q -s $(PYTEST_ARGS)

fuzz: .venv/.ready
	@$(BIN)/python -c 'import atheris' 2>/dev/null || $(BIN)/pip install --quiet -e '.[fuzz]'
	@$(BIN)/python -m tests.attack --seconds $(or $(SECONDS),60) $(ARGUMENTS)

cost-per-byte: .venv/.ready
	@$(BIN)/python -m tests.bench.cost_per_byte $(ARGUMENTS)

mesh-proof: .venv/.ready
	@PSIU_MESH_EVENTS=$(or $(EVENTS),100) PSIU_MESH_SEED=$(or $(SEED),$$(date +%s)) \
	    $(BIN)/pytest tests/system/test_mesh_chaos.py -q -s $(PYTEST_ARGS)

mesh-scale: .venv/.ready
	@$(BIN)/python -m tests.bench.mesh_scale

lint: .venv/.ready
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

lock: .venv/.ready
	@$(BIN)/pip install --quiet uv
	@PATH="$(BIN):$$PATH" .ci/lock $(ARGUMENTS)

audit: .venv/.ready
	@$(BIN)/python -c 'import pip_audit' 2>/dev/null || $(BIN)/pip install --quiet -e '.[audit]'
	@$(BIN)/python .ci/audit.py

clean:
	rm -rf .venv

.venv/.ready: pyproject.toml Makefile
	@python=; for candidate in $(CANDIDATES); do \
	    if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	    echo "psiu-broker needs Python 3.11 or newer, and none of these is: $(CANDIDATES)." >&2; \
	    echo "Install one, or name it: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11" >&2; exit 1; \
	fi; \
	if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
	    echo "$$python cannot make virtual environments; on Debian: apt install python3-venv" >&2; exit 1; \
	fi; \
	echo "Setting up .venv with $$($$python --version): once, for a minute or two"; \
	"$$python" -m venv .venv && export PIP_DISABLE_PIP_VERSION_CHECK=1 && if [ -n "$(LOCKED)" ]; then \
	    $(BIN)/pip install --quiet --require-hashes -r .ci/lock.txt && \
	    $(BIN)/pip install --quiet --no-deps --no-build-isolation -e .; \
	else $(BIN)/pip install --quiet -e '.[$(EXTRAS)]'; fi && touch $@
