#!/usr/bin/env python3
"""Prints the list of parts (SBOM, CycloneDX 1.5): what Cargo.lock and clients/package-lock.json name. `sbom.py VERSION`.

It has every crate and npm package of the locks, also those that only build or test. npm marks these (`scope` is "excluded"),
Cargo.lock does not.
"""

import base64
import json
import os
import re
import sys
import uuid
from datetime import datetime, timezone
from pathlib import Path
from urllib.parse import quote

ROOT = Path(__file__).resolve().parents[2]
FIELD = re.compile(r'^(name|version|source|checksum) = "(.*)"$', re.MULTILINE)


def crates():
    """Yields the components of Cargo.lock, and for each the names of those that it depends on."""
    for block in (ROOT / "Cargo.lock").read_text().split("[[package]]\n")[1:]:
        fields = dict(FIELD.findall(block))
        reference = f"pkg:cargo/{fields['name']}@{fields['version']}"
        part = {"type": "library", "bom-ref": reference, "name": fields["name"], "version": fields["version"], "purl": reference}
        if "checksum" in fields:
            part["hashes"] = [{"alg": "SHA-256", "content": fields["checksum"]}]
        listed = re.search(r"dependencies = \[(.*?)\]", block, re.DOTALL)
        yield part, re.findall(r'"(.*?)"', listed[1]) if listed else []


def modules():
    """Yields the components of package-lock.json."""
    lock = json.loads((ROOT / "clients" / "package-lock.json").read_text())
    for path, package in lock["packages"].items():
        name = path.rpartition("node_modules/")[2]
        if "node_modules/" not in path or package.get("link"):
            continue
        purl = f"pkg:npm/{quote(name)}@{package['version']}"
        part = {"type": "library", "bom-ref": f"{purl}#{path}", "name": name, "version": package["version"], "purl": purl}
        part["scope"] = "excluded" if package.get("dev") else "required"
        if "license" in package:
            part["licenses"] = [{"expression": package["license"]}]
        if package.get("integrity", "").startswith("sha512-"):
            content = base64.b64decode(package["integrity"].removeprefix("sha512-")).hex()
            part["hashes"] = [{"alg": "SHA-512", "content": content}]
        yield part


def main():
    (version,) = sys.argv[1:]
    found = list(crates())
    # A dependency is named with its version only if the name alone is not unique.
    by_name = {part["name"]: part["bom-ref"] for part, _ in found}
    by_name |= {f"{part['name']} {part['version']}": part["bom-ref"] for part, _ in found}
    graph = [{"ref": part["bom-ref"], "dependsOn": sorted({by_name[name] for name in names})} for part, names in found]
    components = [part for part, _ in found] + list(modules())
    when = datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", 0)), timezone.utc)
    document = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(components))}",
        "version": 1,
        "metadata": {
            "timestamp": when.isoformat().replace("+00:00", "Z"),
            "component": {
                "type": "application", "bom-ref": "palpate", "name": "palpate", "version": version,
                "licenses": [{"expression": "MIT OR Apache-2.0"}],
            },
        },
        "components": components,
        "dependencies": graph,
    }
    json.dump(document, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
