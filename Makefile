# One word each: run, test, lint, bench-…. Everything is built from crates.io, PyPI and npm.

CARGO ?= cargo
PYTHON ?= python3
NODE ?= node
NPM ?= npm
# Where `make run` listens.
LISTEN ?= 127.0.0.1:7117
SCRIPT ?= scripts/press.toml

VENV := target/venv

VIEWER := clients/viewer
# crates/xtask: the tasks that every system has, also one without make and a shell.
XTASK := PYTHON='$(PYTHON)' NODE='$(NODE)' NPM='$(NPM)' $(CARGO) xtask

PACKAGES := deb wheel npm crates library image helm unity unreal

.PHONY: help run fetched-crates programs install header protocol test-protocol test-abi bench-tick build release viewer page-if-node test test-long test-viewer test-observe test-python bench-python test-arm build-windows test-windows check-macos test-asan test-valgrind test-debug test-mutants need-arm need-windows need-cross stress stress-cuts libfuzzer lint packages $(PACKAGES:%=package-%) picture figures screenshot page-states film scene-pictures bench-roundtrip bench-duty \
	bench-frames bench-error bench-tolerance bench-kernel bench-stability bench-skip bench-mesh bench-organ bench-solid bench-rest bench-link bench-prediction bench-viewer bench-load bench-fleet trainees soak siege fuzz need-rust \
	need-python chaos site

