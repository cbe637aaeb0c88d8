"""Loads of a real server by a plan."""

import asyncio
import pathlib
import signal
import subprocess
import sys
import tempfile
import threading
import time
import unittest

import palpate
import palpate.aio
from common import ROOT, Served

# Two come at once, and one more later. All are gone at the end.
PLAN = {
    "name": "<brief>",
    "seed": 7,
    "objective": "p50<60s,turned_away<1",
    "rate_hz": 200.0,
    "scene": [{"name": "liver"}],
    "hand": [{"hand": "medium", "device": "omega3", "deadband": 0.1}, {"hand": "push", "share": 2}],
    "viewers": [{"number": 1, "rate_hz": 20}],
    "phase": [
        {"name": "spike", "seconds": 2, "arrivals": "spike", "users": 2, "stays_s": 60},
        {"name": "one", "seconds": 1, "arrivals": "steady", "rate_per_s": 1, "objective": "p50<60s"},
    ],
}

TEXT = """
[[phase]]
name = "brief"
seconds = 1.5
arrivals = "spike"
users = 1
objective = "p50<1us"
"""

INTERRUPTED = """
import signal
import sys
import palpate
# Tests that run in the background may ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
print("begins", flush=True)
palpate.load("[[phase]]\\nseconds = 600\\narrivals = 'spike'\\nusers = 2", sys.argv[1])
"""


class Loads(Served, unittest.TestCase):
    def sessions(self):
        return palpate.connect(self.url).sessions()

    def test_a_plan_of_a_dict_is_played_and_reported(self):
        counted, over = [0], threading.Event()

        def count():
            while not over.is_set():
                counted[0] += 1
                time.sleep(0.001)

        thread = threading.Thread(target=count)
        thread.start()
        with tempfile.TemporaryDirectory() as folder:
            page = pathlib.Path(folder) / "load.html"
            told = palpate.load(PLAN, self.url, report=page)
            text = page.read_text()
        over.set()
        thread.join()
        # The interpreter was free meanwhile.
        self.assertGreater(counted[0], 100)
        self.assertEqual((told["plan"], told["kept"], told["why"]), ("<brief>", True, None))
        self.assertEqual([phase["name"] for phase in told["phases"]], ["spike", "one"])
        self.assertEqual([phase["users_arrived"] for phase in told["phases"]], [2, 1])
        self.assertEqual((told["all"]["users_left"], told["all"]["turned_away"]), (3, {}))
        self.assertGreater(told["all"]["samples"], 0)
        self.assertGreater(told["all"]["frames"], 0)
        self.assertGreater(told["all"]["round_trip_us"]["p50"], 0)
        self.assertEqual(self.sessions(), [])
        self.assertEqual(text.count("<svg"), 4)
        self.assertIn("&lt;brief&gt;", text)
        self.assertIn("All objectives were kept.", text)

    def test_an_objective_that_is_missed_is_told_in_the_report(self):
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "plan.toml"
            path.write_text(TEXT)
            for plan in (TEXT, path, str(path)):
                told = palpate.connect(self.url).load(plan)
                self.assertEqual((told["kept"], told["phases"][0]["missed"]), (False, ["p50<1us"]))
                self.assertIn("`brief` misses p50<1us", told["why"])

    def test_what_is_wrong_is_refused_before_anybody_comes(self):
        phase = {"seconds": 1}
        for plan, field, line, says in [
            ({"phase": [{"seconds": 0.1}]}, "phase[0].seconds", None, "from 0.5"),
            ({"phase": [phase], "objective": "p98<2ms"}, "objective", None, "unknown quantity"),
            ({"phase": [phase], "hand": [{"hand": "frim"}]}, "hand[0].hand", None, "firm"),
            ({"phase": [{"seconds": None}]}, "plan", None, "None"),
            ({}, "phase", None, "is missing"),
            ("[[phase]]\nseconds = 1\nusers = 3", "phase[0].users", 3, "no meaning"),
            ("no-such-plan.toml", "", None, "can't be opened"),
            (17, "plan", None, "TOML text, a path"),
            ({"phase": [phase], "scene": [{"name": "no-such.toml"}]}, "", None, "can't be opened"),
        ]:
            with self.assertRaises(palpate.Refused) as raised:
                palpate.load(plan, self.url)
            refused = raised.exception
            self.assertEqual((refused.field, refused.line), (field, line), refused)
            self.assertIn(says, str(refused))
        with self.assertRaisesRegex(OSError, "no-such-folder"):
            palpate.load({"phase": [phase]}, self.url, report="no-such-folder/load.html")
        with self.assertRaises(palpate.Disconnected):
            palpate.load({"phase": [phase]}, "http://127.0.0.1:1")
        self.assertEqual(self.sessions(), [])

    def test_the_plan_that_is_shipped_can_be_read(self):
        with self.assertRaises(palpate.Disconnected):
            palpate.load(ROOT / "contrib/plan.toml", "http://127.0.0.1:1")

    def test_ctrl_c_ends_it_and_deletes_its_sessions(self):
        command = [sys.executable, "-c", INTERRUPTED, self.url]
        loading = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.assertEqual(loading.stdout.readline(), "begins\n")
        while len(self.sessions()) < 2:
            self.assertIsNone(loading.poll())
            time.sleep(0.05)
        loading.send_signal(signal.SIGINT)
        said = loading.communicate(timeout=60)[1]
        self.assertNotEqual(loading.returncode, 0)
        self.assertTrue(said.rstrip().endswith("KeyboardInterrupt"), said)
        self.assertEqual(self.sessions(), [])

    def test_it_can_be_awaited(self):
        async def main():
            server = await palpate.aio.connect(self.url)
            one, two = await asyncio.gather(server.load(TEXT), server.load(TEXT))
            return one["all"]["users_arrived"] + two["all"]["users_arrived"]

        self.assertEqual(asyncio.run(main()), 2)


if __name__ == "__main__":
    unittest.main()
