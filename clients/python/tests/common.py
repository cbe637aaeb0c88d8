"""Shared parts of the tests: the built programs, and a server."""

import json
import pathlib
import subprocess
import sys

# The server of the tests that have no package.
sys.path.append(str(pathlib.Path(__file__).resolve().parents[3] / "tests/python"))
from server import PROGRAM, ROOT, Server  # noqa: E402

EXAMPLES = ROOT / "clients/python/examples"
GOLDEN = ROOT / "tests/journal/golden.6.mcap"


class Served:
    """Tests with one server for all of a class, at `url`."""

    @classmethod
    def setUpClass(cls):
        server = Server()
        cls.url = server.__enter__().url
        cls.addClassCleanup(server.__exit__)


def program_run(*arguments):
    """The lines of `palpate run`."""
    ran = subprocess.run([PROGRAM, "run", "--quiet", *arguments], capture_output=True, text=True, cwd=ROOT)
    assert ran.returncode == 0, ran.stderr
    return [json.loads(line) for line in ran.stdout.splitlines()]
