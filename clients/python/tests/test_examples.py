"""The examples run as they are, and tell what is so."""

import ast
import inspect
import json
import os
import re
import subprocess
import sys
import unittest

import palpate
import palpate.aio
from common import EXAMPLES, ROOT, Served


def ran(example, *arguments):
    command = [sys.executable, EXAMPLES / example, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


class Examples(Served, unittest.TestCase):
    def test_touch_feels_the_tissue(self):
        for _ in range(10):
            # A busy machine may connect only when the device's time is over.
            told = json.loads(ran("touch.py", self.url, "liver", "2"))
            if told["force_max_n"] > 0:
                break
        self.assertGreater(told["ticks"], 0)
        self.assertGreater(told["force_max_n"], 0.0)

    def test_look_sees_what_another_touches(self):
        server = palpate.connect(self.url)
        with server.create_session("liver") as session:
            session_id = session.id
            watched = subprocess.Popen(
                [sys.executable, EXAMPLES / "look.py", self.url, session_id, "4"], stdout=subprocess.PIPE, text=True
            )
            while watched.poll() is None:
                session.touch(palpate.press(0.004, seconds=1.0))
            lines = watched.communicate(timeout=60)[0].splitlines()
        self.assertEqual(watched.returncode, 0)
        depths_mm = [float(re.search(r"s +([\d.-]+) mm deep", line).group(1)) for line in lines]
        self.assertGreater(len(depths_mm), 1)
        self.assertGreater(max(depths_mm), 0.0)
        self.assertIn("0.00 mm", ran("look.py", self.url, "paper", "1"))

    def test_a_whole_front_end_is_at_most_60_lines(self):
        text = (EXAMPLES / "front_end.py").read_text()
        self.assertLessEqual(len(text.splitlines()), 60)
        told = ran("front_end.py", self.url, "liver", "2")
        ticks, force_n = re.search(r"(\d+) ticks, \d+ late; at most ([\d.]+) N", told).groups()
        self.assertGreater(int(ticks), 0)
        self.assertLess(float(force_n), 3.3)
        self.assertRegex(told, r"\d mm +\d")

    def test_examples_without_arguments_print_their_usage(self):
        for example in ("look.py", "touch.py", "front_end.py"):
            for arguments in ([], [self.url], [self.url, "liver", "long"]):
                with self.subTest(example, arguments=arguments):
                    command = [sys.executable, EXAMPLES / example, *arguments]
                    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
                    self.assertEqual(done.returncode, 2, done.stderr)
                    self.assertIn(f"usage: {example} [-h] url scene seconds", done.stderr)

    def test_a_study_finds_how_depth_depends_on_springs(self):
        told = ran("study.py", "24")
        found = re.search(r"24 tissues .* mm \* k\^(-[\d.]+) \* K''\^(-[\d.]+)", told, re.DOTALL)
        self.assertTrue(0.05 < -float(found.group(1)) < 0.6 and 0.05 < -float(found.group(2)) < 1.0, told)

    def test_the_notebook_reproduces_two_figures_of_the_paper(self):
        os.environ["MPLBACKEND"] = "Agg"
        notebook = json.loads((EXAMPLES / "paper.ipynb").read_text())
        names = {}
        for number, cell in enumerate(notebook["cells"]):
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), f"paper.ipynb, cell {number}", "exec"), names)
        # What docs/paper.md says.
        page = (ROOT / "docs/paper.md").read_text()
        self.assertIn("176 mm deep for k = 1 N/m, 75 mm for 10, 55 mm for 30 and 41 mm for 100", " ".join(page.split()))
        self.assertEqual({k: round(mm) for k, mm in names["at_end_mm"].items()}, {1.0: 176, 10.0: 75, 30.0: 55, 100.0: 41})
        coarse, fine, right = (names["swing_mm"](curves, 40.0) for curves in names["panels"].values())
        self.assertEqual([round(mm) for mm in coarse], [32, 54])
        self.assertTrue(all(abs(a - b) < 0.1 for a, b in zip(fine, right)), (fine, right))
        quiet = names["swing_mm"](names["panels"]["the paper's scheme, steps of 10 ms"], 36.0)
        self.assertLess(quiet[1] - quiet[0], 2.0)


class Types(unittest.TestCase):
    """The types for type checkers match the package."""

    def names(self, stub):
        tree = ast.parse((ROOT / "clients/python/palpate" / stub).read_text())
        classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
        return classes, {node.name for node in tree.body if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))}

    def test_the_stubs_have_what_the_package_has(self):
        classes, functions = self.names("__init__.pyi")
        self.assertEqual(set(palpate.__all__) - set(classes) - functions - {"__version__", "aio", "press"}, {
            name for name in palpate.__all__ if inspect.isclass(getattr(palpate, name)) and getattr(palpate, name).__module__.startswith("palpate._")
        })
        for name, node in classes.items():
            told = {part.name for part in node.body if isinstance(part, ast.FunctionDef)}
            there = {part for part in vars(getattr(palpate, name)) if not part.startswith("_")}
            # The connection is made by palpate.connect.
            self.assertEqual({part for part in told if not part.startswith("_")}, there - {"connect"}, name)
        awaited, functions = self.names("aio.pyi")
        self.assertEqual(functions, {"connect"})
        for name, node in awaited.items():
            told = {part.name for part in node.body if isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef))}
            also = {part.name for part in classes[name].body if isinstance(part, ast.FunctionDef)}
            self.assertEqual({part for part in told if not part.startswith("_")}, {part for part in also if not part.startswith("_")}, name)

    def test_the_package_and_its_examples_pass_mypy(self):
        files = [str(EXAMPLES / name) for name in ("look.py", "touch.py", "study.py")]
        checked = subprocess.run(
            [sys.executable, "-m", "mypy", "--no-incremental", "--cache-dir=/dev/null", *files], capture_output=True, text=True, cwd="/"
        )
        self.assertEqual(checked.returncode, 0, checked.stdout + checked.stderr)


if __name__ == "__main__":
    unittest.main()
