"""Pages about the interfaces for Python, C and Rust, as Markdown."""

import ast
import itertools
import re


def code(language, text):
    return f"```{language}\n{text.strip()}\n```\n\n"


def python(folder):
    """Returns the page of the package in `folder`: what `__init__.pyi` defines, and what it takes from the files beside it."""
    page = "# Python\n\nThe package `palpate`; `help(palpate)` shows the same in Python."
    page += " [Your language](../docs/your-language.md) explains how to use it.\n\n"
    stub = (folder / "__init__.pyi").read_text(encoding="utf-8")
    page += code("python", "\n".join(ast.unparse(node) for node in ast.parse(stub).body if isinstance(node, ast.Assign)))
    for taken in ast.parse(stub).body:
        if isinstance(taken, ast.ImportFrom) and taken.level == 1 and taken.module:
            source = (folder / f"{taken.module}.py").read_text(encoding="utf-8")
            names = [alias.name for alias in taken.names if not (alias.asname or alias.name).startswith("_")]
            nodes = [node for node in ast.parse(source).body if getattr(node, "name", None) in names]
            page += definitions(nodes, source, "##")
    page += definitions(ast.parse(stub).body, stub, "##")
    aio = (folder / "aio.pyi").read_text(encoding="utf-8")
    return page + "## `palpate.aio`\n\nThe same with asyncio.\n\n" + code("python", aio)


def definitions(nodes, source, level, within=""):
    """Returns the classes and functions among `nodes`: a heading, what a caller writes, the documentation."""
    page = ""
    for name, same in itertools.groupby(nodes, lambda node: getattr(node, "name", "_")):
        # A function may be declared several times, for several types.
        same = list(same)
        if name.startswith("_") and name != "__init__":
            continue
        page += f"{level} `{within}{name}`\n\n"
        text = (ast.get_docstring(same[-1]) or "") + "\n\n"
        if isinstance(same[0], ast.ClassDef):
            fields = [ast.unparse(node) for node in same[0].body if isinstance(node, ast.AnnAssign)]
            page += text + (code("python", "\n".join(fields)) if fields else "")
            page += definitions(same[0].body, source, level + "#", f"{name}.")
        else:
            page += code("python", "\n".join(head(node, source) for node in same)) + text
    return page


def head(function, source):
    """Returns the lines of a function from its decorators to before its colon."""
    first = min([function.lineno, *(decorator.lineno for decorator in function.decorator_list)])
    lines = source.split("\n")[first - 1 : function.body[0].lineno]
    lines = [line[function.col_offset :] for line in lines]
    # The body of a declaration may be in the line of its colon.
    lines[-1] = lines[-1].removesuffix(" ...") if lines[-1].endswith(": ...") else ""
    return "\n".join(lines).strip().removesuffix(":")


SECTIONS = {"Functions": r".*\w\(", "Structures": r"typedef", "Constants": r"#define|typedef enum"}


def c(header):
    """Returns the page of a header that cbindgen has written: each declaration with the comment before it."""
    text = header.read_text(encoding="utf-8")
    rules = re.sub(r"^(/\*| \*) ?", "", text.split("*/")[0], flags=re.MULTILINE).replace(":\n- ", ":\n\n- ")
    sections = {title: "" for title in SECTIONS}
    for comment, declaration in re.findall(r"^/\*\*\n(.*?)^ \*/\n(.*?)\n\n", text, re.DOTALL | re.MULTILINE):
        name = re.search(r"\A#define (\w+)|\A.*\(\*(\w+)\)|\A.*?(\w+)\(|(\w+);\Z", declaration)
        about = re.sub(r"^ \* ?", "", comment, flags=re.MULTILINE)
        title = [title for title, start in SECTIONS.items() if re.match(start, declaration)][-1]
        sections[title] += f"### `{name[name.lastindex]}`\n\n{about}\n{code('c', declaration)}"
    page = f"# C\n\n{rules}\n\n[Your engine](../docs/your-engine.md) explains how to use the library.\n\n"
    return page + "".join(f"## {title}\n\n{entries}" for title, entries in sections.items())


def rust(crates):
    """Returns the page that leads to the documentation of `crates`, which is empty if it has not been generated."""
    page = "# Rust\n\n[Examples in Rust](../docs/examples.md) lists the items that users start from.\n\n"
    if not crates:
        return page + "This site was built without the documentation of the crates: `cargo doc --workspace --no-deps`.\n"
    # Not as links of Markdown: MkDocs would look for them among its pages.
    return page + "".join(f'- <a href="rust/{crate}/index.html"><code>{crate}</code></a>\n' for crate in sorted(crates))
