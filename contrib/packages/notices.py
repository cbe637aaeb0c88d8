#!/usr/bin/env python3
"""Prints the licences of the crates that are compiled into Palpate, and of the npm packages in its page.

The texts come from the sources that cargo and npm have fetched; nothing is downloaded. Exit status 1 if they are not there.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = {"palpate", "palpate-programs", "palpate-c", "palpate-python"}
NAMES = ("LICEN", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE")


def crates():
    """Yields (name, version, licence, folder) of each crate that a program or library contains."""
    cargo = os.environ.get("CARGO", "cargo")
    command = [cargo, "metadata", "--offline", "--locked", "--format-version", "1"]
    metadata = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    waiting = [id for id, package in packages.items() if package["name"] in PROGRAMS and package["source"] is None]
    seen = set()
    while waiting:
        id = waiting.pop()
        if id not in seen:
            seen.add(id)
            # `kind` is null for what is linked; the others are for building and testing.
            waiting += [dep["pkg"] for dep in nodes[id]["deps"] if any(kind["kind"] is None for kind in dep["dep_kinds"])]
    for id in seen:
        package = packages[id]
        if package["source"]:
            yield package["name"], package["version"], package["license"], Path(package["manifest_path"]).parent


def modules():
    """Yields the same of each npm package that the page or the package for TypeScript contains."""
    lock = json.loads((ROOT / "clients" / "package-lock.json").read_text())["packages"]
    page = json.loads((ROOT / "clients" / "viewer" / "package.json").read_text())
    for path, package in lock.items():
        name = path.rpartition("node_modules/")[2]
        if path.startswith("node_modules/") and (not package.get("dev") or name in page.get("dependencies", {})):
            if not package.get("link") and (ROOT / "clients" / path).is_dir():
                yield name, package["version"], package.get("license"), ROOT / "clients" / path


def main():
    try:
        parts = sorted({*crates(), *modules()}, key=lambda part: (part[0].lower(), part[1]))
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"notices.py: cargo can't list the crates without the network ({error}): run cargo fetch --locked")
    users = {}
    print("Palpate contains the libraries of this list. Their licences follow.\n")
    for name, version, licence, folder in parts:
        print(f"{name} {version}: {licence}")
        for file in sorted(folder.iterdir()):
            if file.is_file() and file.name.upper().startswith(NAMES):
                users.setdefault(file.read_text(errors="replace").strip(), []).append(f"{name} {version}")
    for text, names in users.items():
        print(f"\n{'-' * 80}\n{', '.join(names)}\n{'-' * 80}\n\n{text}")


if __name__ == "__main__":
    main()
