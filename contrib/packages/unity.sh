#!/bin/sh
# Makes the Unity package org.palpate.touch-VERSION.tgz: the components of clients/csharp/unity with Palpate.cs, libpalpate for Linux
# and, if contrib/build-windows.sh has compiled it, for Windows, a sample scene and .meta files. No Unity opens it here; unity.py
# compares the layout with the documented one.
set -eu
. "$(dirname "$0")/common.sh"

need_engine_parts
folder=$work/package
cp -r clients/csharp/unity "$folder"
cp clients/csharp/Palpate.cs "$folder/Runtime/"
mkdir -p "$folder/Plugins/x86_64"
binary "$built/deps/libpalpate_c.so" "$folder/Plugins/x86_64/libpalpate.so"
systems=Linux
if [ -e "$windows/palpate_c.dll" ]; then
    windows_binary "$windows/palpate_c.dll" "$folder/Plugins/x86_64/palpate.dll"
    only_of_windows "$folder/Plugins/x86_64/palpate.dll"
    systems='Linux and Windows'
else
    say 'without the library for Windows: make build-windows'
fi
cp CHANGELOG.md "$folder/"
licences "$work"
cat LICENSE-MIT LICENSE-APACHE >"$folder/LICENSE.md"
if [ -f "$work/THIRD-PARTY.txt" ]; then cp "$work/THIRD-PARTY.txt" "$folder/"; fi
cat >"$folder/README.md" <<README
# Palpate $version for Unity, $systems on x86_64

1. Install this file by the Package Manager: "Add package from tarball".
2. Start a server: \`palpate serve\`.
3. Import the sample "Touch", open its scene \`Touch\`, and press Play. The left button presses, E enables forces.

\`PalpateTissue\` shows the surface of a session. \`PalpateTool\` moves a tool on its own thread at 1 kHz. Derive from
\`PalpateDevice\` to write a device that libpalpate calls. Nobody has opened this package in Unity yet.
README
"$python" $packages/unity.py complete "$folder" "$version"

# With stand-ins for the classes of Unity that it uses, the code compiles.
if command -v mcs >/dev/null; then
    mcs -target:library -langversion:7.2 -nowarn:0649 -out:"$work/palpate.dll" $packages/UnityEngine.cs \
        "$folder"/Runtime/*.cs "$folder"/Samples~/Touch/*.cs >&2
else
    say 'the code is not compiled: mcs is missing (apt-get install mono-mcs)'
fi
pack "$out/org.palpate.touch-$version.tgz" "$work" package
made "$out/org.palpate.touch-$version.tgz"
