# Every routine command. `make run` and `make test` each do all of their own set-up on a machine with Rust, Node and make.
#
# Every cargo call uses --release and the default features, so that the dependencies are compiled once.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

CARGO ?= cargo
CARGO_TARGET_DIR ?= $(CURDIR)/target
export CARGO_TARGET_DIR
# Arguments of `kesi serve` under `make run`, for example: make run ARGS="--listen 0.0.0.0:8080 --scene scenes/flag.toml"
ARGS ?=
# Empty, or a folder for pictures of the viewer: make test-browser SCREENSHOTS=pictures
SCREENSHOTS ?=

KESI := $(CARGO_TARGET_DIR)/release/kesi
WEB_INSTALLED := web/node_modules/.package-lock.json
WEB_BUILT := web/dist/index.html
WEB_SOURCES := $(shell find web/src web/index.html web/public web/vite.config.ts web/tsconfig.json -type f 2>/dev/null)

.PHONY: help run test check check-rust check-web check-counts test-rust test-web test-browser bench picture web chromium valgrind clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

run: web ## build everything and serve (ARGS="--scene ...")
	$(CARGO) run --release -- serve $(ARGS)

test: check test-web test-rust test-browser ## all checks and all tests

check: check-rust check-web check-counts ## formatting, lints, docs, licences, types, instructions of a tick

check-rust: web
	$(CARGO) fmt --check
	$(CARGO) clippy --release --all-targets --all-features -- -D warnings
	$(CARGO) clippy --release --all-targets --no-default-features -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --no-deps
	@if command -v cargo-deny >/dev/null; then $(CARGO) deny check; else echo "cargo-deny is not installed: licences and advisories not checked"; fi

check-counts: web valgrind
	$(CARGO) test --release --test counts

check-web: $(WEB_INSTALLED)
	cd web && npm run --silent check

test-rust: web
	$(CARGO) test --release

test-web: $(WEB_INSTALLED)
	cd web && npm test --silent

test-browser: web chromium
	$(CARGO) build --release
	cd web && KESI_BIN="$(KESI)" KESI_SCREENSHOTS="$(abspath $(SCREENSHOTS))" node tests/browser.mjs

picture: web chromium ## take the README's picture anew
	$(CARGO) build --release
	cd web && KESI_BIN="$(KESI)" KESI_SCREENSHOTS="$(CURDIR)/target/pictures" node tests/browser.mjs
	cp target/pictures/viewer-drag.png web/drape.png

bench: web ## run time against error: all benches, the table's report in target/bench
	$(CARGO) run --release -- bench settle
	$(CARGO) run --release -- bench live
	$(CARGO) run --release -- bench scaling
	$(CARGO) run --release -- bench skip
	$(CARGO) run --release -- bench table --json target/bench-table.json --report target/bench

web: $(WEB_BUILT) ## build the viewer into web/dist, which the binary embeds

$(WEB_INSTALLED): web/package.json web/package-lock.json web/.npmrc
	cd web && npm ci
	touch $@

$(WEB_BUILT): $(WEB_INSTALLED) $(WEB_SOURCES)
	cd web && npm run --silent build
	touch $@

# The browser test needs a Chromium; Debian's is good. Another one is named in CHROMIUM.
chromium:
	@[ -n "$${CHROMIUM:-}" ] || command -v chromium chromium-browser google-chrome >/dev/null || { \
		sudo=; [ "$$(id -u)" = 0 ] || sudo=sudo; \
		$$sudo apt-get update && $$sudo apt-get install -y --no-install-recommends chromium; }

# Counting instructions needs valgrind.
valgrind:
	@command -v valgrind >/dev/null || { \
		sudo=; [ "$$(id -u)" = 0 ] || sudo=sudo; \
		$$sudo apt-get update && $$sudo apt-get install -y --no-install-recommends valgrind; }

clean: ## remove what make built
	$(CARGO) clean
	rm -rf web/dist web/node_modules
