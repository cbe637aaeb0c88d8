#!/bin/sh
# Runs a program for Windows under Wine: `wine.sh PROGRAM.exe ARGUMENT…`. WINEPREFIX is the folder of the
# Windows that it sees.
export WINEDEBUG=-all WINEPREFIX="${WINEPREFIX:?}"
wine=$(command -v wine64 || echo /usr/lib/wine/wine64)
exec "$wine" "$@"
