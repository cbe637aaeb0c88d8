# One word each: run, test, lint, bench-…. Everything is built from crates.io and PyPI.

CARGO ?= cargo
PYTHON ?= python3
# Where `make run` listens.
LISTEN ?= 127.0.0.1:7117
SCRIPT ?= scripts/vertical-60.toml

VENV := target/venv

.PHONY: help run build test stress lint picture bench-roundtrip bench-duty bench-frames bench-error bench-kernel \
	bench-stability bench-skip bench-rest bench-link fuzz need-rust need-python

help:
	@echo 'make run             build, serve on $(LISTEN), poke the tissue, draw what it felt, go on serving'
	@echo 'make test            every test (Rust and Python 3)'
	@echo 'make stress          ten thousand random scenes, ten million steps (some minutes)'
	@echo 'make fuzz            a million bent inputs for every decoder (some minutes); fuzz/ has them for libFuzzer'
	@echo 'make lint            formatting, compiler and clippy warnings'
	@echo 'make picture         the picture of the README'
	@echo 'make bench-roundtrip the haptic round trip beside a bare gRPC echo'
	@echo 'make bench-duty      a minute of 1 kHz touch and 60 frames a second: time kept, commands lost'
	@echo 'make bench-rest      a thousand sessions at rest: their share of a core, and the memory of each'
	@echo 'make bench-frames    a frame beside a plain copy of its bytes, and the bytes of a poke: docs/benchmarks/frames.md'
	@echo 'make bench-error     run time against error, every scheme on seven scenes: docs/benchmarks/error.md'
	@echo 'make bench-kernel    the time of a step beside the machine'"'"'s limits, numba, Taichi and NumPy'
	@echo 'make bench-link      touch over a network in virtual time, by delay, tissue, hand and scheme: docs/benchmarks/link.md'
	@echo 'make bench-stability the largest stable step, predicted and observed'
	@echo 'make bench-skip      what it saves to leave out what is at rest, and its error'

need-rust:
	@command -v $(CARGO) >/dev/null || { echo 'Rust is missing: install it from https://rustup.rs' >&2; exit 1; }

need-python:
	@$(PYTHON) -c 'import sys, venv, ensurepip; assert sys.version_info >= (3, 9)' 2>/dev/null || \
		{ echo 'Python 3.9 or later with venv is missing (Debian: apt-get install python3-venv)' >&2; exit 1; }

build: need-rust
	$(CARGO) build --release --workspace

# The server runs until Ctrl-C, which reaches it as well as this shell.
run: build
	@rm -f target/serving.txt; \
	./target/release/palpate serve --listen $(LISTEN) --log warn > target/serving.txt & server=$$!; \
	trap 'kill $$server 2>/dev/null; wait $$server; exit 0' INT TERM; \
	until grep -q http target/serving.txt; do kill -0 $$server 2>/dev/null || exit 1; sleep 0.05; done; \
	url=$$(grep -o 'http.*' target/serving.txt); \
	./target/release/palpate-client replay $(SCRIPT) --server $$url --output target/poke.jsonl --plot \
		|| { kill $$server; exit 1; }; \
	echo; echo "The records are in target/poke.jsonl. Serving on $$url until Ctrl-C."; \
	wait $$server

$(VENV)/ready: tests/python/requirements.txt | need-python
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --disable-pip-version-check -r tests/python/requirements.txt
	touch $@

test: build $(VENV)/ready
	$(CARGO) test --release --workspace
	$(VENV)/bin/python -m unittest discover -s tests/python -v

lint: need-rust
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --workspace --all-targets -- -D warnings

picture: build
	$(PYTHON) docs/poke.py

bench-roundtrip: build
	@echo "Machine: $$(sed -n 's/^model name.*: //p' /proc/cpuinfo 2>/dev/null | sort | uniq -c)"
	$(CARGO) bench --quiet --bench roundtrip

bench-duty: build
	@echo "Machine: $$(sed -n 's/^model name.*: //p' /proc/cpuinfo 2>/dev/null | sort | uniq -c)"
	$(CARGO) bench --quiet --bench duty

bench-rest: build
	@echo "Machine: $$(sed -n 's/^model name.*: //p' /proc/cpuinfo 2>/dev/null | sort | uniq -c)"
	$(CARGO) bench --quiet --bench rest

bench-frames: need-rust
	$(CARGO) bench --quiet --bench frames -- $(ARGUMENTS)

# Ten thousand random scenes, and a soak of ten million steps.
stress: need-rust
	PALPATE_STRESS_SCENES=10000 $(CARGO) test --release --test stress --test sleep -- --include-ignored --nocapture

# A million inputs a decoder; FUZZ_INPUTS=… for more.
FUZZ_INPUTS ?= 1000000
fuzz: need-rust
	PALPATE_FUZZ_INPUTS=$(FUZZ_INPUTS) $(CARGO) test --release --test fuzz -- --nocapture

# `make bench-error ARGUMENTS=--quick`, and bench-kernel and bench-frames likewise.
bench-error: need-rust
	$(CARGO) bench --quiet --bench error -- $(ARGUMENTS)

# The kernels that a user would write otherwise, each installed by itself: what does not install is left out.
PEERS := target/venv-peers
$(PEERS)/ready: benches/peers/requirements.txt
	@if $(PYTHON) -c 'import venv, ensurepip' 2>/dev/null; then \
		$(PYTHON) -m venv $(PEERS); \
		while read package; do \
			$(PEERS)/bin/pip install --quiet --disable-pip-version-check $$package \
				|| echo "left out: $$package does not install with $$($(PYTHON) --version); rm -r $(PEERS) to try again" >&2; \
		done < $<; \
		touch $@; \
	else echo 'left out: the peers need Python 3 with venv (Debian: apt-get install python3-venv)' >&2; fi

bench-kernel: need-rust $(PEERS)/ready
	PEERS=$(PEERS)/bin/python $(CARGO) bench --quiet --bench kernel -- $(ARGUMENTS)

bench-stability: need-rust
	$(CARGO) bench --quiet --bench stability

bench-skip: need-rust
	$(CARGO) bench --quiet --bench skip -- $(ARGUMENTS)
# `make bench-link ARGUMENTS=--quick` for a minute's worth; the whole takes about half an hour.
bench-link: build
	$(CARGO) bench --quiet --bench link -- $(ARGUMENTS)
