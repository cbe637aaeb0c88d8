"""The programs of docs/your-language.md, each in a Python of its own."""

import re
import subprocess
import sys
import unittest

from common import ROOT, Server

PAGE = ROOT / "docs/your-language.md"


class Page(unittest.TestCase):
    def test_every_program_of_the_page_runs(self):
        text = PAGE.read_text()
        programs = re.findall(r"^```python\n((?:.*\n)*?)```$", text, re.MULTILINE)
        self.assertGreater(len(programs), 6)
        with Server() as server:
            for program in programs:
                with self.subTest(program.strip().splitlines()[-1]):
                    program = program.replace("http://127.0.0.1:7117", server.url)
                    command = [sys.executable, "-c", program]
                    one = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
                    self.assertEqual(one.returncode, 0, one.stderr)
                    self.assertTrue(one.stdout)
                    self.assertNotRegex(one.stdout, r"\bnan\b|False")


if __name__ == "__main__":
    unittest.main()