help:
	@echo 'make run             build, serve on $(LISTEN), poke the tissue, plot the force, and keep serving for a browser'
	@echo 'make protocol        proto/generated, the Rust code of the protocol, from its sources'
	@echo 'make release         static server, client, container image and checksums in target/release-files; reports what it can not make'
	@echo 'make packages        packages that need no compiler, with checksums, in target/packages (docs/packages.md); one alone:'
	@echo '                     make package-deb, -wheel, -npm, -crates, -library, -image, -helm, -unity or -unreal'
	@echo 'make install         libpalpate for C, C++ and C#, and the programs, below PREFIX=/usr/local'
	@echo 'make header          clients/c/include/palpate.h from its sources'
	@echo 'make viewer          the page that shows the tissue, clients/viewer/dist (Node.js; make run also builds it)'
	@echo 'make test            every test (Rust, Python 3, and the page in a browser)'
	@echo 'make test-long       every test of Rust in its long form; docs/tests.md lists the differences'
	@echo 'make test-protocol   is proto/generated that of the protocol?'
	@echo 'make test-viewer     the page alone; its screenshots are in target/viewer'
	@echo 'make test-observe    traces for OpenTelemetry and the bridge to Foxglove, which are optional features'
	@echo 'make test-python     the Python package alone: installed with pip in target/venv, and its tests'
	@echo 'make test-arm        the same bits on ARM (NEON): operations and plans under qemu-user; prints what it needs'
	@echo 'make build-windows   programs, libpalpate and the module for Python for Windows, for its packages (25 min the first time)'
	@echo 'make test-windows    builds for Windows (25 min the first time), compares its results under Wine with those of Linux, and runs its service (2 min)'
	@echo 'make check-macos     compiles the crates for macOS, without linking'
	@echo 'make test-asan       the kernel under the address sanitizer'
	@echo 'make test-valgrind   the kernel under memcheck of valgrind, plain and AVX2'
	@echo 'make test-abi        libpalpate from C under valgrind and the address sanitizer; its interface compared with the stored one'
	@echo 'make test-debug      the kernel with debug assertions'
	@echo 'make test-mutants    the number of 300 mutants of kernel, touch and sessions that the tests catch (an hour or two)'
	@echo 'make stress          ten thousand random scenes, a million steps on 200 meshes, ten million steps, a thousand thin meshes,'
	@echo '                     five thousand snapshots (an hour or two)'
	@echo 'make stress-cuts     random cuts, burns, tears, threads and clips until CUTS=1000000 springs are severed, from seed FROM=0 on, with progress'
	@echo 'make fuzz            a million malformed inputs for every decoder (some minutes)'
	@echo 'make libfuzzer       one decoder under libFuzzer: TARGET=request (or scene, script, …) FUZZ_SECONDS=60'
	@echo 'make lint            formatting, compiler and clippy warnings, and the counts of tests/counts.py'
	@echo 'make picture         docs/poke.svg, the curve of the guide'
	@echo 'make figures         the paper'"'"'s figures and experiments: docs/figures, shown in docs/paper.md'
	@echo 'make site            the guide as a site with search, target/site/index.html; fails on a broken link or a missing picture'
	@echo 'make screenshot      the screenshot of the README'
	@echo 'make page-states     a picture of each state of the page, at three widths, light and dark, in target/viewer/states'
	@echo 'make film            pictures and films of the page: two hands lift and stroke a gallbladder, a cut is sutured; target/viewer'
	@echo 'make scene-pictures  the pictures of the scenes in the list of the page'
	@echo 'make bench-roundtrip the haptic round trip compared with a bare gRPC echo'
	@echo 'make bench-duty      a minute of 1 kHz touch and 60 frames a second: time kept, commands lost'
	@echo 'make bench-rest      a thousand sessions at rest: their share of a core, and the memory of each'
	@echo 'make bench-frames    a frame compared with a plain copy of its bytes, and the bytes of a poke: docs/benchmarks/frames.md'
	@echo 'make bench-error     run time against error, every scheme on seven sheets and two organs: docs/benchmarks/error.md'
	@echo 'make bench-tolerance is the tolerance kept? Random scenes against f64 at 1e-10: docs/benchmarks/tolerance.md'
	@echo 'make bench-kernel    the time of a step compared with the machine'"'"'s limits, numba, Taichi and NumPy'
	@echo 'make bench-link      touch over a network in virtual time, by delay, tissue, hand and scheme: docs/benchmarks/link.md'
	@echo 'make bench-prediction  touch on organs from a copy of the tissue, compared with local models: docs/benchmarks/prediction.md'
	@echo 'make bench-tick      the time of a tick of the touch thread while others are busy'
	@echo 'make bench-viewer    331 × 331 points at 60 frames a second in a browser, and from a press to its pixel'
	@echo 'make bench-stability the largest stable step, predicted and observed'
	@echo 'make bench-skip      time saved by skipping tissue at rest, and the error'
	@echo 'make bench-mesh      the time of a step on meshes, at every width, with numba, Taichi and a plain loop:'
	@echo '                     docs/benchmarks/mesh.md'
	@echo 'make bench-organ     organs: time of a step, sleep, tips, and evenness of touch: docs/benchmarks/organ.md'
	@echo 'make bench-solid     solids: time of a substep, touch against other methods: docs/benchmarks/solid.md'
	@echo 'make bench-python    a run in Python compared with the program, and a study of 1000 tissues with numba and NumPy'
	@echo 'make bench-load      number of sessions on one core, with clients and without: docs/benchmarks/load.md'
	@echo '                     ATTACK=all: the effect of 59 attacks on a client (half an hour): docs/benchmarks/attacks.md;'
	@echo '                     one attack alone: make bench-load ATTACK=endless-scene'
	@echo 'make bench-fleet     a fleet compared with one server, and the capacity of etcd: docs/benchmarks/fleet.md;'
	@echo '                     one part alone: ARGUMENTS=calls (or spread, steps, etcd)'
	@echo 'make trainees        simulated trainees of three exercises, TRAINEE_SEEDS=20 truths each: what their scores tell (an hour)'
	@echo 'make soak            random clients for SECONDS=1800: memory, handles, threads, and every command accounted for; then'
	@echo '                     clients and servers killed KILLS=50 times'
	@echo 'make siege           eight attackers at random against four honest clients for SECONDS=1800, by SEED=16: their times,'
	@echo '                     memory, and whether all memory is returned; make test runs it for 30 s'
	@echo 'make chaos           a fleet in virtual time for SECONDS=1000000, with crashes, pauses and partitions, from SEED=16 on;'
	@echo '                     then ROUNDS=200 of real servers that are killed, frozen and cut off from etcd, etcd without'
	@echo '                     its leader (LEADERS=10) and gone (GONE_S=60), MOVES=200 under a tool: an hour or more'

need-rust:
	@command -v $(CARGO) >/dev/null || { echo 'Rust is missing: install it from https://rustup.rs' >&2; exit 1; }

