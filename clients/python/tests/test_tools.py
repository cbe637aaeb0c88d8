"""Tools of a session of a server: poses, forces and grasps without a loop, scripts, and scenes on meshes."""

import tempfile
import unittest
from pathlib import Path

import numpy as np

import palpate
from common import Served


class Tools(Served, unittest.TestCase):
    def session(self, scene="paper", **options):
        session = palpate.connect(self.url).create_session(scene, **options)
        self.addCleanup(session.__exit__)
        return session

    def felt(self, session, tool, holds):
        """The first sample in which a tool feels that."""
        for sample in session.samples():
            if tool in sample["tools"] and holds(sample["tools"][tool]):
                return sample["tools"][tool]

    def test_tools_push_grasp_and_are_led_by_poses_at_once(self):
        session = self.session("liver")
        middle_m = np.array(session.status()["middle_m"])
        session.push(0, (0.0, 0.0, -0.2), point=(8, 8))
        session.grasp(1, (22, 8), (0.0, 0.0, 0.002))
        tip = palpate.Tip(0.004)
        session.pose(2, middle_m + (0, 0, 0.004), tip)
        session.pose(2, middle_m - (0, 0, 0.002), tip)
        pushed = self.felt(session, 0, lambda tool: tool["displacement_m"][2] < -1e-4)
        self.assertAlmostEqual(pushed["applied_force_n"][2], -0.2, delta=1e-6)
        held = self.felt(session, 1, lambda tool: tool["displacement_m"][2] > 0.00199)
        self.assertLess(held["force_on_tool_n"][2], 0.0)
        pressed = self.felt(session, 2, lambda tool: tool["displacement_m"][2] < -1.9e-3)
        self.assertGreater(pressed["force_on_tool_n"][2], 0.05)
        self.assertEqual(session.status()["held_tools"], [(tool, "python") for tool in range(3)])
        session.release(1)
        session.release(7)
        self.assertEqual([tool for tool, _ in session.status()["held_tools"]], [0, 2])
        # A mind may change.
        session.grasp(0, (8, 8), (0.0, 0.0, 0.001))
        self.felt(session, 0, lambda tool: tool["displacement_m"][2] > 0.00099)

    def test_what_tools_do_has_the_bits_of_this_process(self):
        # Poses without a client's time are played at their step.
        session, here = self.session("paper", paused=True), palpate.Session("paper")
        for both in (session, here):
            both.push(0, (0.01, 0.0, -0.4), at_m=(0.4, 0.55, 0.0), falloff_per_m=9.0)
            both.grasp(1, (20, 22), (0.0, 0.02, 0.01))
        session.start(until_step=200)
        here.step(200)
        self.assertEqual(session.hash(at_step=200), (200, here.hash))

    def test_what_a_server_refuses_is_told_with_its_field(self):
        session = self.session()
        other = palpate.connect(self.url).session(session.id)
        session.push(0, (0.0, 0.0, -0.1), point=(15, 15))
        for call, reason in [
            (lambda: other.push(0, (0.0, 0.0, -0.1), point=(15, 15)), "TOOL_HELD"),
            (lambda: session.push(0, (0.0, 0.0, float("nan")), point=(15, 15)), "NOT_FINITE"),
            (lambda: session.push(0, (0.0, 0.0, -0.1), point=(99, 15)), "OFF_TISSUE"),
            (lambda: session.push(0, (0.0, 0.0, -0.1)), "WRONG_KIND"),
            (lambda: session.grasp(0, 3, (0.0, 0.0, 0.0)), "WRONG_KIND"),
            (lambda: session.pose(0, (0.0, 0.0)), "WRONG_KIND"),
            (lambda: session.push(10**6, (0.0, 0.0, -0.1), point=(15, 15)), "OUT_OF_RANGE"),
        ]:
            with self.assertRaises(palpate.Refused) as raised:
                call()
            self.assertEqual(raised.exception.reason, reason, raised.exception)

    def test_a_script_has_the_records_and_the_bits_of_a_run(self):
        script = """
            duration_s = 2.2
            sample_every_s = 0.01
            sample_points = [[15, 15], [3, 20]]
            [[force]]
            point = [10, 12]
            force_n = [0.0, 0.1, -0.5]
            falloff_per_m = 5.0
            falloff_offset = 0.0
            profile = { type = "constant" }
        """
        session = self.session("paper", paused=True)
        played, run = session.play(script), palpate.run("paper", script, held=True)
        self.assertEqual(played.final_hash, run.final_hash)
        np.testing.assert_array_equal(played.time_s, run.time_s)
        self.assertEqual(played.point_names, run.point_names)
        for field in run.points.dtype.names:
            np.testing.assert_array_equal(played.points[field], run.points[field], field)
        self.assertEqual((played.header["scene"], played.summary["steps"]), ("paper", run.summary["steps"]))
        status = session.status()
        self.assertEqual((status["state"], status["step"], status["held_tools"]), ("paused", run.summary["steps"], []))
        # It continues from there, with one record less: that of the beginning exists already.
        again = session.play(script)
        self.assertEqual(len(again.time_s), len(run.time_s) - 1)
        self.assertEqual(session.status()["step"], 2 * run.summary["steps"])
        session.start()
        with self.assertRaisesRegex(palpate.Refused, "paused"):
            session.play(script)

    def test_a_script_is_played_on_a_mesh_of_ones_own(self):
        scene = dome(self, "")
        session = self.session(scene, paused=True)
        self.assertEqual(session.hash()[1], palpate.Session(scene).hash)
        script = """
            duration_s = 0.3
            sample_every_s = 0.1
            sample_points = [144, 60]
            [[tool]]
            tip = { radius_m = 0.006, friction = 0.2 }
            poses = [{ at_s = 0.0, place_m = [0.0, 0.0, 0.02] }, { at_s = 0.2, place_m = [0.0, 0.0, 0.007] }]
        """
        played, run = session.play(script), palpate.run(scene, script, held=True)
        self.assertEqual(played.final_hash, run.final_hash)
        np.testing.assert_array_equal(played.tools["force_on_tool_n"], run.tools["force_on_tool_n"])
        self.assertGreater(np.nanmax(run.tools["force_on_tool_n"][..., 2]), 0.0)
        # Somebody else does not know the mesh.
        other = palpate.connect(self.url).session(session.id)
        with self.assertRaisesRegex(palpate.Refused, "on a mesh"):
            other.play(script)
        other.play(script, scene=scene)

    def test_a_mesh_that_is_made_coarser_goes_as_it_was(self):
        coarse = dome(self, "vertices = 120")
        self.assertLessEqual(coarse.points, 120)
        session = self.session(coarse, paused=True)
        self.assertEqual(session.status()["points"], coarse.points)
        self.assertEqual(session.hash()[1], palpate.Session(coarse).hash)
        session.push(0, (0.0, 0.0, -0.05), point=144)
        session.start(until_step=20)
        here = palpate.Session(coarse)
        here.push(0, (0.0, 0.0, -0.05), point=144)
        here.step(20)
        self.assertEqual(session.hash(at_step=20)[1], here.hash)


