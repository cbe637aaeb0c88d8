#!/bin/sh
# Installs libpalpate and the programs: `sh contrib/install.sh PREFIX BUILT`, where BUILT has what cargo has built
# (target/release). `make install PREFIX=…` builds first. DESTDIR is put before PREFIX, for packages.
#
#   include/palpate.h, palpate.hpp       lib/libpalpate.so, libpalpate.a       lib/pkgconfig/palpate.pc
#   lib/cmake/palpate/palpateConfig.cmake       share/palpate/Palpate.cs       bin/palpate, palpate-client (if they are built)
set -eu

sources=$(cd "$(dirname "$0")/../clients" && pwd)
prefix=${1:?PREFIX is missing}
built=${2:?BUILT is missing}
case $prefix in /*) ;; *) prefix=$PWD/$prefix ;; esac
root=${DESTDIR:-}$prefix
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' "$sources/../Cargo.toml")

mkdir -p "$root/bin" "$root/include" "$root/lib/pkgconfig" "$root/lib/cmake/palpate" "$root/share/palpate"
install -m 644 "$sources/c/include/palpate.h" "$sources/cpp/include/palpate.hpp" "$root/include/"
install -m 644 "$sources/cpp/cmake/palpateConfig.cmake" "$root/lib/cmake/palpate/"
install -m 644 "$sources/csharp/Palpate.cs" "$root/share/palpate/"
sed "s|@PREFIX@|$prefix|; s|@VERSION@|$version|" "$sources/c/palpate.pc.in" > "$root/lib/pkgconfig/palpate.pc"

# Cargo calls them libpalpate_c, because the server's own library is libpalpate.
install -m 644 "$built/deps/libpalpate_c.a" "$root/lib/libpalpate.a"
if [ -f "$built/deps/libpalpate_c.so" ]; then
    install -m 755 "$built/deps/libpalpate_c.so" "$root/lib/libpalpate.so.$version"
    ln -sf "libpalpate.so.$version" "$root/lib/libpalpate.so.0"
    ln -sf libpalpate.so.0 "$root/lib/libpalpate.so"
else
    # On macOS a program finds it by the name that it has in it.
    install -m 755 "$built/deps/libpalpate_c.dylib" "$root/lib/libpalpate.dylib"
    install_name_tool -id "$prefix/lib/libpalpate.dylib" "$root/lib/libpalpate.dylib"
fi
for program in palpate palpate-client; do
    if [ -f "$built/$program" ]; then install -m 755 "$built/$program" "$root/bin/"; fi
done
