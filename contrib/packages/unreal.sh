#!/bin/sh
# Makes the Unreal plugin palpate-unreal-VERSION.tar.gz: the component of clients/cpp/unreal as a module, with libpalpate. Unpack it
# into the folder Plugins of a project. No Unreal opens it here; unreal.py compares its parts with each other.
set -eu
. "$(dirname "$0")/common.sh"

need_engine_parts
folder=$work/Palpate
module=$folder/Source/Palpate
library=$folder/Source/ThirdParty/Palpate
source=clients/cpp/unreal
mkdir -p "$module/Public" "$module/Private" "$library/include" "$library/lib/Linux"
sed "s/VERSION/$version/" $source/plugin/Palpate.uplugin >"$folder/Palpate.uplugin"
cp $source/plugin/Palpate.Build.cs "$module/"
cp $source/plugin/PalpateModule.cpp $source/PalpateTissueComponent.cpp "$module/Private/"
# Other modules may use the class of this one.
sed 's/^class UPalpate/class PALPATE_API UPalpate/' $source/PalpateTissueComponent.h >"$module/Public/PalpateTissueComponent.h"
cp clients/c/include/palpate.h clients/cpp/include/palpate.hpp "$library/include/"
binary "$built/deps/libpalpate_c.so" "$library/lib/Linux/libpalpate.so.0"
licences "$folder"
"$python" $packages/unreal.py "$folder" "$version"
pack "$out/palpate-unreal-$version.tar.gz" "$work" Palpate
made "$out/palpate-unreal-$version.tar.gz"
