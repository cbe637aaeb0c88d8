#!/bin/sh
# Makes the wheel of the Python package from the compiled module, for CPython 3.9 and later. maturin, which pyproject.toml
# names, compiles; so wheel.py packs here. If contrib/build-windows.sh has compiled the module, also the wheel for Windows.
set -eu
. "$(dirname "$0")/common.sh"

need_tool "$python" 'apt-get install python3'
"$python" -c 'import tomllib' 2>/dev/null || skip "$python is older than 3.11"
need_tool objdump 'apt-get install binutils'
need_file "$built/libpalpate_native.so" 'make build'
mkdir "$work/licences"
licences "$work/licences"
binary "$built/libpalpate_native.so" "$work/_native.abi3.so"

# manylinux_A_B promises to run with glibc A.B and later, and needs only libraries that every Linux has.
for library in $(objdump -p "$work/_native.abi3.so" | sed -n 's/^ *NEEDED *//p'); do
    case $library in
        libgcc_s.so.1|libc.so.6|libm.so.6|libdl.so.2|librt.so.1|libpthread.so.0|ld-linux-*) ;;
        *) fail "the module needs $library, so it is no manylinux" ;;
    esac
done
platform=manylinux_$(glibc "$work/_native.abi3.so" | tr . _)_$machine
file=$("$python" $packages/wheel.py "$version" "$platform" "$work/_native.abi3.so" "$work/licences" "$out")
made "$file"

if [ ! -e "$windows/palpate_native.dll" ]; then
    say 'without the wheel for Windows: make build-windows'
    exit
fi
need_tool x86_64-w64-mingw32-objdump 'apt-get install binutils-mingw-w64-x86-64'
windows_binary "$windows/palpate_native.dll" "$work/_native.pyd"
# python3.dll is the stable interface of every CPython 3; a module that asks for python39.dll would need that version.
only_of_windows "$work/_native.pyd" python3.dll
imports "$work/_native.pyd" | grep -qi '^python3[.]dll$' || fail 'the module does not ask for python3.dll'
file=$("$python" $packages/wheel.py "$version" win_amd64 "$work/_native.pyd" "$work/licences" "$out")
made "$file"