need-python:
	@$(PYTHON) -c 'import sys, venv, ensurepip; assert sys.version_info >= (3, 9)' 2>/dev/null || \
		{ echo 'Python 3.9 or later with venv is missing (Debian: apt-get install python3-venv)' >&2; exit 1; }

build: need-rust
	$(CARGO) build --release --workspace

# The two programs alone. The libraries for C and Python take as long again.
PROGRAMS := --package palpate --package palpate-programs
programs: need-rust
	$(CARGO) build --release $(PROGRAMS)

# Below PREFIX: include, lib (with pkg-config and CMake), bin. As a package: DESTDIR=….
PREFIX ?= /usr/local
BUILT := $(or $(CARGO_TARGET_DIR),target)/release
install: build
	sh contrib/install.sh '$(PREFIX)' $(BUILT)

header: need-rust
	PALPATE_WRITE_HEADER=1 $(CARGO) test --release --package palpate-c --test header

# The generator is no part of the workspace.
GENERATOR := --quiet --locked --target-dir $(CURDIR)/target/generator
protocol: need-rust
	cd proto/generator && $(CARGO) run $(GENERATOR)

test-protocol: need-rust
	$(XTASK) test protocol

release: need-rust page-if-node
	CARGO=$(CARGO) sh contrib/release.sh

# What each script packs is built first; `sh contrib/packages/NAME.sh` alone packs what is there.
packages: build page-if-node fetched-crates
	BUILT='$(BUILT)' PYTHON='$(PYTHON)' NPM='$(NPM)' sh contrib/packages/all.sh

# All of Cargo.lock: the script of the crates asks no network.
fetched-crates: need-rust
	$(CARGO) fetch --quiet --locked

package-deb package-image: programs page-if-node
package-wheel package-library package-unity package-unreal: build
package-npm: viewer
package-crates: fetched-crates
$(PACKAGES:%=package-%): package-%:
	BUILT='$(BUILT)' PYTHON='$(PYTHON)' NPM='$(NPM)' sh contrib/packages/$*.sh

viewer: need-rust
	@$(XTASK) page

# Whoever has no Node.js, or no way to npm, is served all the same.
page-if-node:
	@$(MAKE) --no-print-directory viewer || echo 'So there is no page to look at; gRPC is served all the same.' >&2

# The server runs until Ctrl-C.
run: need-rust
	@$(XTASK) run --listen '$(LISTEN)' --script '$(SCRIPT)'

$(VENV)/ready: tests/python/requirements.txt clients/python/tests/requirements.txt | need-python
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --disable-pip-version-check -r tests/python/requirements.txt \
		-r clients/python/tests/requirements.txt
	touch $@

# `cargo xtask test --plan` prints the commands. The random cases are the same every time, so that the result is that of the
# change. `cargo test` alone draws others each time, and `make stress` many.
test: need-rust
	$(XTASK) test

test-long: build
	PALPATE_LONG=1 PROPTEST_RNG_SEED=20261122 $(CARGO) test --release --workspace --no-fail-fast -- --include-ignored \
		--skip write_the_golden_file

test-viewer: need-rust
	$(XTASK) test viewer

test-python: need-rust
	$(XTASK) test python

# As a user installs it, from what `build` has compiled: the tools for building are those of the environment, so that pip makes
# none of its own.
INSTALL_PYTHON = PATH="$(CURDIR)/$(VENV)/bin:$$PATH" $(VENV)/bin/pip install --quiet --disable-pip-version-check \
	--no-build-isolation --no-deps --force-reinstall ./clients/python
# What optional features bring: a program with these features takes the place of the other in target.
test-observe: need-rust
	$(CARGO) test --release --workspace --features palpate-server-tests/otlp,palpate-server-tests/foxglove --test observe
	$(CARGO) test --release --package palpate --features otlp --lib traces::


lint: need-rust
	$(XTASK) lint

picture: build
	$(PYTHON) docs/poke.py

# The same bytes on every run.
figures: need-rust
	$(CARGO) run --release --quiet --example figures

