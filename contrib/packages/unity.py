"""Completes and checks the folder of a Unity package.

    unity.py complete FOLDER VERSION     writes package.json and a .meta file for every asset
    unity.py check FOLDER                exit status 1 if the layout is not the one that Unity documents

A GUID is a hash of the package's name and the asset's path, so every build and every machine gives the same one, and scenes of
users keep their references.
"""

import hashlib
import json
import re
import sys
from pathlib import Path

TAIL = "  userData: \n  assetBundleName: \n  assetBundleVariant: \n"
SIMPLE = "  externalObjects: {}\n" + TAIL


def native(system, player):
    """Returns the importer of a library for x86_64 that the editor on one system, and players for it, load."""
    return (
        "PluginImporter:\n  externalObjects: {}\n  serializedVersion: 2\n  iconMap: {}\n  executionOrder: {}\n"
        "  defineConstraints: []\n  isPreloaded: 0\n  isOverridable: 0\n  isExplicitlyReferenced: 0\n  validateReferences: 1\n"
        "  platformData:\n"
        "  - first:\n      Any: \n    second:\n      enabled: 0\n      settings: {}\n"
        "  - first:\n      Editor: Editor\n    second:\n      enabled: 1\n      settings:\n        CPU: x86_64\n"
        f"        DefaultValueInitialized: true\n        OS: {system}\n"
        f"  - first:\n      Standalone: {player}\n    second:\n      enabled: 1\n      settings:\n        CPU: x86_64\n" + TAIL
    )


IMPORTERS = {
    ".cs": "MonoImporter:\n  externalObjects: {}\n  serializedVersion: 2\n  defaultReferences: []\n  executionOrder: 0\n"
    "  icon: {instanceID: 0}\n" + TAIL,
    ".asmdef": "AssemblyDefinitionImporter:\n" + SIMPLE,
    ".md": "TextScriptImporter:\n" + SIMPLE,
    ".txt": "TextScriptImporter:\n" + SIMPLE,
    "package.json": "PackageManifestImporter:\n" + SIMPLE,
    ".unity": "DefaultImporter:\n" + SIMPLE,
    ".so": native("Linux", "Linux64"),
    ".dll": native("Windows", "Win64"),
}
SYSTEMS = {".so": "Linux", ".dll": "Windows"}
# Unity's own assets, such as the usual material.
OWN_GUIDS = {"0" * 16 + "f" + "0" * 15, "0" * 16 + "e" + "0" * 15}
SAMPLE = {
    "displayName": "Touch",
    "description": "A scene with a tissue and a tool that you move; needs a server at http://127.0.0.1:7117.",
    "path": "Samples~/Touch",
}


def assets(folder):
    """Yields every file and folder that Unity imports. Names that end with ~ are hidden; a sample is copied from there with its
    .meta files."""
    for path in sorted(folder.rglob("*")):
        if path.suffix != ".meta" and not path.name.endswith("~") and not path.name.startswith("."):
            yield path


def meta_of(path):
    return path.with_name(path.name + ".meta")


def complete(folder, version):
    manifest = json.loads((folder / "package.json").read_text())
    manifest["version"] = version
    systems = " and ".join(name for suffix, name in SYSTEMS.items() if list(folder.rglob(f"*{suffix}")))
    manifest["description"] = f"Soft tissue of a Palpate server as a Mesh, and a tool that touches it. {systems}, x86_64."
    manifest["license"] = "MIT OR Apache-2.0"
    manifest["samples"] = [SAMPLE]
    (folder / "package.json").write_text(json.dumps(manifest, indent=2) + "\n")

    def guid_of(path):
        return hashlib.md5(f"{manifest['name']}/{path.relative_to(folder).as_posix()}".encode()).hexdigest()

    for scene in folder.rglob("*.unity"):
        # A scene names a script by its file.
        text = re.sub(r"guid: (\w+\.cs)\b", lambda found: f"guid: {guid_of(scene.with_name(found[1]))}", scene.read_text())
        scene.write_text(text)
    for path in assets(folder):
        guid = guid_of(path)
        if path.is_dir():
            importer = "folderAsset: yes\nDefaultImporter:\n" + SIMPLE
        else:
            importer = IMPORTERS.get(path.name) or IMPORTERS.get(path.suffix) or "DefaultImporter:\n" + SIMPLE
        meta_of(path).write_text(f"fileFormatVersion: 2\nguid: {guid}\n{importer}")


