#!/bin/sh
# Runs the server as a service under Wine: `sh tests/windows/service.sh`, after `make build build-windows`.
#
# It installs the service, starts it, touches it with the client of this machine, stops it, starts it again and removes it. The service
# must end as after Ctrl-C: its journal is complete, its log has the server's last words, and the next start continues the session. A
# service that can't start must say why.
#
# BUILT is the folder of the programs for this machine [default: target/release], WINDOWS that of build-windows.sh [target/windows].
set -eu

cd "$(dirname "$0")/../.."
built=${BUILT:-target/release}
exe=${WINDOWS:-target/windows}/x86_64-pc-windows-gnu/release/palpate.exe
work=$(mktemp -d)
# A Windows of its own: its services end with it.
export WINEPREFIX="$work/wine"
windows() { sh tests/windows/wine.sh "$@"; }
say() { echo "service under Wine: $*" >&2; }
finish() {
    exec 9>&-
    windows wineboot --end-session --kill >/dev/null 2>&1 || true
    rm -rf "$work"
}
trap finish EXIT

mkdir -p "$WINEPREFIX" "$work/folder"
# Wine's Windows ends with its last program, and the next one starts it again, with the services that start by themselves. This
# program waits for its input until the end. It also creates that Windows: `wineboot --init` starts a second service control manager.
mkfifo "$work/input"
windows cmd <"$work/input" >/dev/null 2>&1 &
exec 9>"$work/input"
is_there() {
    for process in /proc/[0-9]*; do
        grep -qs '^[^/]*cmd\.exe' "$process/cmdline" && grep -qs "$WINEPREFIX" "$process/environ" && return
    done
    return 1
}
for _ in $(seq 300); do is_there && break; sleep 0.2; done
sleep 1
x86_64-w64-mingw32-gcc -O -shared tests/windows/bcryptprimitives.c -o "$work/bcryptprimitives.dll" -ladvapi32
cp "$work/bcryptprimitives.dll" "$WINEPREFIX/drive_c/windows/system32/"
cp "$exe" "$work/folder/palpate.exe"
cp -r scenes scripts "$work/folder/"
folder="Z:$(echo "$work/folder" | tr / '\134')"
state() { windows sc query "$1" 2>/dev/null | tr -d '\r' | sed -n 's/^ *STATE *: *\([0-9]*\).*/\1/p'; }
wait_for() { # state: 1 stopped, 4 running
    for _ in $(seq 150); do
        [ "$(state "$2")" = "$1" ] && return
        sleep 0.2
    done
    say "the service $2 is in state '$(state "$2")', not $1"
    cat "$work/folder"/*.log >&2 || true
    exit 1
}

palpate() { windows "$work/folder/palpate.exe" "$@"; }

# A free port.
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
url=http://127.0.0.1:$port
palpate service install --folder "$folder" -- --listen "127.0.0.1:$port" --no-datagrams --threads 1 --journal journals
if palpate service install --folder "$folder" 2>"$work/refused"; then say 'it was installed twice'; exit 1; fi
grep -q "can't install the service .palpate." "$work/refused"
windows sc start palpate >/dev/null
wait_for 4 palpate
"$built/palpate-client" replay press --server "$url" --scene liver --output "$work/service.jsonl" --quiet
grep -q '"final_hash"' "$work/service.jsonl"
"$built/palpate-client" bridge --server "$url" --seconds 3 --keep-session --json 2>/dev/null >"$work/bridge.json"
session=$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["session_id"])' "$work/bridge.json")
windows sc stop palpate >/dev/null
wait_for 1 palpate
if "$built/palpate-client" health "$url" 2>/dev/null; then say 'it serves on after its end'; exit 1; fi
grep -q 'palpate::server::serve: stopped' "$work/folder/palpate.log"
journal=$work/folder/journals/$session.1.mcap
"$built/palpate" journal show "$journal" | tail -1 | grep 'drained: the server ended' >&2
"$built/palpate" journal verify "$journal"
say "installed, started, touched, stopped; its log has $(wc -l <"$work/folder/palpate.log") lines"
tail -2 "$work/folder/palpate.log" >&2
windows sc start palpate >/dev/null
wait_for 4 palpate
"$built/palpate-client" bridge --server "$url" --session "$session" --seconds 2 --json 2>/dev/null >"$work/bridge.json"
say "started again: the session continues, with $(grep -o '"samples":[0-9]*' "$work/bridge.json")"
# While it runs: this stops it first.
palpate service remove
[ -z "$(state palpate)" ] || { say 'it is still there after its removal'; exit 1; }
"$built/palpate" journal show "$work/folder/journals/$session.2.mcap" | tail -1 | grep 'drained: the server ended' >&2
if palpate service remove 2>"$work/refused"; then say 'it was removed twice'; exit 1; fi
grep -q "can't remove the service .palpate." "$work/refused"
if palpate service run 2>"$work/refused"; then say 'it ran without the service control manager'; exit 1; fi
grep -q 'sc.exe start' "$work/refused"

# A wrong option is refused at once; what is only wrong at the start is in the log.
if palpate service install --name wrong --folder "$folder" -- --lissen x 2>"$work/refused"; then exit 1; fi
grep -q -- '--lissen' "$work/refused"
palpate service install --name wrong --folder "$folder" --log-file "$folder\\wrong.log" -- --config absent.toml
windows sc start wrong >/dev/null 2>&1 || true
wait_for 1 wrong
grep absent.toml "$work/folder/wrong.log" >&2
windows sc query wrong | tr -d '\r' | grep 'SERVICE_EXIT_CODE *: 2 ' >&2
palpate service remove --name wrong
say 'a service that can not start says why'
