# shellcheck shell=sh disable=SC2034
# The part that the scripts of this folder share; each reads it first. Environment:
#
#   BUILT               folder of the compiled programs and libraries (target/release, or that of CARGO_TARGET_DIR)
#   OUT                 folder of the packages (target/packages)
#   SOURCE_DATE_EPOCH   time of all files in a package (that of the last commit)
#
# Exit status of a script: 0 made, 3 not made because something is missing (the last line says what), 1 failed.
name=$(basename "$0" .sh)
cd "$(dirname "$0")/../.."
packages=contrib/packages
built=${BUILT:-${CARGO_TARGET_DIR:-target}/release}
out=${OUT:-target/packages}
python=${PYTHON:-python3}
# The one place of the version.
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
machine=$(uname -m)
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || echo 0)}
export SOURCE_DATE_EPOCH
page=clients/viewer/dist
mkdir -p "$out"
out=$(cd "$out" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
umask 022

say() { echo "$name: $*" >&2; }
fail() { say "$*"; exit 1; }
skip() { say "not made: $*"; exit 3; }
# need_file FILE REMEDY, need_tool NAME REMEDY
need_file() { [ -e "$1" ] || skip "$1 is missing: $2"; }
need_tool() { command -v "$1" >/dev/null || skip "$1 is missing: $2"; }

# What a package for an engine needs.
need_engine_parts() {
    [ "$(uname -s) $machine" = 'Linux x86_64' ] || skip 'it has the library for Linux on x86_64 alone'
    need_tool "$python" 'apt-get install python3'
    need_file "$built/deps/libpalpate_c.so" 'make build'
}

# Copies a program or library without its symbols, if strip is installed: binary FROM TO
binary() {
    install -m 755 "$1" "$2"
    if command -v strip >/dev/null; then strip --strip-unneeded "$2"; fi
}
# The newest version of glibc that the files ask for.
glibc() { objdump -T "$@" | sed -n 's/.*GLIBC_\([0-9.]*\).*/\1/p' | sort -uV | tail -1; }
# The licences of Palpate and of the libraries compiled into it: licences FOLDER
licences() {
    cp LICENSE-MIT LICENSE-APACHE "$1/"
    if "$python" "$packages/notices.py" >"$work/notices"; then
        cp "$work/notices" "$1/THIRD-PARTY.txt"
    else
        say 'without THIRD-PARTY.txt, the licences of the libraries: do not publish this package'
    fi
}
# Packs a folder with the same bytes every time: pack FILE.tar.gz PARENT FOLDER
pack() {
    tar --create --format=ustar --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 --numeric-owner --mode=u+rw,go-w \
        --directory "$2" "$3" | gzip -9n >"$1"
}
made() { say "made $1: $(stat -c %s "$1") bytes"; }
