"""Checks the folder of an Unreal plugin: unreal.py FOLDER VERSION. Exit status 1 if its parts do not fit together."""

import json
import re
import sys
from pathlib import Path


def check(folder, version):
    """Yields what is wrong."""
    (plugin,) = folder.glob("*.uplugin")
    description = json.loads(plugin.read_text())
    if plugin.stem != folder.name:
        yield f"{plugin.name} must have the name of its folder, {folder.name}"
    if description["FileVersion"] != 3 or description["VersionName"] != version:
        yield f"{plugin.name}: its FileVersion is not 3, or its VersionName not {version}"
    for module in description["Modules"]:
        name = module["Name"]
        source = folder / "Source" / name
        build = source / f"{name}.Build.cs"
        if not build.is_file():
            yield f"{build.relative_to(folder)} is missing"
            continue
        rules = build.read_text()
        if not re.search(rf"class {name} : ModuleRules", rules):
            yield f"{build.name} has no class {name}"
        code = "".join(path.read_text() for path in sorted(source.rglob("*.cpp")))
        if code.count(f", {name})") != 1 or "IMPLEMENT_MODULE" not in code:
            yield f"the module {name} must have one IMPLEMENT_MODULE"
        headers = [path for path in source.rglob("*.h") if "UCLASS" in path.read_text()]
        for header in headers:
            text = header.read_text()
            if f'#include "{header.stem}.generated.h"' != re.findall(r"^#include .*$", text, re.MULTILINE)[-1]:
                yield f"{header.name}: the generated header must be the last one that it includes"
            if header.parent.name == "Public" and f"class {name.upper()}_API " not in text:
                yield f"{header.name}: other modules can't link its class"
        for words in re.findall(r"Path\.Combine\(library, (.*?)\)", rules):
            path = folder.joinpath("Source", "ThirdParty", "Palpate", *re.findall(r'"(.*?)"', words))
            if not path.exists():
                yield f"{build.name} names {path.relative_to(folder)}, which is missing"


def main():
    wrong = list(check(Path(sys.argv[1]), sys.argv[2]))
    if wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
