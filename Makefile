.PHONY: check test test-fast docs tables

check: ## lint, format, types
	ruff check . && ruff format --check . && mypy

test: ## all tests, on all cores
	pytest -n auto --dist loadfile

test-fast: ## all tests without those marked slow
	pytest -n auto --dist loadfile -m "not slow"

docs: ## the documentation as a site, in build/site
	mkdocs build

tables: ## tables of results in the pages, from the files of the shipped policies
	python docs/make/tables.py
