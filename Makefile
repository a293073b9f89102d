# make demo               a sample scene into a container and back, and what that cost
# make demo SCENE=x.ply   the same with your own
# make test               all tests
# make lint               format, lint, types, import contract
# make bench              bytes, time, memory and errors of all presets (SCENE=x.ply for your own)
# make docs               what is generated in docs/

SCENE ?=
PRESET ?= balanced
KISSGS = .venv/bin/kissgs

.PHONY: demo test lint bench docs setup setup-dev clean

demo: setup
	@$(KISSGS) demo $(if $(SCENE),"$(SCENE)") --preset $(PRESET)

test: setup-dev
	@.venv/bin/pytest -q -n auto

lint: setup-dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

bench: setup
	@mkdir -p demo-out
	@test -n "$(SCENE)" || $(KISSGS) sample demo-out/sample.ply --force
	@$(KISSGS) bench --pictures "$(if $(SCENE),$(SCENE),demo-out/sample.ply)"

docs: setup-dev
	@.venv/bin/python docs/generate.py

setup:
	@scripts/setup run

setup-dev:
	@scripts/setup dev

clean:
	@rm -rf .venv demo-out build dist