SITE_TOOLS := target/site-tools
$(SITE_TOOLS)/ready: contrib/site/requirements.txt | need-python
	$(PYTHON) -m venv $(SITE_TOOLS)
	$(SITE_TOOLS)/bin/pip install --quiet --disable-pip-version-check -r contrib/site/requirements.txt
	touch $@

site: $(SITE_TOOLS)/ready
	$(SITE_TOOLS)/bin/python contrib/site/build.py

screenshot: build viewer
	cd $(VIEWER) && $(NPM) run screenshot

# `make page-states STATES=first,lost WIDTHS=390`: some only.
page-states: build viewer
	cd $(VIEWER) && $(NPM) run states

film: build viewer
	cd $(VIEWER) && $(NPM) run film

scene-pictures: build viewer
	cd $(VIEWER) && $(NPM) run scene-pictures

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

# Ten thousand random scenes, as many that are merely legal, a soak of ten million steps, a thousand thin meshes under tips
# (`PALPATE_STRESS_THIN=10000` takes hours), five thousand snapshots that are restored, and a million severed springs.
stress: need-rust
	PALPATE_STRESS_SCENES=10000 PALPATE_STRESS_MESHES=200 PALPATE_STRESS_SOLIDS=1000 PALPATE_STRESS_THIN=1000 PALPATE_SNAPSHOTS=5000 PALPATE_STRESS_CUTS=1000000 \
		$(CARGO) test --release --test without_server -- stress:: legal:: thin:: restored:: cuts:: --include-ignored --nocapture
	$(CARGO) test --release --test physics -- --include-ignored --nocapture

# Random cuts alone: CUTS severed springs and faces, from the random seed FROM on, with progress.
CUTS ?= 1000000
FROM ?= 0
stress-cuts: need-rust
	PALPATE_STRESS_CUTS=$(CUTS) PALPATE_STRESS_CUTS_FROM=$(FROM) $(CARGO) test --release --test without_server -- cuts:: --nocapture

# The unit tests of the tissue, and the golden hashes.
KERNEL := --package palpate-tissue --package palpate --lib --test determinism

# Another processor, the same bits. The compiler and the standard library for ARM are Debian's. An emulated vector takes some
# thousand times as long: `make test-arm ARM_TESTS="--test determinism"` for whole courses, and hours.
ARM_TESTS ?= --package palpate-tissue --lib -- a_plan_gives every_operation
ARM := aarch64-unknown-linux-gnu
need-arm:
	@test -x /usr/bin/cargo -a -d /usr/lib/rustlib/$(ARM) && command -v aarch64-linux-gnu-gcc qemu-aarch64 >/dev/null || \
		{ echo 'A compiler for ARM or qemu is missing. Debian: dpkg --add-architecture arm64; apt-get update;' >&2; \
		echo 'apt-get install rustc-web cargo-web libstd-rust-web-dev:arm64 gcc-aarch64-linux-gnu qemu-user' >&2; exit 1; }

test-arm: need-arm
	RUSTC=/usr/bin/rustc CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
		CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER='qemu-aarch64 -L /usr/aarch64-linux-gnu' \
		/usr/bin/cargo test --release --target $(ARM) --target-dir target/arm $(ARM_TESTS)

# Builds for Windows, and runs the result under Wine. tests/windows/check.sh says what.
need-cross:
	@test -x /usr/bin/cargo -a -d /usr/lib/rustlib/src || \
		{ echo 'A compiler for other systems is missing. Debian: apt-get install rustc-web cargo-web rust-web-src' >&2; exit 1; }

need-windows: need-cross
	@command -v x86_64-w64-mingw32-gcc >/dev/null && { command -v wine64 >/dev/null || test -x /usr/lib/wine/wine64; } || \
		{ echo 'A linker for Windows or Wine is missing. Debian: apt-get install gcc-mingw-w64-x86-64 wine64' >&2; exit 1; }

# For the packages for Windows, which `make package-library` and `make package-wheel` then also make.
build-windows: need-rust
	CARGO='$(CARGO)' sh contrib/build-windows.sh

test-windows: need-windows build
	BUILT=$(BUILT) sh tests/windows/check.sh
	BUILT=$(BUILT) sh tests/windows/service.sh

# Compiles for macOS, without linking.
check-macos: need-cross
	sh tests/macos/check.sh

