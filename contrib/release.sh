#!/bin/sh
# Makes the files of a release in target/release-files (or the folder given):
#
#   palpate          static, for any Linux of this processor: needs the target *-unknown-linux-musl and a C compiler for it
#   palpate-client   dynamic: it reads the system's certificate authorities
#   palpate.tar      the container image of contrib/Dockerfile: needs docker; `docker load < palpate.tar`
#   SHA256SUMS       of all of these
#
# `sh contrib/release.sh [FOLDER]`. If it can't make a file, it says so at the end, with exit status 3.
# PALPATE_TARGET chooses another target, CARGO another cargo, DOCKER another docker (podman, say).
set -eu

cd "$(dirname "$0")/.."
out=${1:-target/release-files}
cargo=${CARGO:-cargo}
docker=${DOCKER:-docker}
target=${PALPATE_TARGET:-$(uname -m)-unknown-linux-musl}
missing=''

say() { echo "release: $*" >&2; }
# The files that were not made, with the reasons.
skip() {
    say "not made: $1: $2"
    missing="$missing $1"
}
# Cargo's own variable for the C compiler of a target, in lower case with underscores.
compiler() {
    eval "given=\${CC_$(echo "$target" | tr - _):-}"
    for name in "$given" "$(uname -m)-linux-musl-gcc" musl-gcc; do
        if [ -n "$name" ] && command -v "$name" >/dev/null; then
            echo "$name"
            return
        fi
    done
}

command -v "$cargo" >/dev/null || { say 'Rust is missing: install it from https://rustup.rs'; exit 1; }
mkdir -p "$out"
rm -f "$out/palpate" "$out/palpate-client" "$out/palpate.tar" "$out/SHA256SUMS"

# The folder of compiled files, also with CARGO_TARGET_DIR.
built=${CARGO_TARGET_DIR:-target}

# The static program contains the page, because it has no folder beside it.
page=clients/viewer/dist/index.html
features=''
if [ -f "$page" ]; then features='--features viewer'; else say "without the page: $page is missing (make viewer)"; fi

if [ ! -d "$(rustc --print target-libdir --target "$target" 2>/dev/null)" ]; then
    skip palpate "the target $target is not installed: rustup target add $target"
elif [ -z "$(compiler)" ]; then
    skip palpate "a C compiler for $target is missing (Debian: apt-get install musl-tools)"
else
    # shellcheck disable=SC2086
    env "CC_$(echo "$target" | tr - _)=$(compiler)" \
        "$cargo" build --release --locked --target "$target" --package palpate --bin palpate $features
    cp "$built/$target/release/palpate" "$out/"
fi

"$cargo" build --release --locked --package palpate-programs --bin palpate-client
cp "$built/release/palpate-client" "$out/"

if ! command -v "$docker" >/dev/null; then
    skip palpate.tar "$docker is missing"
elif ! "$docker" info >/dev/null 2>&1; then
    skip palpate.tar "$docker is installed, but its daemon does not answer"
else
    "$docker" build --file contrib/Dockerfile --tag palpate .
    "$docker" save --output "$out/palpate.tar" palpate
fi

(
    cd "$out"
    for file in palpate palpate-client palpate.tar; do
        if [ -f "$file" ]; then sha256sum "$file"; fi
    done >SHA256SUMS
)
say "made in $out:"
sed 's/^/    /' "$out/SHA256SUMS" >&2
if [ -n "$missing" ]; then
    say "not made:$missing"
    exit 3
fi
