"""Runs in this process: the numbers and the bits of the program."""

import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import threading
import unittest

import numpy as np

import palpate
from common import ROOT, program_run

FIELDS = ["displacement_m", "velocity_m_per_s", "spring_n", "anchor_n", "damping_n", "applied_n", "reaction_n"]

FORCE = """
duration_s = 0.05
sample_every_s = 0.01
sample_points = [[15, 15], [16, 15]]
[[force]]
point = [15, 15]
force_n = [0.1, 0.0, -1.0]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
"""

ON_MESH = """
duration_s = 0.05
sample_every_s = 0.01
sample_points = [17, 40]
[[force]]
vertex = 17
force_n = [0.1, 0.0, -0.1]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
"""


class Runs(unittest.TestCase):
    def setUp(self):
        self.addCleanup(os.chdir, os.getcwd())
        os.chdir(ROOT)

    def same(self, lines, run):
        """Every number of the program's lines is in the arrays, exactly."""
        header, *records, summary = lines
        self.assertEqual(header["run"], run.header)
        self.assertEqual(summary["summary"]["final_hash"], run.final_hash)
        for name in ("steps", "substeps", "points", "computed_fraction", "guard_events", "audited_error"):
            self.assertEqual(summary["summary"].get(name), run.summary.get(name), name)
        self.assertEqual(len(records), len(run.time_s))
        for at, record in enumerate(records):
            self.assertEqual(record["time_s"], run.time_s[at])
            self.assertEqual(record["awake_points"], run.awake_points[at])
            self.assertEqual(record["energy_j"], {name: run.energy_j[name][at] for name in run.energy_j.dtype.names})
            for column, point in enumerate(record["points"]):
                name = tuple(point["point"]) if "point" in point else point["vertex"]
                self.assertEqual(name, run.point_names[column])
                for field in FIELDS:
                    self.assertEqual(point[field], run.points[field][at, column].tolist(), field)
                held = run.points["constraint_n"][at, column]
                self.assertEqual(point.get("constraint_n"), None if np.isnan(held).all() else held.tolist())
            here = {tool["tool"]: tool for tool in record.get("tools", [])}
            for column, number in enumerate(run.tool_numbers):
                felt = run.tools[at, column]
                if number in here:
                    for field in felt.dtype.names:
                        self.assertEqual(here[number][field], felt[field].tolist())
                else:
                    self.assertTrue(np.isnan(felt["force_on_tool_n"]).all())

    def test_a_run_has_the_numbers_and_the_hash_of_the_program(self):
        on_mesh = tempfile.NamedTemporaryFile("w", suffix=".toml")
        self.addCleanup(on_mesh.close)
        on_mesh.write(ON_MESH)
        on_mesh.flush()
        for scene, script, held, settings in [
            ("paper", "vertical-60", True, {}),
            ("paper", "oblique-100", False, {"springs.stiffness_n_per_m": 30.5, "stepping.integrator": "lagged"}),
            ("paper", "grasp", True, {"sheet.points": [31, 31]}),
            ("liver", "press", True, {}),
            ("gallbladder", on_mesh.name, True, {}),
        ]:
            with self.subTest(scene=scene, script=script, held=held):
                text = [f"{key}={value}" for key, value in settings.items()]
                flags = [flag for one in text for flag in ("--set", one)] + ["--held"] * held
                lines = program_run(scene, script, *flags)
                self.same(lines, palpate.run(palpate.Scene(scene, set=settings), script, held=held))

    def test_an_audit_measures_what_the_program_measures(self):
        lines = program_run("paper", "vertical-60", "--audit", "--held")
        run = palpate.run("paper", "vertical-60", held=True, audit=True)
        self.assertLess(run.summary["audited_error"]["displacement"], 1e-5)
        self.same(lines, run)

    def test_a_study_has_the_hashes_of_its_runs_on_any_number_of_threads(self):
        scenes = [palpate.Scene("paper", set={"springs.stiffness_n_per_m": float(k)}) for k in range(1, 13)]
        cases = [(scene, FORCE) for scene in scenes]
        alone = [palpate.run(scene, FORCE, held=True).final_hash for scene in scenes]
        self.assertEqual(len(set(alone)), len(alone))
        told = []
        for threads in (1, 3):
            runs = palpate.study(cases, held=True, threads=threads, progress=lambda *of: told.append(of))
            self.assertEqual([run.final_hash for run in runs], alone)
        self.assertEqual(told[-1], (12, 12))
        self.assertEqual(palpate.study([]), [])

    def test_a_plan_of_another_tissue_gives_the_bits_that_the_same_plan_gives(self):
        soft, stiff = ({"springs.stiffness_n_per_m": k} for k in (11.0, 12.0))
        plan = palpate.Tissue(palpate.Scene("paper", set=stiff))
        own, planned = palpate.Tissue(palpate.Scene("paper", set=soft)), palpate.Tissue(palpate.Scene("paper", set=soft, plan=plan))
        for name in ("integrator", "substeps", "precision"):
            self.assertEqual(getattr(own, name), getattr(planned, name))
        self.assertEqual(planned.expected_error, float("inf"))
        self.assertIn("nothing is known of the error", " ".join(planned.warnings))
        runs = [palpate.run(tissue, FORCE, held=True) for tissue in (own, planned, plan)]
        self.assertEqual(runs[0].final_hash, runs[1].final_hash)
        self.assertNotEqual(runs[0].final_hash, runs[2].final_hash)

    def test_a_study_names_the_case_that_fails_or_gives_its_error(self):
        cases = [("paper", FORCE), ("paper", FORCE.replace("[15, 15]", "[99, 15]")), ("paper", FORCE)]
        with self.assertRaises(palpate.Refused) as raised:
            palpate.study(cases, threads=2)
        self.assertEqual(raised.exception.reason, "OFF_TISSUE")
        if sys.version_info >= (3, 11):
            self.assertEqual(raised.exception.__notes__, ["in case 1 of the study"])
        first, refused, last = palpate.study(cases, errors="return")
        self.assertEqual(first.final_hash, last.final_hash)
        self.assertIsInstance(refused, palpate.Refused)

    def test_an_exception_of_progress_ends_a_study(self):
        class Enough(Exception):
            pass

        def progress(done, count):
            raise Enough

        with self.assertRaises(Enough):
            palpate.study([("paper", FORCE)] * 4, progress=progress)

    def test_a_refusal_tells_reason_field_and_line(self):
        text = pathlib.Path("scenes/paper.toml").read_text()
        for source, settings, reason, field, line in [
            (text.replace("spacing_m = 0.0333", "spacing_m = -0.0333"), None, "OUT_OF_RANGE", "sheet.spacing_m", 7),
            (text + "\n[sheep]\n", None, "UNKNOWN_KEY", "sheep", 19),
            ("name =", None, "UNREADABLE", "", 1),
            ("papr", None, "UNKNOWN_SCENE", "scene_name", None),
            ("paper", {"springs.stiffness_n_per_m": float("nan")}, "NOT_FINITE", "springs.stiffness_n_per_m", None),
            ("paper", {"springs.stiffness": 3}, "UNKNOWN_KEY", "springs.stiffness", None),
            (pathlib.Path("no-such-file.toml"), None, "UNREADABLE", "", None),
        ]:
            with self.subTest(field=field, reason=reason):
                with self.assertRaises(palpate.Refused) as raised:
                    palpate.Scene(source, set=settings)
                refused = raised.exception
                self.assertEqual((refused.reason, refused.field, refused.line), (reason, field, line), refused)
                self.assertIn(refused.message, str(refused))
                self.assertIsInstance(refused, (ValueError, palpate.Error))
        with self.assertRaises(palpate.Refused) as raised:
            palpate.run("paper", FORCE.replace("duration_s", "duration"))
        self.assertEqual((raised.exception.reason, raised.exception.place), ("UNKNOWN_KEY", "<text>:2"))

    def test_scenes_come_from_names_files_and_texts(self):
        text = pathlib.Path("scenes/paper.toml").read_text()
        found = {palpate.run(source, FORCE).final_hash for source in ("paper", text, "scenes/paper.toml", pathlib.Path("scenes/paper.toml"))}
        self.assertEqual(len(found), 1)
        self.assertIn("liver", palpate.scenes())
        self.assertIn("press", palpate.scripts())
        with tempfile.TemporaryDirectory() as folder:
            (pathlib.Path(folder) / "mine.toml").write_text(text)
            self.assertIn("mine", palpate.scenes(folder))
            self.assertEqual(palpate.Scene("mine", folder=folder).points, 961)
        checked = palpate.Script("press").check("liver")
        self.assertEqual((checked["steps"], checked["tools"]), (2000, 1))

    def test_ctrl_c_ends_a_run_a_study_and_steps(self):
        long = FORCE.replace("0.05", "36000.0").replace("0.01", "36000.0")
        for work in (
            "palpate.run('paper', script)",
            "palpate.study([('paper', script)] * 3, threads=2)",
            "session = palpate.Session('paper'); session.push(0, (0, 0, -1), point=(15, 15)); session.step(10**9)",
        ):
            with self.subTest(work=work):
                program = (
                    "import palpate, signal, sys\n"
                    "script = sys.argv[1]\n"
                    # Tests that run in the background may ignore it.
                    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
                    "signal.setitimer(signal.ITIMER_REAL, 0.4)\n"
                    "signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))\n"
                    f"try:\n    {work}\nexcept KeyboardInterrupt:\n    print('interrupted')\n"
                )
                ran = subprocess.run([sys.executable, "-c", program, long], capture_output=True, text=True, timeout=60)
                self.assertEqual((ran.stdout, ran.returncode), ("interrupted\n", 0), ran.stderr)

    def test_other_threads_go_on_while_a_run_computes(self):
        done = []
        work = threading.Thread(target=lambda: done.append(palpate.run("paper", FORCE.replace("0.05", "2.0"))))
        work.start()
        turns = 0
        while work.is_alive():
            turns += 1
        self.assertGreater(turns, 1000)
        self.assertEqual(done[0].summary["steps"], 2000)


if __name__ == "__main__":
    unittest.main()