# The sanitizer's runtime comes with the stable compiler, its switch does not.
# Less optimization, because the checks make the code several times as long.
test-asan: need-rust
	CARGO_PROFILE_RELEASE_OPT_LEVEL=1 CARGO_PROFILE_RELEASE_CODEGEN_UNITS=16 CARGO_PROFILE_RELEASE_DEBUG=false \
		RUSTC_BOOTSTRAP=1 RUSTFLAGS=-Zsanitizer=address $(CARGO) test --release --target $(shell uname -m)-unknown-linux-gnu \
		--target-dir target/asan $(KERNEL) -- --skip scene:: --skip texture::

# Memcheck does not know AVX-512: `auto` becomes AVX2.
test-valgrind: need-rust
	@command -v valgrind >/dev/null || { echo 'valgrind is missing (Debian: apt-get install valgrind)' >&2; exit 1; }
	CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER='valgrind --error-exitcode=1 --quiet' \
		$(CARGO) test --release $(KERNEL) -- every_operation region:: a_plan_gives the_golden_hash --test-threads=1

# tests/abi/check.sh says what it leaves out because a tool is missing.
test-abi: build
	sh tests/abi/check.sh $(BUILT)

test-debug: need-rust
	CARGO_PROFILE_RELEASE_DEBUG_ASSERTIONS=true $(CARGO) test --release --target-dir target/assertions $(KERNEL) \
		--package palpate-session --test physics

# `make test-mutants ARGUMENTS='--count 20 --seed 7 --afresh'`; exit status 1 if fewer than nine in ten are caught.
test-mutants: need-rust need-python
	@command -v cargo-mutants >/dev/null || { echo 'cargo-mutants is missing: cargo install cargo-mutants' >&2; exit 1; }
	$(PYTHON) tests/mutants/run.py $(ARGUMENTS)

# A million inputs a decoder; FUZZ_INPUTS=… for more.
FUZZ_INPUTS ?= 1000000
fuzz: need-rust
	PALPATE_FUZZ_INPUTS=$(FUZZ_INPUTS) $(CARGO) test --release --package palpate --package palpate-geometry --test fuzz --test allocated -- --nocapture

# The same functions under libFuzzer, which looks for inputs that reach further; needs a C++ compiler, and no other Rust.
TARGET ?= request
FUZZ_SECONDS ?= 60
HOST := $(shell rustc -vV 2>/dev/null | sed -n 's/^host: //p')
COVERAGE := --cfg fuzzing -Ccodegen-units=1 -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
	-Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
	-Cllvm-args=-sanitizer-coverage-trace-compares
libfuzzer: need-rust
	cd fuzz && RUSTFLAGS='$(COVERAGE)' $(CARGO) build --release --target $(HOST)
	mkdir -p fuzz/target/corpus/$(TARGET)
	fuzz/target/$(HOST)/release/$(TARGET) -max_total_time=$(FUZZ_SECONDS) -timeout=20 -max_len=16384 fuzz/target/corpus/$(TARGET)

# `make bench-error ARGUMENTS=--quick`, and bench-kernel and bench-frames likewise.
bench-error: need-rust
	$(CARGO) bench --quiet --bench error -- $(ARGUMENTS)

# `make bench-tolerance ARGUMENTS='--scenes 100 --seed 7 --tolerances 1e-3,1e-5'`; exit status 1 if one was broken.
bench-tolerance: need-rust
	$(CARGO) bench --quiet --bench tolerance -- $(ARGUMENTS)

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

bench-mesh: need-rust $(PEERS)/ready
	PEERS=$(PEERS)/bin/python $(CARGO) bench --quiet --bench mesh -- $(ARGUMENTS)

bench-organ: need-rust
	$(CARGO) bench --quiet --bench organ -- $(ARGUMENTS)

bench-solid: need-rust $(PEERS)/ready
	PEERS=$(PEERS)/bin/python $(CARGO) bench --quiet --bench solid -- $(ARGUMENTS)

bench-tick: need-rust
	$(CARGO) bench --quiet --package palpate-client --bench tick

# `make bench-viewer SECONDS=60 PRESSES=500`: these are the environment's.
bench-viewer: build viewer
	@cd $(VIEWER) && $(NPM) --silent run bench

