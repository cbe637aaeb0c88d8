#!/bin/sh
# Makes the wheel of the Python package from the compiled module, for CPython 3.9 and later. maturin, which pyproject.toml
# names, compiles; so wheel.py packs here.
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
