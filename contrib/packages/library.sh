#!/bin/sh
# Makes the archive of libpalpate for C, C++ and C#: libpalpate-VERSION-linux-MACHINE.tar.gz. Unpack it anywhere. If
# contrib/build-windows.sh has compiled the library, also libpalpate-VERSION-windows-x86_64.zip.
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
documents() {
    mkdir -p "$1"
    cp clients/c/examples/*.c clients/cpp/examples/*.cpp clients/cpp/examples/CMakeLists.txt docs/your-engine.md "$1/"
    licences "$1"
}
documents "$work/$folder/share/doc/palpate"
pack "$out/$folder.tar.gz" "$work" "$folder"
made "$out/$folder.tar.gz"

if [ ! -e "$windows/palpate_c.dll" ]; then
    say 'without the archive for Windows: make build-windows'
    exit
fi
need_tool x86_64-w64-mingw32-dlltool 'apt-get install binutils-mingw-w64-x86-64'
need_tool "$python" 'apt-get install python3'
folder=libpalpate-$version-windows-x86_64
root=$work/$folder
mkdir -p "$root/bin" "$root/include" "$root/lib/cmake/palpate" "$root/share/palpate"
# Cargo calls it palpate_c, because the server's own library is palpate. C# looks for palpate.dll.
windows_binary "$windows/palpate_c.dll" "$root/bin/palpate.dll"
only_of_windows "$root/bin/palpate.dll"
cp clients/c/include/palpate.h clients/cpp/include/palpate.hpp "$root/include/"
cp clients/cpp/cmake/palpateConfig.cmake "$root/lib/cmake/palpate/"
cp clients/csharp/Palpate.cs "$root/share/palpate/"
documents "$root/share/doc/palpate"
# Import libraries name the library that a program loads, so those of the compiler, for palpate_c.dll, do not serve.
{
    printf 'LIBRARY palpate.dll\nEXPORTS\n'
    x86_64-w64-mingw32-objdump -p "$root/bin/palpate.dll" | sed -n 's/^\t\[ *[0-9]*\].* \(palpate_[a-z_0-9]*\)$/    \1/p' | sort -u
} >"$work/palpate.def"
[ "$(grep -c palpate_ "$work/palpate.def")" -gt 20 ] || fail 'palpate_c.dll exports too few functions'
# Names in it come from the time, the process and the path of the file, unless these options and a name without a folder are given.
(cd "$root/lib" && x86_64-w64-mingw32-dlltool --deterministic-libraries --temp-prefix palpate -D palpate.dll \
    -d "$work/palpate.def" -l libpalpate.dll.a)
if command -v llvm-dlltool >/dev/null; then
    llvm-dlltool -m i386:x86-64 -D palpate.dll -d "$work/palpate.def" -l "$root/lib/palpate.lib"
else
    say 'without palpate.lib, the import library for MSVC: apt-get install llvm'
fi
"$python" $packages/zip.py "$work" "$folder" "$out/$folder.zip"
made "$out/$folder.zip"
