#!/bin/sh
# Makes the npm package of clients/typescript from its built files, palpate-VERSION.tgz.
set -eu
. "$(dirname "$0")/common.sh"

need_tool "${NPM:-npm}" 'install Node.js'
need_tool "$python" 'apt-get install python3'
source=clients/typescript
need_file $source/dist/index.js 'npm ci in clients, npm run build in clients/typescript (make viewer does both)'
mkdir "$work/package"
cp -r $source/dist $source/README.md LICENSE-MIT LICENSE-APACHE "$work/package/"
# Only what a user of the package needs: nothing to run, and the version of Cargo.toml.
"$python" - "$version" $source/package.json >"$work/package/package.json" <<'PYTHON'
import json, sys
package = json.load(open(sys.argv[2], encoding="utf-8"))
package["version"] = sys.argv[1]
for key in ("scripts", "devDependencies"):
    package.pop(key, None)
package["files"] += ["LICENSE-*"]
print(json.dumps(package, indent=2))
PYTHON
(cd "$work/package" && "${NPM:-npm}" pack --silent --pack-destination "$work" >/dev/null)
mv "$work/palpate-$version.tgz" "$out/palpate-npm-$version.tgz"
made "$out/palpate-npm-$version.tgz"