def dome(test, more):
    """The scene of a dome of 17 × 17 vertices, with a file of its mesh beside it."""
    folder = tempfile.TemporaryDirectory()
    test.addCleanup(folder.cleanup)
    across = np.linspace(-0.03, 0.03, 17)
    places = [(x, y, 0.01 * np.cos(30 * x) * np.cos(30 * y)) for x in across for y in across]
    corners = [17 * i + j + 1 for i in range(16) for j in range(16)]
    triangles = [t for c in corners for t in ((c, c + 17, c + 18), (c, c + 18, c + 1))]
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.array(places).tolist()] + [f"f {a} {b} {c}" for a, b, c in triangles]
    path = Path(folder.name)
    (path / "dome.obj").write_text("\n".join(lines) + "\n")
    (path / "dome.toml").write_text(f"""
        name = "dome"
        [mesh]
        file = "dome.obj"
        unit = "m"
        fixed = "rim"
        point_mass_kg = 0.001
        {more}
        [springs]
        stiffness_n_per_m = 40.0
        [anchor_springs]
        stiffness_n_per_m = 5.0
        [damping]
        coefficient_n_s_per_m = 0.1
    """)
    return palpate.Scene(path / "dome.toml")


class AwaitedTools(Served, unittest.IsolatedAsyncioTestCase):
    async def test_tools_and_scripts_are_awaited(self):
        server = await palpate.aio.connect(self.url)
        async with await server.create_session("liver", paused=True) as session:
            await session.push(0, (0.0, 0.0, -0.3), point=(15, 15))
            self.assertEqual((await session.status())["held_tools"], [(0, "python")])
            await session.release(0)
            played = await session.play("press")
            self.assertEqual(played.final_hash, palpate.run("liver", "press", held=True).final_hash)


if __name__ == "__main__":
    unittest.main()
