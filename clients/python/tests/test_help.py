"""The texts that `help` shows."""

import ast
import inspect
import types
import unittest

import palpate
import palpate.aio
from common import ROOT

NATIVE = (types.MethodDescriptorType, types.BuiltinFunctionType, types.GetSetDescriptorType, staticmethod)


def words(text):
    return " ".join(text.split())


def told():
    """Returns name and object of every public class, function, method and property of the package."""
    for module in (palpate, palpate.aio):
        for name in module.__all__:
            there = getattr(module, name)
            if inspect.ismodule(there) or isinstance(there, str):
                continue
            yield name, there
            if inspect.isclass(there):
                for part, member in vars(there).items():
                    if not part.startswith("_") and (callable(member) or isinstance(member, (property, *NATIVE))):
                        yield f"{name}.{part}", member


class Help(unittest.TestCase):
    def test_everything_public_has_a_docstring(self):
        all_told = dict(told())
        self.assertIn("Tissue.rest_m", all_told)
        self.assertIn("Session.restore", all_told)
        for name, there in all_told.items():
            with self.subTest(name):
                self.assertTrue((getattr(there, "__func__", there).__doc__ or "").strip())

    def test_the_stubs_say_the_same(self):
        tree = ast.parse((ROOT / "clients/python/palpate/__init__.pyi").read_text())
        compared = 0
        for node in tree.body:
            if not isinstance(node, (ast.ClassDef, ast.FunctionDef)):
                continue
            there = getattr(palpate, node.name)
            # What is in Python has its own words in its own file.
            if inspect.isfunction(there):
                continue
            parts = [(node, there)]
            if isinstance(node, ast.ClassDef):
                methods = [part for part in node.body if isinstance(part, ast.FunctionDef)]
                parts += [(part, vars(there)[part.name]) for part in methods if not part.name.startswith("_")]
            for part, member in parts:
                said = ast.get_docstring(part)
                # Of a function with several signatures, one has the words.
                if said is None and any("overload" in ast.unparse(by) for by in getattr(part, "decorator_list", [])):
                    continue
                with self.subTest(f"{node.name}: {part.name}"):
                    self.assertIsNotNone(said)
                    # A static method has the words in the function within.
                    there_said = getattr(member, "__func__", member).__doc__
                    self.assertEqual(words(said), words(there_said))
                    compared += 1
        self.assertGreater(compared, 90)

    def test_functions_show_their_arguments(self):
        for there, arguments in [
            (palpate.run, "(scene, script, *, held=False, audit=False)"),
            (palpate.Session.step, "(self, /, steps=1)"),
            (
                palpate.Tip,
                "(radius_m=0.005, *, friction=0.2, grasps=False, stiffness_n_per_m=None, damping_n_s_per_m=0.0, "
                "shape='disc', edge_m=None, burn_s=0.0)",
            ),
            (
                palpate.Session.thread,
                "(self, /, tool, number, bites_m, length_m, *, radius_m=0.001, friction=0.0, strength_n=None)",
            ),
            (palpate.Session.clip, "(self, /, tool, number, bites_m, *, radius_m=0.001, strength_n=None)"),
            (
                palpate.RemoteSession.thread,
                "(self, /, tool, number, bites_m, length_m, *, radius_m=0.001, friction=0.0, strength_n=None)",
            ),
            (palpate.RemoteSession.untie, "(self, /, tool, number)"),
            (palpate.Client.load, "(self, /, plan, *, report=None)"),
        ]:
            self.assertEqual(str(inspect.signature(there)), arguments)


if __name__ == "__main__":
    unittest.main()
