#!/bin/sh
# Makes every package in target/packages, the list of parts palpate-VERSION.cdx.json (CycloneDX) and SHA256SUMS. Environment: common.sh.
# Exit status 3 if one could not be made; the last line names it.
set -eu
. "$(dirname "$0")/common.sh"

# Those of another version, too, would be in SHA256SUMS.
for ending in deb whl crate tgz tar.gz tar zip cdx.json; do rm -f "$out"/*palpate*."$ending"; done
rm -f "$out/SHA256SUMS"
missing=''
for package in deb wheel npm crates library image helm unity unreal; do
    status=0
    BUILT=$built OUT=$out sh $packages/$package.sh || status=$?
    case $status in
        0) ;;
        3) missing="$missing $package" ;;
        *) fail "$package failed" ;;
    esac
done
"$python" $packages/sbom.py "$version" >"$work/sbom"
mv "$work/sbom" "$out/palpate-$version.cdx.json"
made "$out/palpate-$version.cdx.json"
(cd "$out" && sha256sum -- *palpate* >SHA256SUMS)
if [ -n "$missing" ]; then skip "$missing"; fi
