# Two commands do everything on a fresh machine: `make fit` and `make test`.
PYTHON ?= python3.11
VENV ?= .venv
# A CPU build of PyTorch. For CUDA: make clean; make fit TORCH=torch==2.13.0
TORCH ?= torch==2.13.0+cpu
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
OUTPUT ?= runs/pictures

BIN = $(VENV)/bin
READY = $(VENV)/.ready
DEV_READY = $(VENV)/.ready-dev

.PHONY: fit test test-all lint format bench soak fuzz clean

fit: $(READY)
	$(BIN)/trainer fit --config wskp_bmfr.yaml
	$(BIN)/trainer test --config wskp_bmfr.yaml
	$(BIN)/trainer denoise --model models:/wskp/latest sample:bmfr --split test --output $(OUTPUT) --png --force

# One process for each core, files whole, one thread in each: half the time.
test: $(DEV_READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n auto --dist loadfile

test-all: $(DEV_READY)
	$(BIN)/python -m pytest

lint: $(DEV_READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(DEV_READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(DEV_READY)
	$(BIN)/python -m tests.benchmarks

# Half an hour: a training of which 30 processes are killed, with its servers.
soak: $(DEV_READY)
	$(BIN)/python -m tests.benchmarks.soak

# Readers of files from outside, 20,000 mutated inputs for each format.
fuzz: $(DEV_READY)
	$(BIN)/python -m tests.fuzz --count 20000

$(VENV)/.torch:
	$(PYTHON) -m venv $(VENV)
	@echo "Installing PyTorch ($(TORCH))"
	$(BIN)/pip install --quiet "$(TORCH)" || $(BIN)/pip install --quiet "$(TORCH)" --index-url "$(TORCH_INDEX)"
	@touch $@

$(READY): $(VENV)/.torch pyproject.toml constraints.txt
	@echo "Installing Penumbra"
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(DEV_READY): $(READY)
	@echo "Installing what tests and linters need"
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]"
	@touch $@

# Leaves runs/ alone: those are results.
clean:
	rm -rf $(VENV) bench dist build .mypy_cache .ruff_cache .pytest_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
