#!/bin/sh
# Packs the crates for programs in Rust, palpate-NAME-VERSION.crate, and tries them: compiles and runs a program outside of the workspace
# that uses the packed crates, without a network. Environment: common.sh, CARGO, and TRY_TARGET, the folder for what the try compiles.
set -eu
. "$(dirname "$0")/common.sh"

cargo=${CARGO:-cargo}
# Each after those that it uses.
crates='palpate-refusal palpate-haptics palpate-geometry palpate-proto palpate-client'
# Larger ones contain what nobody needs, bytes.
largest=1000000
need_tool "$cargo" 'install Rust from https://rustup.rs'
# Cargo 1.90 is the first that packs crates that use each other at once.
minor=$("$cargo" --version | sed -n 's/^cargo 1\.\([0-9]*\)\..*/\1/p')
[ "${minor:-90}" -ge 90 ] || skip "$("$cargo" --version) is too old: it needs 1.90"

selected=''
for crate in $crates; do selected="$selected --package $crate"; done
# Files that are not committed count too. Only the packing: the try below compiles.
# shellcheck disable=SC2086
"$cargo" package --quiet --offline --locked --allow-dirty --no-verify --target-dir "$work/packed" $selected ||
    skip 'cargo package failed: if it wants a network, run cargo fetch first'
for crate in $crates; do
    file=$work/packed/package/$crate-$version.crate
    size=$(stat -c %s "$file")
    [ "$size" -le $largest ] || fail "$crate-$version.crate has $size bytes, more than $largest"
    tar -xzf "$file" -C "$work"
    for part in LICENSE-MIT LICENSE-APACHE README.md Cargo.toml src/lib.rs; do
        [ -s "$work/$crate-$version/$part" ] || fail "$crate-$version.crate has no $part"
    done
    cmp -s LICENSE-MIT "$work/$crate-$version/LICENSE-MIT" || fail "LICENSE-MIT of $crate is another"
done
for part in generated/palpate.v1.rs generated/palpate.v1.bin palpate/v1/haptic.proto; do
    [ -s "$work/palpate-proto-$version/$part" ] || fail "palpate-proto-$version.crate has no $part"
done

# A program of a user. The versions of all other crates are those of the repository's lock.
mkdir -p "$work/user/src"
cp Cargo.lock "$work/user/"
cat >"$work/user/Cargo.toml" <<TOML
[package]
name = "user"
version = "0.0.0"
edition = "2024"

[dependencies]
palpate-client = "$version"
palpate-geometry = "$version"

[patch.crates-io]
$(for crate in $crates; do echo "$crate = { path = \"../$crate-$version\" }"; done)
TOML
cat >"$work/user/src/main.rs" <<'RUST'
use palpate_client::{Credentials, Server};

fn main() -> Result<(), palpate_client::Error> {
    let organs = palpate_geometry::organ::Organ::ALL;
    println!("{} {}", Server::new("http://127.0.0.1:7117", &Credentials::default())?.url(), organs.len());
    Ok(())
}
RUST
try=${TRY_TARGET:-$work/try}
(cd "$work/user" && CARGO_TARGET_DIR=$try "$cargo" build --quiet --offline)
ran=$("$try/debug/user")
case $ran in
    'http://127.0.0.1:7117 '[1-9]*) ;;
    *) fail "the program of a user printed '$ran'" ;;
esac
for crate in $crates; do
    mv "$work/packed/package/$crate-$version.crate" "$out/"
    made "$out/$crate-$version.crate"
done
