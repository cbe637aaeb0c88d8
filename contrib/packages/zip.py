"""Packs a folder for Windows: zip.py PARENT FOLDER FILE.zip. The same files give the same bytes."""

import os
import sys
import time
import zipfile
from pathlib import Path


def main():
    parent, folder, file = sys.argv[1:]
    # A zip file has no times before 1980.
    when = time.gmtime(max(int(os.environ.get("SOURCE_DATE_EPOCH", 0)), 315532800))[:6]
    with zipfile.ZipFile(file, "w") as archive:
        for path in sorted(path for path in Path(parent, folder).rglob("*") if path.is_file()):
            entry = zipfile.ZipInfo(path.relative_to(parent).as_posix(), when)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, path.read_bytes(), compresslevel=9)


if __name__ == "__main__":
    main()
