"""Packs a wheel: wheel.py VERSION PLATFORM MODULE LICENCES OUT. Prints its path."""

import base64
import hashlib
import os
import sys
import time
import tomllib
import zipfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "clients" / "python"


def metadata(project, version, licences):
    """Returns the text of METADATA (core metadata 2.1) from the table [project] of pyproject.toml."""
    lines = [
        "Metadata-Version: 2.1",
        f"Name: {project['name']}",
        f"Version: {version}",
        f"Summary: {project['description']}",
        f"License: {project['license']['text']}",
        *(f"License-File: {name}" for name in licences),
        f"Requires-Python: {project['requires-python']}",
        *(f"Requires-Dist: {name}" for name in project["dependencies"]),
        *(f"Classifier: {name}" for name in project["classifiers"]),
        "Description-Content-Type: text/markdown",
    ]
    return "\n".join(lines) + "\n\n" + (PACKAGE / project["readme"]).read_text()


def main():
    version, platform, module, licences, out = sys.argv[1:]
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    name, tag = project["name"], f"cp39-abi3-{platform}"
    info = f"{name}-{version}.dist-info"
    texts = {file.name: file.read_bytes() for file in sorted(Path(licences).iterdir())}
    files = {f"{name}/{file.name}": file.read_bytes() for file in sorted((PACKAGE / name).iterdir()) if file.is_file()}
    files[f"{name}/{Path(module).name}"] = Path(module).read_bytes()
    files |= {f"{info}/licenses/{file}": text for file, text in texts.items()}
    files[f"{info}/METADATA"] = metadata(project, version, texts).encode()
    files[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: palpate\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    )
    record = ""
    for path, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        record += f"{path},sha256={digest},{len(content)}\n"
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()

    wheel = Path(out) / f"{name}-{version}-{tag}.whl"
    # A zip file has no times before 1980.
    when = time.gmtime(max(int(os.environ.get("SOURCE_DATE_EPOCH", 0)), 315532800))[:6]
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, content in files.items():
            entry = zipfile.ZipInfo(path, when)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o100755 if path.endswith((".so", ".pyd")) else 0o100644) << 16
            archive.writestr(entry, content, compresslevel=9)
    print(wheel)


if __name__ == "__main__":
    main()
