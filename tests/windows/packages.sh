#!/bin/sh
# Tries the packages for Windows: `sh tests/windows/packages.sh`, after `make build-windows package-library package-wheel`.
#
# It unpacks the archive of libpalpate, builds the examples with its CMake package and MinGW, and runs them under Wine at a server on
# this machine. It lets pip install the wheel for Windows, and checks the names of its files.
#
# OUT is the folder of the packages [default: target/packages], BUILT that of the programs for this machine [target/release].
set -eu

cd "$(dirname "$0")/../.."
built=${BUILT:-target/release}
work=$(mktemp -d)
server=''
trap 'if [ -n "$server" ]; then kill "$server" 2>/dev/null; fi; rm -rf "$work"' EXIT
export WINEPREFIX="${WINEPREFIX:-$PWD/target/windows/wine}"

say() { echo "packages for Windows: $*" >&2; }
archive=$(echo "${OUT:=target/packages}"/libpalpate-*-windows-x86_64.zip)
wheel=$(echo "$OUT"/palpate-*-cp39-abi3-win_amd64.whl)
for file in "$archive" "$wheel"; do
    [ -f "$file" ] || { say "$file is missing: make build-windows package-library package-wheel"; exit 3; }
done
python3 -m zipfile -e "$archive" "$work"
folder=$work/$(basename "$archive" .zip)

# What a user writes for MinGW on Linux. Its C++ threads are in the variant `posix`.
cat >"$work/mingw.cmake" <<'END'
set(CMAKE_SYSTEM_NAME Windows)
set(CMAKE_C_COMPILER x86_64-w64-mingw32-gcc-posix)
set(CMAKE_CXX_COMPILER x86_64-w64-mingw32-g++-posix)
set(CMAKE_EXE_LINKER_FLAGS_INIT -static)
END
mkdir "$work/c"
cat >"$work/c/CMakeLists.txt" <<END
cmake_minimum_required(VERSION 3.16)
project(examples C)
find_package(palpate REQUIRED)
foreach(example look touch)
  add_executable(\${example} $folder/share/doc/palpate/\${example}.c)
  target_link_libraries(\${example} PRIVATE palpate::palpate m)
endforeach()
END
build() { # sources, folder of the programs
    cmake -S "$1" -B "$2" -DCMAKE_TOOLCHAIN_FILE="$work/mingw.cmake" -DCMAKE_PREFIX_PATH="$folder" >/dev/null
    cmake --build "$2" >/dev/null
    cp "$folder/bin/palpate.dll" "$2"
}
build "$work/c" "$work/built-c"
sets='built-c'
if command -v x86_64-w64-mingw32-g++-posix >/dev/null; then
    build "$folder/share/doc/palpate" "$work/built-cpp"
    sets='built-c built-cpp'
else
    say 'without the examples in C++: apt-get install g++-mingw-w64-x86-64-posix'
fi

"$built/palpate" serve --listen 127.0.0.1:0 --log error >"$work/serving" &
server=$!
until grep -qs http "$work/serving"; do sleep 0.2; kill -0 "$server"; done
url=$(grep -o 'http[^[:space:]]*' "$work/serving" | head -1)
mkdir -p "$WINEPREFIX"
if [ ! -d "$WINEPREFIX/drive_c" ]; then sh tests/windows/wine.sh wineboot --init >/dev/null 2>&1 || true; fi
x86_64-w64-mingw32-gcc -O -shared tests/windows/bcryptprimitives.c -o "$work/bcryptprimitives.dll" -ladvapi32
cp "$work/bcryptprimitives.dll" "$WINEPREFIX/drive_c/windows/system32/"
for set in $sets; do
    sh tests/windows/wine.sh "$work/$set/look.exe" "$url" liver 1 >"$work/look"
    sh tests/windows/wine.sh "$work/$set/touch.exe" "$url" liver 5 >"$work/touch"
    force=$(sed -n 's/.*"force_max_n":\([0-9.]*\).*/\1/p' "$work/touch")
    say "$set: look and touch ran under Wine; largest force $force N"
    # touch goes down until it feels 0.02 N, and then 3 mm further. How much it feels there depends on the machine's load.
    echo "$force" | awk '{ exit !($1 > 0.02) }'
done

for version in 3.9 3.13; do
    python3 -m venv "$work/venv"
    "$work/venv/bin/pip" install --quiet --disable-pip-version-check --no-index --no-deps --only-binary=:all: \
        --platform win_amd64 --python-version "$version" --target "$work/site-$version" "$wheel"
    test -f "$work/site-$version/palpate/_native.pyd" -a -f "$work/site-$version/palpate/__init__.py"
done
test ! -e "$work/site-3.9/palpate/_native.abi3.so"
say "the wheel: pip takes it for Python 3.9 and 3.13 on Windows; it has $(ls "$work/site-3.9/palpate" | wc -l) files"