def check(folder):
    """Yields what is wrong."""
    manifest = json.loads((folder / "package.json").read_text())
    if not re.fullmatch(r"[a-z0-9_-]+(\.[a-z0-9_-]+){2,}", manifest["name"]):
        yield f"package.json: {manifest['name']} is no reversed domain name in lower case"
    if not re.fullmatch(r"\d+\.\d+\.\d+(-[\w.]+)?", manifest["version"]):
        yield f"package.json: {manifest['version']} is no semantic version"
    if not re.fullmatch(r"\d{4}\.\d", manifest["unity"]):
        yield f"package.json: {manifest['unity']} is no version of Unity"
    for sample in manifest["samples"]:
        if not sample["path"].startswith("Samples~/") or not (folder / sample["path"]).is_dir():
            yield f"package.json: the sample {sample['path']} is no folder below Samples~"
    for name in ("README.md", "LICENSE.md", "CHANGELOG.md", "Runtime"):
        if not (folder / name).exists():
            yield f"{name} is missing"
    guids, assemblies = {}, {}
    for path in assets(folder):
        name = path.relative_to(folder)
        if not meta_of(path).is_file():
            yield f"{name} has no .meta file"
            continue
        (guid,) = re.findall(r"^guid: ([0-9a-f]{32})$", meta_of(path).read_text(), re.MULTILINE) or [None]
        if guid is None or guid in guids:
            yield f"{name}: its GUID is missing, or that of {guids.get(guid)}"
        guids[guid] = name
        if path.suffix == ".asmdef":
            assemblies[json.loads(path.read_text())["name"]] = path
        if path.suffix == ".cs":
            classes = re.findall(r"class (\w+)(?: : (\w+))?", path.read_text())
            if any(base in ("MonoBehaviour", "PalpateDevice") and kind != path.stem for kind, base in classes):
                yield f"{name}: a component must have the name of its file"
            if not any((above / f"{kind}.asmdef").is_file() for above in path.parents for kind in assemblies):
                yield f"{name} is in no assembly"
    for path in folder.rglob("*.meta"):
        if not path.with_suffix("").exists():
            yield f"{path.relative_to(folder)} is the .meta file of nothing"
    for scene in folder.rglob("*.unity"):
        yield from check_scene(scene, set(guids) | OWN_GUIDS, folder)
    for name, path in assemblies.items():
        for reference in json.loads(path.read_text()).get("references", []):
            if reference not in assemblies:
                yield f"{path.relative_to(folder)} refers to {reference}, which is no assembly of this package"
        if path.stem != name:
            yield f"{path.relative_to(folder)} defines the assembly {name}"


def check_scene(scene, guids, folder):
    """Yields the references of a scene that lead nowhere."""
    text, name = scene.read_text(), scene.relative_to(folder)
    objects = re.findall(r"^--- !u!\d+ &(\d+)$", text, re.MULTILINE)
    if len(objects) != len(set(objects)):
        yield f"{name} has two objects of one number"
    for number, guid in re.findall(r"\{fileID: (\d+)(?:, guid: ([^,}]+), type: \d)?\}", text):
        if guid and guid not in guids:
            yield f"{name} refers to the asset {guid}, which is not there"
        if not guid and number != "0" and number not in objects:
            yield f"{name} refers to its object {number}, which is not there"
    if "MainCamera" not in text:
        yield f"{name} has no main camera"


def main():
    command, folder, *rest = sys.argv[1:]
    if command == "complete":
        complete(Path(folder), *rest)
    wrong = list(check(Path(folder)))
    if wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
