#!/usr/bin/env python3
"""Builds the guide as a site in target/site, from the Markdown pages of the repository (`make site`).

The pages are copied to target/site-src, in the folders of the repository, so that links between them stay as they are. Links to
other files become the paths of these files. MkDocs then builds the site, and fails on each warning: a link to a missing page or
heading, a missing picture, a page that mkdocs.yml does not list. At the end every address in the pages is checked, also those of
the theme: it exists, and nothing is loaded from another server.
"""

import html.parser
import logging
import os
import pathlib
import re
import shutil
import subprocess
import sys
import time
import urllib.parse

import api

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
STAGE, SITE = ROOT / "target/site-src", ROOT / "target/site"
RUSTDOC = ROOT / os.environ.get("CARGO_TARGET_DIR", "target") / "doc"
PICTURES = {".gif", ".jpg", ".png", ".svg"}
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s#]+)(?:#[^)\s]*)?\)")
BLOCK = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def stage_pages():
    """Copies all Markdown pages of the repository, and the pictures that they show."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    for name in listed:
        if (ROOT / name).is_file():
            write(name, staged((ROOT / name).read_text(encoding="utf-8"), (ROOT / name).parent))
    measurements = sorted((STAGE / "docs/benchmarks").glob("*.md"))
    items = [f"- [{page.read_text(encoding='utf-8').splitlines()[0].strip('# ')}]({page.name})\n" for page in measurements]
    write("docs/benchmarks/README.md", "# Measurements\n\n" + "".join(items))


def staged(text, folder):
    """Returns a page as MkDocs reads it. `folder` is where its links begin."""
    pages, end = "", 0
    for block in BLOCK.finditer(text):
        pages += prose(text[end : block.start()], folder)
        # What is after the language is for the tests.
        pages += re.sub(r"\A(```\w*) .*", r"\1", block[0])
        end = block.end()
    return pages + prose(text[end:], folder)


def prose(text, folder):
    # What belongs to an item of a list is indented by three spaces in our pages, and by four for MkDocs.
    text = re.sub(r"^   ", "    ", text, flags=re.MULTILINE)
    return LINK.sub(lambda link: staged_link(link, folder), text)


def staged_link(link, folder):
    """Returns a link of a page: to another page and to a picture as it is, to another file of the repository as its path."""
    text, address = link.groups()
    target = pathlib.Path(os.path.normpath(folder / address))
    # MkDocs reports what is missing.
    if re.match(r"\w+:", address) or not target.is_relative_to(ROOT) or not target.exists() or address.endswith(".md"):
        return link[0]
    path = target.relative_to(ROOT)
    if target.suffix in PICTURES:
        (STAGE / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(target, STAGE / path)
        return link[0]
    if target.is_dir() and any(target.glob("*.md")):
        return f"[{text}]({address}/README.md)"
    shown = text.strip("`")
    return f"`{path}`" if shown in (path.name, str(path)) else f"{text} (`{path}`)"


def stage_interfaces():
    """Writes the pages of the interfaces. Returns the crates with documentation."""
    crates = [page.parent.name for page in RUSTDOC.glob("palpate*/index.html")]
    write("api/python.md", api.python(ROOT / "clients/python/palpate"))
    write("api/c.md", api.c(ROOT / "clients/c/include/palpate.h"))
    write("api/rust.md", api.rust(crates))
    for file in ("iframe-worker.js", "site.css"):
        write(f"assets/{file}", (HERE / file).read_text(encoding="utf-8"))
    return crates


def write(name, text):
    (STAGE / name).parent.mkdir(parents=True, exist_ok=True)
    (STAGE / name).write_text(text, encoding="utf-8")


def expanded(nav):
    """Returns the navigation with the pages in place of each `*.md`."""
    if isinstance(nav, dict):
        return {title: expanded(entry) for title, entry in nav.items()}
    if isinstance(nav, str):
        return nav
    entries = []
    for entry in nav:
        if isinstance(entry, str) and "*" in entry:
            entries += sorted(str(page.relative_to(STAGE)) for page in STAGE.glob(entry) if page.name != "README.md")
        else:
            entries.append(expanded(entry))
    return entries


def build():
    from mkdocs.commands.build import build
    from mkdocs.config import load_config
    from mkdocs.exceptions import Abort

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    config = load_config(str(HERE / "mkdocs.yml"), strict=True)
    config.nav = expanded(config.nav)
    try:
        build(config)
    except Abort as error:
        sys.exit(f"the site was not built: {error}")


def copy_rustdoc(crates):
    """Copies the generated documentation of `crates`, without that of their dependencies."""
    others = {page.parent.name for page in RUSTDOC.glob("*/index.html")}.difference(crates)
    tops = {str(RUSTDOC), str(RUSTDOC / "src")}

    def ignored(folder, names):
        return others.intersection(names) if folder in tops else set()

    shutil.copytree(RUSTDOC, SITE / "api/rust", ignore=ignored)


class Addresses(html.parser.HTMLParser):
    """The addresses that a page names, those that a browser loads by itself, and the anchors in it."""

    def __init__(self, text):
        super().__init__()
        self.named, self.loaded, self.anchors = set(), set(), set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        self.named |= {values[key] for key in ("href", "src") if values.get(key)}
        if tag in ("img", "script", "iframe", "source") or tag == "link" and values.get("rel") != "canonical":
            self.loaded |= {values[key] for key in ("href", "src") if values.get(key)}


def problems(pages):
    """Yields what is wrong with the addresses of `pages`, by path."""
    for path, page in pages.items():
        for address in sorted(page.named):
            parts = urllib.parse.urlsplit(address)
            target = path if not parts.path else (path.parent / urllib.parse.unquote(parts.path)).resolve()
            if parts.scheme or parts.netloc:
                if address in page.loaded and parts.scheme != "data":
                    yield f"{path.relative_to(SITE)}: {address} is on another server"
            elif not target.is_file():
                yield f"{path.relative_to(SITE)}: {address} does not exist"
            elif parts.fragment and target in pages and urllib.parse.unquote(parts.fragment) not in pages[target].anchors:
                yield f"{path.relative_to(SITE)}: {address} has no such heading"


def main():
    began_s = time.monotonic()
    shutil.rmtree(STAGE, ignore_errors=True)
    stage_pages()
    crates = stage_interfaces()
    build()
    # It has addresses for the root of a server, which a site in a folder does not have.
    (SITE / "404.html").unlink()
    pages = {path: Addresses(path.read_text(encoding="utf-8")) for path in sorted(SITE.rglob("*.html"))}
    if crates:
        copy_rustdoc(crates)
    found = list(problems(pages))
    print(*found, sep="\n", end="\n" if found else "", file=sys.stderr)
    if found:
        sys.exit(f"problems of the site: {len(found)}")
    print(f"{len(pages)} pages in {time.monotonic() - began_s:.1f} s: {(SITE / 'index.html').relative_to(ROOT)}")


if __name__ == "__main__":
    main()
