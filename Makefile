# Two commands from a fresh clone: `make demo` and `make test`. Everything lands in .venv and out.

export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
# Where it is set, each start of Python compiles every module anew, in each of the many programs of the tests.
unexport PYTHONDONTWRITEBYTECODE

BIN := .venv/bin
STAMP := .venv/.stamp

.DEFAULT_GOAL := help
.PHONY: help env demo paper_forward paper_accurate test test-one test-all check lint bench hardcases paper pictures docs docs-serve clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

env: $(STAMP) ## make .venv with everything needed (redone when pyproject.toml changes)

$(STAMP): pyproject.toml tools/make-env
	@sh tools/make-env .venv
	@touch $@

demo: $(STAMP) ## run the paper's forward scene, and at the same time the same on an accurate mesh, into out/
	@$(MAKE) --no-print-directory -j2 --output-sync=target paper_forward paper_accurate

paper_forward paper_accurate:
	@$(BIN)/softgrasp simulate $@

lint: $(STAMP) ## ruff, mypy and the import contracts
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint ## what to run before a commit: lint, types of what changed, the tests of the project itself
	$(BIN)/python -m pytest -q tests/test_project.py

# More ranks than cores: a rank that waits gives its core away (MPICH; without it this part took twice as long).
test test-one test-all: export MPIR_CVAR_CH4_PROGRESS_THROTTLE = 1
test: $(STAMP) ## lint, all tests on one rank, those marked `ranks(2)` on 2, those marked `ranks` on 3
	@$(MAKE) --no-print-directory -j2 lint test-one
	$(BIN)/mpiexec -n 2 $(BIN)/python -m pytest -q --own-ranks
	$(BIN)/mpiexec -n 3 $(BIN)/python -m pytest -q --own-ranks

# Three runs: of one with all tests a worker was lost near its end now and then, after six minutes and without a word.
test-one: ONE = $(BIN)/python -m pytest -q -n 2 --dist loadfile --max-worker-restart=0
test-one: $(STAMP)
	$(ONE) tests/fem
	$(ONE) tests/reduction tests/lqr tests/benchmarks tests/hardcases
	$(ONE) tests/study tests/test_*.py

test-all: test ## the same, and everything else that runs on 2 ranks (nightly)
	$(BIN)/mpiexec -n 2 $(BIN)/python -m pytest -q

bench: $(STAMP) ## print the table of costs of the forward run
	$(BIN)/python -m benchmarks forward

hardcases: $(STAMP) ## run the suite of hard cases, with its page
	$(BIN)/python -m tests.hardcases

paper: $(STAMP) ## every figure and table of the paper, and a page that compares
	$(BIN)/python demos/paper.py --out out/paper

pictures: demo ## make the README's pictures again
	cp out/paper_forward-simulate/move.png docs/paper_forward.png
	cp out/paper_forward-simulate/move.gif docs/move.gif
	$(BIN)/softgrasp view out/paper_forward-simulate --save docs/view.png
	$(BIN)/softgrasp reduce paper_forward
	cp out/paper_forward-reduce/errors.png docs/reduce_errors.png
	$(BIN)/softgrasp control paper_lqr
	cp out/paper_lqr-control/errors.png docs/control_errors.png
	$(BIN)/softgrasp study paper_forward --question forward
	cp out/paper_forward-study/work_forward.png docs/study_forward.png
	$(BIN)/softgrasp effects franka_muscle
	cp out/franka_muscle-effects/effects.png docs/effects.png
	$(BIN)/python tools/draw_rooms.py docs/rooms.png
	cd docs && ../$(BIN)/python ../demos/demo_arm.py
	$(BIN)/python tools/draw_finite_strain.py docs/finite_strain.png
	$(BIN)/python -m tools.draw_hertz docs/hertz.png

docs: $(STAMP) ## build the documentation into out/site, with all links checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

docs-serve: docs ## the same on http://localhost:8000
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory out/site 8000

clean: ## remove .venv, out and caches
	rm -rf .venv out build *.egg-info .mypy_cache .ruff_cache .import_linter_cache
	find fem reduction lqr study softgrasp benchmarks tests demos -name __pycache__ -type d -prune -exec rm -rf {} +
