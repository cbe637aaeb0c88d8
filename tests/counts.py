#!/usr/bin/env python3
"""Counts what the rules of the code forbid, and exits with 1 if it finds any of it.

    python3 tests/counts.py             every count, and the places beyond it
    python3 tests/counts.py types       one count alone

A type name means one thing: a public one is defined once in the workspace, a private one in at most two modules. Constants are
named MAX_…, MIN_… and …_TIMEOUT in every language. A cell of a table in ARCHITECTURE.md has at most 40 words. (Circles of imports
are counted by tests/architecture.rs.)

No line asks which kind of tissue it has, outside the places where a user names a kind: the text of scenes (`scene/mod.rs`,
`scene/sheet.rs`, `scene/mesh.rs` and their folders), the protocol's message of a scene (`wire/scene.rs`, and `proto/src/scene.rs`
for programs that do not read it), the page's uploads and its sheet (`coefficients.ts`, `sheet.ts`), and the folder `body` of the tissue. Elsewhere a line asks
`BodyKind`, the rest shape or `Places`. A line asks for a kind if it matches on one, unwraps the tables or the section of one,
reads its field in a message or its key in a refusal, compares the dimensions of a shape, or has a name such as `is_mesh`.
Tests and benches may ask.
"""

import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CODE = (".rs", ".ts", ".mjs", ".js", ".py", ".pyi", ".cs", ".hpp", ".cpp", ".h", ".c", ".proto")
TYPE = re.compile(r"^[ \t]*(pub(?:\([^)]*\))?[ \t]+)?(?:struct|enum|union|trait|type)[ \t]+([A-Z]\w*)", re.MULTILINE)
CONSTANT = re.compile(r"\b(?:PATIENCE(?:_\w+)?|MOST_\w+|LEAST_\w+|OFF_SHEET)\b")
MAX_WORDS = 40
GENERATED = "proto/generated/"
# What asks in each language, and where that is at home.
ASKS = {
    ".rs": re.compile(
        r"\bBody::(Sheet|Mesh)\b|\bElastic::(Sheet|Mesh)\b|\b(Places|TileGraph)::(Sheet|Surface)\b|\bWindow::(Grid|Ball)\b"
        r"|\.dimensions\(\)\s*[=!<>]|\.sheet(_mut)?\(\)|\bplaces\.surface\(\)|\bscene\.mesh\(\)|\bpb::(sheet::|mesh::|Sheet\b|Mesh\b)"
        r"|\b(scene|message|told|of_scene|even)\.(sheet|mesh)\b(?!\()|\"(sheet|mesh)\.(points|spacing_m|file|unit|vertices|fixed)\w*\""
        r"|\b(is|of|in|on)_(a_)?(sheet|mesh)(es|s)?\b"
    ),
    (".ts", ".mjs", ".js"): re.compile(r"\bscene[?!]?\.(sheet|mesh)\b|\bis(Sheet|Mesh)\b"),
    (".py", ".pyi"): re.compile(r"\bscene\.(sheet|mesh)\b|\bis_(sheet|mesh)\b"),
    (".h", ".c", ".hpp", ".cpp", ".cs"): re.compile(r"\bis_?(sheet|mesh)\b", re.IGNORECASE),
}
AT_HOME = ("crates/tissue/src/body/", "crates/tissue/src/scene/mod.rs", "crates/tissue/src/scene/sheet",
           "crates/tissue/src/scene/mesh", "crates/session/src/wire/scene.rs", "proto/src/scene.rs",
           "clients/viewer/src/coefficients.ts", "clients/viewer/src/sheet.ts")
OF_TESTS = re.compile(r"(^|/)(tests|benches|examples|fuzz)/|(^|/|_)tests\.rs$")


def files(endings):
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\n")
    here = Path(__file__).resolve()
    for name in listed:
        path = ROOT / name
        if name.endswith(endings) and path.is_file() and path != here and not name.startswith(GENERATED):
            yield name, path.read_text(encoding="utf-8")


def types():
    public, all_of = defaultdict(list), defaultdict(set)
    for name, text in files(".rs"):
        for match in TYPE.finditer(text):
            # `type` within a block is an associated type, or local to a function.
            if match[0].lstrip().startswith("type") and match[0][0] in " \t":
                continue
            all_of[match[2]].add(name)
            if (match[1] or "").strip() == "pub":
                public[match[2]].append(name)
    for kind, places in sorted(public.items()):
        if len(places) > 1:
            yield f"public type {kind} is defined {len(places)} times: {', '.join(places)}"
    for kind, places in sorted(all_of.items()):
        if len(places) > 2 and len(public[kind]) < 2:
            yield f"type {kind} is defined in {len(places)} modules: {', '.join(sorted(places))}"


def constants():
    for name, text in files(CODE):
        for number, line in enumerate(text.split("\n"), 1):
            for match in CONSTANT.finditer(line):
                yield f"{name}:{number}: {match[0]}"


def cells():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    for number, line in enumerate(text.split("\n"), 1):
        if line.startswith("|"):
            for cell in line.strip("|").split("|"):
                if len(cell.split()) > MAX_WORDS:
                    yield f"ARCHITECTURE.md:{number}: {len(cell.split())} words: {cell.strip()[:60]}…"


def kinds():
    for endings, asks in ASKS.items():
        for name, text in files(endings):
            if name.startswith(AT_HOME) or OF_TESTS.search(name):
                continue
            own = re.split(r"^#\[cfg\(test\)\]", text, maxsplit=1, flags=re.MULTILINE)[0]
            for number, line in enumerate(own.split("\n"), 1):
                if asks.search(line) and not line.lstrip().startswith(("//", "#", "*", "/*")):
                    yield f"{name}:{number}: {line.strip()}"


COUNTS = {"types": types, "constants": constants, "cells": cells, "kinds": kinds}


def main():
    unknown = [name for name in sys.argv[1:] if name not in COUNTS]
    if unknown:
        sys.exit(f"unknown count {unknown[0]!r}: there are {', '.join(COUNTS)}")
    found = False
    for name in sys.argv[1:] or COUNTS:
        places = list(COUNTS[name]())
        print(f"{name}: {len(places)}")
        print(*(f"  {place}" for place in places), sep="\n", end="\n" if places else "")
        found |= bool(places)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
