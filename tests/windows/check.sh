#!/bin/sh
# Builds Palpate for Windows and runs it under Wine: `sh tests/windows/check.sh`, as `make test-windows` does.
#
# It compares the golden hashes of tests/determinism.rs, and the records of scripts, with those of Linux. It runs a server and its
# clients, each under Wine and on Linux, and programs in C with libpalpate. It prints how late the loop of a device and the server's
# steps are, under Wine and on Linux.
#
# BUILT is the folder of the programs for this machine [default: target/release].
set -eu

cd "$(dirname "$0")/../.."
built=${BUILT:-target/release}
target=x86_64-pc-windows-gnu
out=${WINDOWS:-target/windows}
WINEPREFIX=$(realpath -m "$out/wine")
export WINEPREFIX
work=$(mktemp -d)
server=''
trap 'if [ -n "$server" ]; then kill "$server" 2>/dev/null; fi; rm -rf "$work"' EXIT

say() { echo "test-windows: $*" >&2; }
windows() { sh tests/windows/wine.sh "$@"; }

mkdir -p "$WINEPREFIX"
windows wineboot --init >/dev/null 2>&1 || true
x86_64-w64-mingw32-gcc -O -shared tests/windows/bcryptprimitives.c -o "$work/bcryptprimitives.dll" -ladvapi32
cp "$work/bcryptprimitives.dll" "$WINEPREFIX/drive_c/windows/system32/"

say 'building'
sh contrib/build-windows.sh
exe=$out/$target/release

hash_of() { grep -o '"final_hash":"[0-9a-f]*"' "$1" | tail -1 | cut -d '"' -f 4; }

# The script and the hashes of tests/determinism.rs.
sed -n '/^const ALL_LAWS/,/^"#;/p' tests/determinism.rs | sed '1d;$d' > "$work/laws.toml"
golden() { grep -o "^const $1: &str = \"[0-9a-f]*" tests/determinism.rs | cut -d '"' -f 2; }
has_hash() { # name of the golden hash, options of the scene
    name=$1
    shift
    windows "$exe/palpate.exe" run paper "$work/laws.toml" "$@" --output "$work/laws.jsonl" --quiet
    test "$(hash_of "$work/laws.jsonl")" = "$(golden "$name")"
}
has_hash GOLDEN_F32 --set stepping.precision=f32
has_hash GOLDEN_F64 --set stepping.precision=f64 --set springs.bending=true --set stepping.substeps=3
say 'the golden hashes are those of Linux'

for run in 'paper press' 'paper vertical-60 --held' 'liver press' 'liver stroke' 'stomach push' 'fibrotic grasp' 'liver-organ press' 'liver-solid press'; do
    # shellcheck disable=SC2086
    set -- $run
    windows "$exe/palpate.exe" run "$@" --output "$work/windows.jsonl" --quiet 2>/dev/null
    "$built/palpate" run "$@" --output "$work/linux.jsonl" --quiet 2>/dev/null
    # Wall-clock times differ.
    for of in windows linux; do sed 's/"wall_s":[^,]*,"ns_per_point_substep":[^,]*,//' "$work/$of.jsonl" > "$work/$of"; done
    cmp "$work/windows" "$work/linux"
done
say 'eight runs of scripts: the same records as on Linux'

serve() { # command of a server
    rm -f "$work/serving"
    "$@" serve --listen 127.0.0.1:0 --metrics 127.0.0.1:0 --log error > "$work/serving" &
    server=$!
    until grep -qs metrics "$work/serving"; do sleep 0.2; kill -0 "$server"; done
    url=$(grep -o 'http[^[:space:]]*' "$work/serving" | head -1)
    metrics=$(grep -o 'http[^[:space:]]*' "$work/serving" | tail -1)
}
stop() {
    kill "$server"
    wait "$server" 2>/dev/null || true
    server=''
}
# Not by the function: the signal of `stop` must reach the server.
serve sh tests/windows/wine.sh "$exe/palpate.exe"
"$built/palpate-client" replay press --server "$url" --scene liver --output "$work/one.jsonl" --quiet
windows "$exe/palpate-client.exe" replay press --server "$url" --scene liver --output "$work/both.jsonl" --quiet
for example in look touch; do
    x86_64-w64-mingw32-gcc -std=c99 -I clients/c/include "clients/c/examples/$example.c" -o "$work/$example.exe" \
        "$exe/palpate_c.dll" -lm
done
cp "$exe/palpate_c.dll" "$work"
windows "$work/look.exe" "$url" liver 1
windows "$work/touch.exe" "$url" liver 2
say 'libpalpate.dll: the examples look and touch run'
late_of() { # command of a client
    python3 tests/windows/lateness.py "$metrics" "$@" bridge --server "$url" --scene liver --seconds 10 --json
}
late=$(late_of sh tests/windows/wine.sh "$exe/palpate-client.exe")
say "a device at 1 kHz for 10 s, client and server under Wine: $late"
stop
serve "$built/palpate"
late=$(late_of "$built/palpate-client")
say "the same on this machine: $late"
windows "$exe/palpate-client.exe" replay press --server "$url" --scene liver --output "$work/other.jsonl" --quiet
"$built/palpate-client" replay press --server "$url" --scene liver --output "$work/own.jsonl" --quiet
stop
for of in both other own; do test "$(hash_of "$work/one.jsonl")" = "$(hash_of "$work/$of.jsonl")"; done
say 'replays: the same final hash from each client at each server'
