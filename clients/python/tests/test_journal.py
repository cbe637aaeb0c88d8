"""Journals as arrays."""

import json
import shutil
import subprocess
import tempfile
import unittest
from pathlib import Path

import numpy as np

import palpate
from common import GOLDEN, PROGRAM


class Journals(unittest.TestCase):
    def test_the_arrays_have_what_the_program_exports(self):
        journal = palpate.Journal(GOLDEN)
        self.assertEqual((journal.info["session_id"], journal.info["scene"], journal.info["end_step"]), ("0123456789abcdef", "paper", 1000))
        export = [PROGRAM, "journal", "export", "--format", "jsonl", GOLDEN]
        rows = [json.loads(line) for line in subprocess.run(export, check=True, capture_output=True, text=True).stdout.splitlines()]
        tools = journal.tools()
        self.assertEqual(sum(map(len, tools.values())), len(rows))
        for number, course in tools.items():
            own = [row for row in rows if row["tool"] == number]
            self.assertEqual(course.step.tolist(), [row["step"] for row in own])
            self.assertEqual(course.time_s.tolist(), [row["time_s"] for row in own])
            for name in ("place_m", "displacement_m", "force_n"):
                np.testing.assert_array_equal(getattr(course, name).astype(np.float32), np.array([row[name] for row in own], np.float32))
        self.assertGreater(max(course.force_n[:, 2].max() for course in tools.values()), 0.0)

    def test_commands_are_in_order_with_what_they_say(self):
        commands = palpate.Journal(GOLDEN).commands()
        shown = subprocess.run([PROGRAM, "journal", "show", "--json", GOLDEN], check=True, capture_output=True, text=True).stdout
        lines = [line for line in map(json.loads, shown.splitlines()) if line.get("input") == "command"]
        self.assertEqual((commands.step.tolist(), commands.tool.tolist()), ([line["step"] for line in lines], [line["tool"] for line in lines]))
        poses = commands.kind == "pose"
        self.assertEqual(commands.place_m[poses].tolist(), [line["pose"]["place_m"] for line in lines if "pose" in line])
        self.assertTrue(np.isnan(commands.force_n[poses]).all())
        self.assertEqual(int((commands.kind == "push").sum()), sum("push" in line for line in lines))

    def test_a_journal_verifies_and_gives_its_session_at_any_step(self):
        journal = palpate.Journal(GOLDEN)
        verdict = journal.verify()
        self.assertTrue(verdict, verdict)
        self.assertEqual((verdict.begin_step, verdict.end_step), (0, 1000))
        self.assertGreater(verdict.hashes, 0)
        session = journal.session(640)
        self.assertEqual(session.steps, 640)
        self.assertEqual(journal.session().steps, 1000)
        self.assertEqual(palpate.Session.restore(session.tissue, session.save()).hash, session.hash)
        with self.assertRaises(palpate.Refused) as raised:
            journal.session(1001)
        self.assertEqual((raised.exception.reason, raised.exception.field), ("OUT_OF_RANGE", "step"))

    def test_what_is_no_journal_is_refused(self):
        with tempfile.TemporaryDirectory() as folder:
            torn = Path(folder) / "torn.1.mcap"
            shutil.copy(GOLDEN, torn)
            torn.write_bytes(torn.read_bytes()[:10])
            for path in (torn, Path(folder), Path(folder) / "none.mcap"):
                with self.assertRaises(palpate.Refused) as raised:
                    palpate.Journal(path)
                self.assertIn(str(path), raised.exception.place)


if __name__ == "__main__":
    unittest.main()
