#!/bin/sh
# Makes the archive of libpalpate for C, C++ and C#: libpalpate-VERSION-linux-MACHINE.tar.gz. Unpack it anywhere.
set -eu
. "$(dirname "$0")/common.sh"

[ "$(uname -s)" = Linux ] || skip 'this script makes the archive for Linux'
need_file "$built/deps/libpalpate_c.so" 'make build'
need_file "$built/deps/libpalpate_c.a" 'make build'
folder=libpalpate-$version-linux-$machine
sh contrib/install.sh "$work/$folder" "$built"
# The programs are in other packages.
rm -r "${work:?}/$folder/bin"
if command -v strip >/dev/null; then
    strip --strip-unneeded "$work/$folder/lib/libpalpate.so.$version"
    strip --strip-debug "$work/$folder/lib/libpalpate.a"
fi
# pkg-config finds the archive where you unpack it.
# shellcheck disable=SC2016
sed -i 's|^prefix=.*|prefix=${pcfiledir}/../..|' "$work/$folder/lib/pkgconfig/palpate.pc"
mkdir -p "$work/$folder/share/doc/palpate"
cp clients/c/examples/*.c clients/cpp/examples/*.cpp clients/cpp/examples/CMakeLists.txt docs/your-engine.md "$work/$folder/share/doc/palpate/"
licences "$work/$folder/share/doc/palpate"
pack "$out/$folder.tar.gz" "$work" "$folder"
made "$out/$folder.tar.gz"
