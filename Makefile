# make demo               a service is started, compresses a sample scene, and is stopped; the result is compared
# make demo SCENE=x.ply   the same with your own
# make serve              the service, with its page, on http://127.0.0.1:8000 (KISSGS_PORT=… and others: docs/guide/service.md)
# make test               tests of everything, some minutes
# make test-all           the same with all examples, parameters, trainings and faults; half an hour
# make lint               format, lint, types, import contract; of the JavaScript, format and types
# make bench              bytes, time, memory and errors of all presets (SCENE=x.ply for your own)
# make docs               what is generated in docs/

SCENE ?=
PRESET ?= balanced
KISSGS = .venv/bin/kissgs

.PHONY: demo serve test test-all lint bench docs setup setup-dev clean

demo: setup
	@scripts/demo "$(SCENE)" $(PRESET)

serve: setup
	@.venv/bin/kissgs-serve

test: setup-dev
	@.venv/bin/pytest -q -n auto -m "not exhaustive"

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
	@$(KISSGS) bench codecs --evaluate "$(if $(SCENE),$(SCENE),demo-out/sample.ply)"

docs: setup-dev
	@.venv/bin/python docs/generate.py

setup:
	@scripts/setup run

setup-dev:
	@scripts/setup dev

clean:
	@rm -rf .venv demo-out build dist web_decoder/vendor
