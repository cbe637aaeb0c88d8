#!/bin/sh
# Makes the Helm chart of contrib/helm/palpate, palpate-chart-VERSION.tgz. Checks it with helm, or else with helm.py.
set -eu
. "$(dirname "$0")/common.sh"

cp -r contrib/helm/palpate "$work/palpate"
sed -i "s/^\(version\|appVersion\): .*/\1: $version/" "$work/palpate/Chart.yaml"
cp LICENSE-MIT LICENSE-APACHE "$work/palpate/"
if command -v helm >/dev/null; then
    helm lint --strict "$work/palpate" >&2
    helm template palpate "$work/palpate" --namespace palpate >/dev/null
elif "$python" -c 'import yaml' 2>/dev/null; then
    "$python" $packages/helm.py >/dev/null
    say 'rendered by helm.py; not checked by helm, which is not installed'
else
    say 'not checked: neither helm nor PyYAML is installed'
fi
pack "$out/palpate-chart-$version.tgz" "$work" palpate
made "$out/palpate-chart-$version.tgz"
