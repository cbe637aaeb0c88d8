# shellcheck shell=sh disable=SC2034
# The part that the scripts of this folder share; each reads it first. Environment:
#
#   BUILT               folder of the compiled programs and libraries (target/release, or that of CARGO_TARGET_DIR)
#   WINDOWS             folder of what contrib/build-windows.sh has compiled (target/windows); packages for Windows are made if it
#                       has files
#   OUT                 folder of the packages (target/packages)
#   SOURCE_DATE_EPOCH   time of all files in a package (that of the last commit)
#
# Exit status of a script: 0 made, 3 not made because something is missing (the last line says what), 1 failed.
name=$(basename "$0" .sh)
cd "$(dirname "$0")/../.."
packages=contrib/packages
built=${BUILT:-${CARGO_TARGET_DIR:-target}/release}
windows=${WINDOWS:-target/windows}/x86_64-pc-windows-gnu/release
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
# The libraries that a file for Windows asks for: imports FILE
imports() { x86_64-w64-mingw32-objdump -p "$1" | sed -n 's/^\tDLL Name: //p' | sort -fu; }
# Fails if a file for Windows needs a library that Windows does not have, except those given: only_of_windows FILE [DLL…]
only_of_windows() {
    file=$1
    shift
    for library in $(imports "$file" | tr '[:upper:]' '[:lower:]'); do
        case " $* " in *" $library "*) continue ;; esac
        case $library in
            # advapi32, bcrypt, …: the system's own; msvcrt and the universal C runtime are part of Windows 10 and later.
            advapi32.dll|api-ms-win-*|bcrypt.dll|bcryptprimitives.dll|cfgmgr32.dll|combase.dll|crypt32.dll|hid.dll|iphlpapi.dll) ;;
            kernel32.dll|msvcrt.dll|ncrypt.dll|ntdll.dll|ole32.dll|oleaut32.dll|pdh.dll|powrprof.dll|psapi.dll) ;;
            rpcrt4.dll|secur32.dll|setupapi.dll|shell32.dll|ucrtbase.dll|user32.dll|userenv.dll|winmm.dll|ws2_32.dll|xinput1_4.dll) ;;
            *) fail "$file needs $library, which Windows does not have" ;;
        esac
    done
}
# Copies a program or library for Windows without its symbols: windows_binary FROM TO
windows_binary() {
    install -m 644 "$1" "$2"
    x86_64-w64-mingw32-strip --strip-unneeded "$2"
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
