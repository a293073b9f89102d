# make demo               a service is started, compresses a sample scene, and is stopped; the result is compared
# make demo SCENE=x.ply   the same with your own
# make serve              the service, with its page, on http://127.0.0.1:8000 (KISSGS_PORT=… and others: docs/guide/service.md)
# make bench              bytes, seconds, memory and quality of all presets and of limited times (SCENE=x.ply for your own)
# make test               tests of everything, ten minutes (SIXTH=COMMIT: a sixth of the others too)
# make test-all           the same with all examples, parameters, trainings and faults; three quarters of an hour
# make lint               format, lint, types, import contract; of the JavaScript, format and types
# make docs               what is generated in docs/
# make setup              .venv alone, which the others make too (PYTHON=… for another Python, TRAIN=0 without torch)
# make setup-dev          the same, with what tests and checks need (TORCH_INDEX=… for another build of torch)
# make clean              removes all that make has made; the data of a service, kissgs-data, stays
# make help               this list

SCENE ?=
PRESET ?= balanced
KISSGS = .venv/bin/kissgs

.PHONY: help demo serve test test-all lint bench docs setup setup-dev clean

help:
	@sed -n '/^#/!q; s/^# //p' Makefile

demo: setup
	@scripts/demo "$(SCENE)" $(PRESET)

serve: setup
	@.venv/bin/kissgs-serve

test: setup-dev
	@.venv/bin/pytest -q -n auto $(if $(SIXTH),--sixth=$(SIXTH),-m "not exhaustive")

test-all: setup-dev
	@.venv/bin/pytest -q -n auto --hypothesis-profile=thorough

lint: setup-dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports
	@.venv/bin/python scripts/lint_language.py
	@PATH="$(CURDIR)/.venv/bin:$$PATH" npm --prefix web_decoder run --silent check

bench: setup
	@mkdir -p demo-out
	@test -n "$(SCENE)" || $(KISSGS) sample demo-out/sample.ply --force
	@$(KISSGS) bench "$(if $(SCENE),$(SCENE),demo-out/sample.ply)"

docs: setup-dev
	@.venv/bin/python docs/generate.py

setup:
	@scripts/setup run

setup-dev:
	@scripts/setup dev

clean:
	@rm -rf .venv demo-out build dist web_decoder/vendor web_decoder/.vendor-* web_decoder/node_modules
	@rm -rf .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .schemathesis
	@find kissgs service bench tests docs scripts -name __pycache__ -prune -exec rm -rf {} +
