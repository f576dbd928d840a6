# make report   executes the notebooks on every dataset in data/ and writes report/ and results/
# make hand-in  builds the report and writes hand-in.zip: the PDF and the .mat files to hand in
# make test     checks the style, and runs all tests
# make quick    runs most tests, in a minute or two
# make studies  computes the rows of all studies anew, notebooks/studies/*.csv, or those of the
#               notebooks that CHAPTERS names
# make mutants  prints which small defects of the numerics no test notices
# make lab      opens JupyterLab on the notebooks, with ARGS="--no-browser --port 9999" or others
# make docs     writes pages of slamlib's functions to build/api
# make strip    restores saved notebooks to the form in which they are committed
# make bench    prints how long what takes, beside a plain GTSAM script
# Every target sets up what it needs in .venv first. Choose the Python with PYTHON=python3.12.

VENV := .venv
CANDIDATES := python3 python3.14 python3.13 python3.12 python3.11
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	"$$p" -c '$(FITS)' >/dev/null 2>&1 && echo "$$p" && exit; done; echo python3)
BIN := $(VENV)/bin
# Two processes, each of which takes file after file.
PARALLEL := --numprocesses 2 --dist loadfile --no-loadscope-reorder
# An environment holds the folder's path and the Python it was made by: moved, or without that
# Python, it is made anew.
READY := $(VENV)/.ready-$(shell printf %s "$(CURDIR)" | cksum | cut -d' ' -f1)
ifneq ($(shell $(BIN)/python -c 'print("runs")' 2>/dev/null),runs)
$(shell rm -f $(READY))
endif

.PHONY: setup report hand-in test quick studies mutants lab docs strip bench clean
.DEFAULT_GOAL := report

# What editors and kernels write into notebooks, besides outputs, is not committed.
STRIP := -m nbstripout --keep-id --extra-keys "metadata.language_info cell.metadata.editable \
	cell.metadata.slideshow cell.metadata.trusted"

# In a git checkout, also configures the filter that .gitattributes names: git stores notebooks as
# `make strip` leaves them.
setup: $(READY)
	@! git ls-files --error-unmatch .gitattributes >/dev/null 2>&1 || git config --local \
		filter.nbstripout.clean '"$(CURDIR)/$(BIN)/python" $(STRIP)' \
		2>/dev/null || echo "git's configuration cannot be written: strip notebooks by 'make strip'." >&2

$(READY): requirements.txt pyproject.toml
	@"$(PYTHON)" -c '$(FITS)' || { echo "Expected CPython 3.11 to 3.14, which gtsam has wheels for \
	on Linux (glibc) and macOS, found $(PYTHON): see environment.md." >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) lacks venv: install it (on Debian and Ubuntu: apt install python3-venv)." >&2; \
		exit 1; }
	@echo "Setting up $(VENV) with what requirements.txt lists: once, 1.2 GB, about a minute." >&2
	@rm -rf $(VENV)
	"$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes \
		--only-binary=:all: -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
		--editable .
	@$(BIN)/python -m compileall -q slamlib              # pip does so for all others
	@touch $@

report: $(READY)
	@$(BIN)/python -m slamlib report

hand-in: $(READY)
	@$(BIN)/python -m slamlib hand-in

test: $(READY)
	@$(BIN)/python $(STRIP) --verify notebooks/*.ipynb >/dev/null || { \
		echo "There are outputs in the notebooks: remove them with 'make strip'." >&2; exit 1; }
	@$(BIN)/python -m ruff check .
	$(BIN)/python -m pytest $(PARALLEL)

quick: $(READY)
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow"

# The notebooks run on a simulated drive, and write nothing else.
studies: STUDIES := $(CURDIR)/build/studies
studies: CHAPTERS ?= notebooks/[1-4A]*.ipynb
studies: $(READY)
	@rm -rf "$(STUDIES)"
	@$(BIN)/python -c 'import sys; from slamlib.studies.simulation import simulate, write_dataset; \
		write_dataset(sys.argv[1], *simulate())' "$(STUDIES)/data/short"
	SLAMLIB_STUDIES=write SLAMLIB_DATA="$(STUDIES)/data" SLAMLIB_RESULTS="$(STUDIES)/results" \
		OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m nbconvert --execute \
		--to notebook --output-dir "$(STUDIES)" $(CHAPTERS)

mutants: $(READY)
	$(BIN)/python tests/mutants.py $(ARGS)

# JupyterLab asks nothing when it opens, and looks for no newer version of itself. As root, as in
# containers, it listens to this machine alone. The matrices are small: more threads cost time.
lab: setup
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m jupyterlab --allow-root \
		--LabApp.app_settings_dir="$(CURDIR)/docs/lab" \
		--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate $(ARGS) notebooks

docs: $(READY)
	@PDOC_ALLOW_EXEC=1 $(BIN)/python -m pdoc --docformat markdown --template-directory docs/api \
		--output-directory build/api slamlib slamlib.core slamlib.robust slamlib.io slamlib.solve \
		$(subst /,.,$(basename $(wildcard slamlib/notebook/[!_]*.py slamlib/studies/[!_]*.py)))
	@echo "Pages of all functions: build/api/index.html"

strip: $(READY)
	@$(BIN)/python $(STRIP) notebooks/*.ipynb

bench: $(READY)
	@$(BIN)/python tests/benchmarks/speed.py

clean:
	rm -rf $(VENV) report results build slamlib.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