# `make bench-link ARGUMENTS=--quick` for a minute's worth; the whole takes about half an hour.
bench-link: build
	$(CARGO) bench --quiet --bench link -- $(ARGUMENTS)

# `make bench-prediction ARGUMENTS=--quick` with one seed; the whole takes about a quarter of an hour.
bench-prediction: build
	$(CARGO) bench --quiet --bench prediction -- $(ARGUMENTS)

# `make bench-load ATTACK=unread-probes` is one row of the table of attacks, ATTACK=all all of that table, each three times
# (ARGUMENTS='--runs 1').
bench-load: build
	$(CARGO) bench --quiet --bench load -- $(if $(ATTACK),attacks $(ATTACK)) $(ARGUMENTS)

# `make bench-fleet ARGUMENTS=steps` prints one part alone; `ARGUMENTS=--quick` does all with small numbers.
bench-fleet: build
	$(CARGO) bench --quiet --bench fleet -- $(ARGUMENTS)

# With numba beside it, if that installs: PEERS of bench-kernel.
bench-python: build $(VENV)/ready
	-$(VENV)/bin/pip install --quiet --disable-pip-version-check numba
	$(INSTALL_PYTHON)
	$(VENV)/bin/python clients/python/benches/run.py
	$(VENV)/bin/python clients/python/benches/study.py

# How well the score of an exercise tells kinds of trainees apart: so many truths of each level.
TRAINEE_SEEDS ?= 20
trainees: need-rust
	PALPATE_TRAINEE_SEEDS=$(TRAINEE_SEEDS) $(CARGO) test --release --workspace --test server -- trainees:: --nocapture

# How long, s.
SECONDS ?= 1800
KILLS ?= 50
JOURNAL_KILLS ?= 200
soak: need-rust
	PALPATE_SOAK_S=$(SECONDS) $(CARGO) test --release --workspace --test server -- soak:: --include-ignored --nocapture
	PALPATE_KILLS=$(KILLS) $(CARGO) test --release --workspace --test server -- kill:: --skip journal_kill:: --nocapture
	PALPATE_JOURNAL_KILLS=$(JOURNAL_KILLS) PALPATE_JOURNAL_SESSIONS=20 \
		$(CARGO) test --release --workspace --test server -- journal_kill:: --nocapture
	PALPATE_LONG=1 $(CARGO) test --release --test without_server -- journal:: --nocapture
	PALPATE_LONG=1 $(CARGO) test --release --workspace --test server -- no_step_waits_for_a_disk_that_stalls --nocapture

# Each seed is another siege; the first failure is said as it is found, all of them at the end.
SEED ?= 16
siege: need-rust
	PALPATE_SIEGE_S=$(SECONDS) PALPATE_SIEGE_SEED=$(SEED) $(CARGO) test --release --workspace --test siege -- --nocapture

# The fleet's histories, simulated s; a seed that fails is told with its last events. Then real servers on a real etcd.
ROUNDS ?= 200
LEADERS ?= 10
GONE_S ?= 60
MOVES ?= 200
CHAOS := $(CURDIR)/target/chaos.txt
chaos: SECONDS = 1000000
chaos: need-rust
	PALPATE_FLEET_SECONDS=$(SECONDS) PALPATE_FLEET_SEED=$(SEED) $(CARGO) test --release --test fleet_model -- --nocapture
	@mkdir -p $(dir $(CHAOS)); rm -f $(CHAOS)
	PALPATE_FLEET_ROUNDS=$(ROUNDS) PALPATE_FLEET_SESSIONS=12 PALPATE_FLEET_RESTING=48 PALPATE_FLEET_FROZEN_S=10 \
		PALPATE_FLEET_LEADERS=$(LEADERS) PALPATE_FLEET_GONE_S=$(GONE_S) PALPATE_FLEET_MOVES=$(MOVES) \
		PALPATE_FLEET_SEED=$(SEED) PALPATE_FLEET_SUMMARY=$(CHAOS) \
		$(CARGO) test --release --workspace --test server -- fleet_chaos:: --include-ignored --nocapture --test-threads=1; \
		ended=$$?; echo; cat $(CHAOS); exit $$ended
