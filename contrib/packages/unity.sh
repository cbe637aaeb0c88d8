#!/bin/sh
# Makes the Unity package org.palpate.touch-VERSION.tgz: the components of clients/csharp/unity with Palpate.cs, libpalpate, a sample
# and .meta files. No Unity opens it here; unity.py compares the layout with the documented one.
set -eu
. "$(dirname "$0")/common.sh"

need_engine_parts
folder=$work/package
cp -r clients/csharp/unity "$folder"
cp clients/csharp/Palpate.cs "$folder/Runtime/"
mkdir -p "$folder/Plugins/x86_64"
binary "$built/deps/libpalpate_c.so" "$folder/Plugins/x86_64/libpalpate.so"
cp CHANGELOG.md "$folder/"
licences "$work"
cat LICENSE-MIT LICENSE-APACHE >"$folder/LICENSE.md"
if [ -f "$work/THIRD-PARTY.txt" ]; then cp "$work/THIRD-PARTY.txt" "$folder/"; fi
cat >"$folder/README.md" <<README
# Palpate $version for Unity, Linux on x86_64

1. Install this file by the Package Manager: "Add package from tarball".
2. Start a server: \`palpate serve\`.
3. Import the sample "Touch", put its component \`Touch Sample\` on an empty object of a scene with a camera, and press Play.

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
