#!/usr/bin/env python3
"""Renders the chart contrib/helm/palpate where helm is not installed: the part of the language of templates that it uses.

    helm.py [KEY=VALUE …]     prints the manifests; a key is that of values.yaml, such as image.tag=0.2.0, a value is YAML

The release is called palpate, in the namespace palpate. A template that uses another part of the language is an error.
"""

import json
import re
import sys
from pathlib import Path

import yaml

CHART = Path(__file__).resolve().parents[1] / "helm" / "palpate"
ACTION = re.compile(r"(\s*)\{\{(-?)\s*(.*?)\s*(-?)\}\}(\s*)", re.DOTALL)
WORD = re.compile(r'"(?:[^"\\]|\\.)*"|\([^()]*\)|[^\s()|]+|\|')


def value(word, root):
    """Returns the value of a text, a path from the root, or a call in parentheses."""
    if word.startswith("("):
        return pipeline(word[1:-1], root)
    if not word.startswith("."):
        return yaml.safe_load(word)
    at = root
    for key in word[1:].split("."):
        at = at[key]
    return at


FUNCTIONS = {
    "default": lambda other, given: given or other,
    "join": lambda between, parts: between.join(map(str, parts)),
    "nindent": lambda width, text: "".join(f"\n{' ' * width}{line}" for line in text.split("\n")),
    "not": lambda given: not given,
    "printf": lambda pattern, *rest: pattern % rest,
    "quote": lambda given: json.dumps(str(given)),
    "toYaml": lambda given: yaml.safe_dump(given, sort_keys=True).strip(),
}


def pipeline(text, root):
    result = []
    for part in " ".join(WORD.findall(text)).split(" | "):
        words = WORD.findall(part)
        if len(words) == 1 and not result and words[0][0] in '."(':
            result = [value(words[0], root)]
        else:
            result = [FUNCTIONS[words[0]](*(value(word, root) for word in words[1:]), *result)]
    return result[0]


def render(text, root):
    """Returns the text with its actions carried out: values, and `if`, `else` and `end`."""
    out, shown, at = [], [True], 0
    for match in ACTION.finditer(text):
        before, trim, action, trim_after, after = match.groups()
        if shown[-1]:
            out.append(text[at : match.start()] + ("" if trim else before))
        words = action.split(None, 1)
        if words[0] == "if":
            shown.append(shown[-1] and bool(pipeline(words[1], root)))
        elif action == "else":
            shown[-1] = shown[-2] and not shown[-1]
        elif action == "end":
            shown.pop()
        elif shown[-1]:
            result = pipeline(action, root)
            out.append(str(result).lower() if isinstance(result, bool) else str(result))
        at = match.end() - (0 if trim_after else len(after))
    if len(shown) != 1:
        raise ValueError("an `if` has no `end`")
    return "".join(out) + text[at:]


def manifests(**changes):
    """Returns the documents of all templates, and the notes. `changes` maps keys such as `image.tag` to values."""
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    for key, given in changes.items():
        *path, last = key.split(".")
        at = values
        for name in path:
            at = at[name]
        if last not in at:
            raise KeyError(f"values.yaml has no {key}")
        at[last] = given
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    root = {
        "Values": values,
        "Release": {"Name": "palpate", "Namespace": "palpate"},
        "Chart": {"AppVersion": chart["appVersion"], "Version": chart["version"]},
    }
    templates = CHART / "templates"
    texts = [render(path.read_text(), root) for path in sorted(templates.glob("*.yaml"))]
    documents = [document for text in texts for document in yaml.safe_load_all(text) if document]
    return documents, render((templates / "NOTES.txt").read_text(), root)


def main():
    changes = dict(argument.split("=", 1) for argument in sys.argv[1:])
    documents, _ = manifests(**{key: yaml.safe_load(text) for key, text in changes.items()})
    yaml.safe_dump_all(documents, sys.stdout, sort_keys=False)


if __name__ == "__main__":
    main()
