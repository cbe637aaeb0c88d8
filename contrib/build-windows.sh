#!/bin/sh
# Compiles for Windows (x86-64) on Linux: `sh contrib/build-windows.sh build --release ARGUMENT…`, which passes everything to cargo.
# Without arguments it compiles what the packages have: programs, libpalpate and the module for Python. The results are in
# $WINDOWS/x86_64-pc-windows-gnu/release [default: target/windows].
#
# It needs MinGW, and either the standard library for x86_64-pc-windows-gnu (`rustup target add x86_64-pc-windows-gnu`), or Debian's
# rustc-web, cargo-web and rust-web-src: Debian has the sources of the standard library, which are compiled too.
set -eu

cd "$(dirname "$0")/.."
target=x86_64-pc-windows-gnu
export CARGO_TARGET_X86_64_PC_WINDOWS_GNU_LINKER=x86_64-w64-mingw32-gcc CC_x86_64_pc_windows_gnu=x86_64-w64-mingw32-gcc
if [ $# = 0 ]; then
    set -- build --release -p palpate -p palpate-programs -p palpate-c -p palpate-python \
        --lib --bin palpate --bin palpate-client
fi
cargo=${CARGO:-cargo}
command -v x86_64-w64-mingw32-gcc >/dev/null ||
    { echo 'build-windows: MinGW is missing. Debian: apt-get install gcc-mingw-w64-x86-64' >&2; exit 3; }
set -- "$@" --target $target --target-dir "${WINDOWS:-target/windows}"
if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
    if ! [ -x /usr/bin/cargo ] || ! [ -d /usr/lib/rustlib/src ]; then
        echo "build-windows: the standard library for $target is missing: rustup target add $target" >&2
        exit 3
    fi
    export RUSTC_BOOTSTRAP=1 RUSTC=/usr/bin/rustc RUSTDOC=/usr/bin/rustdoc
    cargo=/usr/bin/cargo
    set -- "$@" -Zbuild-std=std,panic_unwind
fi
exec "$cargo" "$@"
