# make demo [ARGS="--seed 3"]   position a disk in the simulated world
# make test [ARGS="-k name"]    every ring of the tests
# make campaign                 the checks that take hours, recorded in benchmarks/RESULTS.md
# make oldest [ARGS=test/pure]  pure and driver tests and a demo with the versions of Ubuntu 24.04
# make lint                     style and types
# make clean                    remove everything that was made here
# make reference                write what is made from declarations: messages, reference pages, figures
# make docs                     the documents and the API as a site: build/site/index.html
# make lock                     choose the versions in requirements.lock again
#
# Each sets up what it needs first (see env.sh); there is nothing else to install or to call before.

SHELL := /bin/bash
.SHELLFLAGS := -e -u -o pipefail -c
ARGS ?=

.PHONY: demo test campaign oldest lint clean lock reference docs

demo:
	@. ./env.sh; python -m tapping_cell demo $(ARGS)

test:
	@. ./env.sh; python environment/run_tests.py $(ARGS)

campaign:
	@. ./env.sh; python -m benchmarks --section simulated-time --count 20000 --write; python -m lab mutate --write; \
		python test/support/file_readers.py; python test/support/serial_codecs.py; \
		export HYPOTHESIS_PROFILE=campaign; python -m pytest test/graph -q $(ARGS); \
		python -m pytest test/pure -n auto -q --timeout 0 $(ARGS)

oldest:
	@. ./env.sh; python environment/run_oldest.py $(ARGS)

lint:
	@. ./env.sh; ruff check .; ruff format --check .; mypy

clean:
	@rm -rf .venv build install log runs .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@find . -name .git -prune -o \( -name __pycache__ -o -name '*.egg-info' \) -type d -prune -exec rm -rf {} +

reference:
	@. ./env.sh; python environment/generate_messages.py; ruff format -q tapping_cell/messages; python environment/reference_pages.py; python environment/build_figures.py

docs:
	@. ./env.sh; python environment/build_site.py

lock:
	@python3 environment/lock.py
