#!/bin/sh
# libpalpate from C under tools that see more than a test does: `sh tests/abi/check.sh BUILT`, where BUILT is target/release.
# `make test-abi` builds first.
#
#   memcheck of valgrind: reads and writes outside, leaks. The address sanitizer: the same of the C programs. helgrind: races.
#   abidiff: the interface beside the one that is kept, tests/abi/libpalpate.abi. `sh tests/abi/check.sh BUILT interface` does that
#   alone, as `make test` does; `sh tests/abi/check.sh BUILT keep` keeps it.
#
# What can't be run is said, and is no failure.
set -eu

cd "$(dirname "$0")/../.."
built=${1:?BUILT is missing}
work=$(mktemp -d)
server=''
trap 'if [ -n "$server" ]; then kill "$server"; fi; rm -rf "$work"' EXIT

say() { echo "test-abi: $*" >&2; }
missing() { say "LEFT OUT: $1 is missing (Debian: apt-get install $2)"; }

sh contrib/install.sh "$work/prefix" "$built"
export LD_LIBRARY_PATH="$work/prefix/lib"

if command -v abidw >/dev/null; then
    # The names of functions alone: types are compared in the header, by clients/c/tests/header.rs.
    strip --strip-debug -o "$work/libpalpate.so" "$work/prefix/lib/libpalpate.so"
    abidw --no-show-locs --no-corpus-path --no-comp-dir-path "$work/libpalpate.so" > "$work/libpalpate.abi"
    if [ "${2:-}" = keep ]; then cp "$work/libpalpate.abi" tests/abi/libpalpate.abi; fi
    abidiff tests/abi/libpalpate.abi "$work/libpalpate.abi"
    say 'the interface is the one that is kept'
else
    missing abidw abigail-tools
fi
if [ "${2:-}" = interface ]; then exit; fi

compile() { # program, source, more options
    program=$1 source=$2
    shift 2
    cc -g -std=c99 "$source" -o "$work/$program" -I "$work/prefix/include" -L "$work/prefix/lib" "$@" -lpalpate -lm -lpthread
}

"$built/palpate" serve --listen 127.0.0.1:0 --log error > "$work/serving" &
server=$!
until grep -q http "$work/serving"; do sleep 0.1; kill -0 "$server"; done
url=$(grep -o 'http.*' "$work/serving")

if command -v valgrind >/dev/null; then
    compile errors clients/c/tests/errors.c
    compile touch clients/c/examples/touch.c
    valgrind='valgrind --quiet --fair-sched=try --error-exitcode=9'
    memcheck="$valgrind --leak-check=full --errors-for-leak-kinds=definite,indirect --show-leak-kinds=definite,indirect"
    $memcheck --suppressions=tests/abi/memcheck.supp "$work/errors" "$url"
    $memcheck --suppressions=tests/abi/memcheck.supp "$work/touch" "$url" liver 3
    say 'memcheck has found nothing'
    # helgrind.supp says what it can judge.
    $valgrind --tool=helgrind --suppressions=tests/abi/helgrind.supp \
        "$work/touch" "$url" liver 3
    say 'helgrind has found nothing'
else
    missing valgrind valgrind
fi

# The library itself is not instrumented: the sanitizer sees the programs, what they hand over, and all memory that is not given
# back, of both.
if echo 'int main(void) { return 0; }' | cc -x c - -fsanitize=address -o "$work/asan" 2>/dev/null; then
    compile errors-asan clients/c/tests/errors.c -fsanitize=address
    compile look-asan clients/c/examples/look.c -fsanitize=address
    compile touch-asan clients/c/examples/touch.c -fsanitize=address
    compile hands-asan clients/c/examples/hands.c -fsanitize=address
    ASAN_OPTIONS=detect_leaks=1 "$work/errors-asan" "$url"
    ASAN_OPTIONS=detect_leaks=1 "$work/look-asan" "$url" liver 1
    ASAN_OPTIONS=detect_leaks=1 "$work/touch-asan" "$url" liver 3
    ASAN_OPTIONS=detect_leaks=1 "$work/hands-asan" "$url" liver 60
    say 'the address sanitizer has found nothing'
else
    say 'LEFT OUT: the C compiler has no address sanitizer'
fi
