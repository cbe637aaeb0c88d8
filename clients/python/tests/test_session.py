"""Sessions in this process."""

import unittest

import numpy as np

import palpate

PUSH = """
duration_s = 0.02
sample_every_s = 0.02
sample_points = [[15, 15]]
[[force]]
point = [15, 15]
force_n = [0.1, 0.0, -1.0]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
"""

POSE = """
duration_s = 0.03
sample_every_s = 0.03
[[tool]]
tip = { radius_m = 0.006, friction = 0.3 }
poses = [
    { at_s = 0.0, place_m = [0.0375, 0.0375, -0.002] },
    { at_s = 0.03, place_m = [0.0375, 0.0375, -0.002] },
]
"""


def pushed(steps):
    session = palpate.Session("paper")
    session.push(0, (0.1, 0.0, -1.0), point=(15, 15), falloff_per_m=150.0)
    session.step(steps)
    return session


class Sessions(unittest.TestCase):
    def test_a_tip_that_burns_leaves_burns_in_proportion_to_its_time(self):
        for scene in ("liver", "phantom"):
            session = palpate.Session(scene)
            tip = palpate.Tip(radius_m=0.004, grasps=True, burn_s=0.1)
            self.assertEqual(session.burns().shape, (len(session.tissue),))
            self.assertEqual(session.burns().max(), 0.0)
            for _ in range(40):
                session.pose(0, np.array(session.tissue.top_m) - (0, 0, 0.001), tip)
                session.step()
            burns = session.burns()
            self.assertAlmostEqual(burns.max(), 0.4, delta=0.02)
            self.assertGreater((burns > 0).sum(), 3)
            self.assertLess((burns > 0).mean(), 0.5)

    def test_tools_act_with_the_bits_of_a_script(self):
        run = palpate.run("paper", PUSH, held=True)
        session = pushed(20)
        self.assertEqual(session.hash, run.final_hash)
        self.assertEqual((session.steps, session.time_s), (20, 0.02))
        record = session.records([(15, 15)])
        for field in record.dtype.names:
            np.testing.assert_array_equal(record[field], run.points[field][-1])
        run = palpate.run("liver", POSE, held=True)
        session = palpate.Session("liver")
        session.pose(2, (0.0375, 0.0375, -0.002), palpate.Tip(0.006, friction=0.3))
        session.step(30)
        self.assertEqual(session.hash, run.final_hash)
        felt = session.tool(2)
        np.testing.assert_array_equal(felt.force_on_tool_n, run.tools["force_on_tool_n"][-1, 0])
        self.assertGreater(felt.force_on_tool_n[2], 0.1)
        self.assertIsNone(session.tool(1))

    def test_a_tool_stays_until_it_is_released(self):
        session = palpate.Session("liver")
        session.pose(0, (0.0375, 0.0375, -0.002))
        # Far longer than a tool may be silent over a network.
        session.step(600)
        self.assertGreater(session.tool(0).force_on_tool_n[2], 0.1)
        session.release(0)
        session.step(3000)
        self.assertLess(np.abs(session.displacements()).max(), 2e-4)

    def test_a_grasped_point_goes_where_it_is_led(self):
        session = palpate.Session("liver")
        row = session.tissue.nearest(session.tissue.middle_m)
        point = session.tissue.point(row)
        session.grasp(1, point, (0.0, 0.001, 0.002))
        session.step(100)
        np.testing.assert_allclose(session.displacements()[row], (0.0, 0.001, 0.002), atol=1e-9)
        self.assertLess(session.tool(1).force_on_tool_n[2], 0.0)

    def test_arrays_have_what_records_have(self):
        for name in ("paper", "gallbladder"):
            with self.subTest(scene=name):
                session = palpate.Session(name)
                tissue = session.tissue
                at = tissue.rest_m[0] if name == "gallbladder" else tissue.middle_m
                session.push(0, (0.02, 0.01, -0.1), at_m=at)
                session.grasp(1, tissue.point(len(tissue) // 3 + 5), (0.0, 0.0, 0.001))
                session.step(37)
                records, rest_m = session.records(), tissue.rest_m
                self.assertEqual((records.shape, rest_m.shape), ((len(tissue),), (len(tissue), 3)))
                self.assertGreater(np.abs(records["displacement_m"]).max(), 1e-4)
                # Records complete what a multistep scheme has predicted: far within the tolerance, and more than f32 rounds.
                largest_m = np.abs(records["displacement_m"]).max()
                np.testing.assert_allclose(session.displacements(), records["displacement_m"], rtol=0, atol=1e-6 * largest_m)
                np.testing.assert_array_equal(session.velocities(), records["velocity_m_per_s"])
                np.testing.assert_array_equal(session.positions(), rest_m + session.displacements())
                self.assertEqual(np.isfinite(records["constraint_n"]).all(axis=1).sum(), 1 + tissue.fixed.sum())
                out = np.empty_like(rest_m)
                self.assertIs(session.displacements(out), out)
                np.testing.assert_array_equal(out, session.displacements())
                with self.assertRaises(palpate.Refused):
                    session.displacements(np.empty((3, 3)))
                kinetic = 0.5 * (tissue.mass_kg * (records["velocity_m_per_s"] ** 2).sum(axis=1)).sum()
                self.assertAlmostEqual(session.energy_j["kinetic"] / kinetic, 1.0, delta=0.05)

    def test_a_tissue_tells_its_shape(self):
        sheet, organ = palpate.Tissue("paper"), palpate.Tissue("gallbladder")
        self.assertEqual((sheet.grid, organ.grid), ((31, 31), None))
        self.assertEqual(len(sheet.triangles), 2 * 30 * 30)
        self.assertEqual(sheet.point(sheet.index((3, 4))), (3, 4))
        self.assertEqual(organ.point(organ.index(17)), 17)
        for tissue in (sheet, organ):
            corners = tissue.rest_m[tissue.triangles]
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            outward = (across * tissue.normals[tissue.triangles[:, 0]]).sum(axis=1)
            self.assertGreater((outward > 0).mean(), 0.99)
            self.assertEqual(tissue.nearest(tissue.rest_m[40]), 40)

    def test_a_snapshot_goes_on_with_the_same_bits(self):
        session = pushed(25)
        session.change(stiffness_n_per_m=25.0)
        session.step(25)
        saved = session.save()
        again = palpate.Session.restore("paper", saved)
        self.assertEqual((again.steps, again.hash), (50, session.hash))
        for one in (session, again):
            one.step(25)
            one.change(damping_n_s_per_m=0.8)
            one.release(0)
            one.step(25)
        self.assertEqual(again.hash, session.hash)
        with self.assertRaises(palpate.Refused):
            palpate.Session.restore("paper", saved[:-1])
        with self.assertRaises(palpate.Refused):
            palpate.Session.restore("liver", saved)

    def test_a_session_that_goes_on_knows_the_tips_of_its_tools(self):
        session, tip = palpate.Session("paper"), palpate.Tip(0.04)
        for step in range(30):
            session.pose(0, (0.25, 0.25, 0.01 - 0.001 * step), tip)
            session.step()
        again = palpate.Session.restore("paper", session.save())
        with self.assertRaises(palpate.Refused) as raised:
            palpate.Session.restore("paper", session.save()).pose(0, (0.25, 0.25, -0.02), palpate.Tip(0.02))
        self.assertEqual((raised.exception.reason, raised.exception.field), ("OUT_OF_TURN", "pose.tip.radius_m"))
        for one in (session, again):
            one.step(10)
            one.pose(0, (0.25, 0.26, -0.02))
            one.step(20)
        self.assertEqual(again.hash, session.hash)

    def test_a_sphere_presses_a_solid_from_a_radius_above_it(self):
        session, tip = palpate.Session("phantom"), palpate.Tip(0.005, shape="sphere")
        self.assertEqual((tip.shape, repr(tip)), ("sphere", "Tip(0.005, friction=0.2, grasps=False, shape=\"sphere\")"))
        # Its top is at 40 mm.
        for step in range(100):
            session.pose(0, (0, 0, 0.0455 - 2e-5 * step), tip)
            session.step()
            if step == 20:
                self.assertEqual(session.tool(0).force_on_tool_n[2], 0.0)
        self.assertGreater(session.tool(0).force_on_tool_n[2], 0.05)
        with self.assertRaisesRegex(ValueError, "shape: must be one of disc, rigid, sphere"):
            palpate.Tip(shape="cube")
        with self.assertRaises(palpate.Refused) as raised:
            palpate.Session("paper").pose(0, (0.2, 0.2, 0.0), tip)
        self.assertEqual(raised.exception.field, "pose.tip.shape")

    def test_a_zero_has_no_sign(self):
        hashes = []
        for zero in (0.0, -0.0):
            session = palpate.Session(palpate.Scene("paper", set={"damping.coefficient_n_s_per_m": zero}))
            session.grasp(0, (7, 7), (zero, 0.001, zero))
            session.pose(1, (0.2, 0.2, zero))
            session.step(20)
            hashes.append((session.hash, session.save()))
        self.assertEqual(hashes[0], hashes[1])

    def test_a_change_has_the_bits_of_a_script_that_changes(self):
        script = PUSH + "[[tissue]]\nat_s = 0.01\nanchor_stiffness_n_per_m = 50.0\n"
        session = pushed(10)
        session.change(anchor_stiffness_n_per_m=50.0)
        session.step(10)
        self.assertEqual(session.hash, palpate.run("paper", script, held=True).final_hash)

    def test_what_makes_no_sense_is_refused_and_changes_nothing(self):
        session = pushed(3)
        before = session.hash
        for refused, reason in [
            (lambda: session.push(0, (0, 0, 1e9), point=(15, 15)), "FORCE_TOO_LARGE"),
            (lambda: session.push(0, (0, 0, 1), point=(31, 0)), "OFF_TISSUE"),
            (lambda: session.push(0, (0, 0, 1), at_m=(9, 9, 0)), "OFF_TISSUE"),
            (lambda: session.push(0, (0, 0, 1)), "WRONG_KIND"),
            (lambda: session.push(64, (0, 0, 1), point=(15, 15)), "OUT_OF_RANGE"),
            (lambda: session.push(0, "down", point=(15, 15)), "WRONG_KIND"),
            (lambda: session.pose(0, (0, 0, float("nan"))), "NOT_FINITE"),
            (lambda: session.pose(0, (0.5, 0.5, 0), palpate.Tip(-1)), "OUT_OF_RANGE"),
            (lambda: session.grasp(0, 17, (0, 0, 0)), "WRONG_KIND"),
            (lambda: session.change(), "MISSING"),
            (lambda: session.change(stiffness_n_per_m=-1.0), "OUT_OF_RANGE"),
        ]:
            with self.assertRaises(palpate.Refused) as raised:
                refused()
            self.assertEqual(raised.exception.reason, reason, raised.exception)
        self.assertEqual(session.hash, before)
        session.step(17)
        self.assertEqual(session.hash, palpate.run("paper", PUSH, held=True).final_hash)


if __name__ == "__main__":
    unittest.main()
