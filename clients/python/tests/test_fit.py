"""Fits in this process."""

import os
import unittest

import numpy as np

import palpate
from common import ROOT

NAME = "material.youngs_modulus_pa"


class Fits(unittest.TestCase):
    def setUp(self):
        self.addCleanup(os.chdir, os.getcwd())
        os.chdir(ROOT)
        self.scene = palpate.Scene("phantom", set={"solid.cell_m": 0.013})

    def curve(self, force_n):
        time_s = np.linspace(0.0, 0.2, 21)
        return palpate.Curve(time_s, 0.02 * time_s, force_n, tip="rigid", radius_m=0.012)

    def test_what_was_fitted_is_given_back_from_another_start(self):
        unknown = self.curve(np.linspace(0.0, 1.0, 21))
        first = palpate.fit(self.scene, unknown, parameters=[NAME])
        self.assertEqual(list(first.values), [NAME])
        self.assertEqual(first.fitted_n[0].shape, (21,))
        np.testing.assert_allclose(first.fitted_n[0] - unknown.force_n, first.residual_n[0])
        low, high = first.intervals[NAME]
        self.assertTrue(low < first.values[NAME] < high)
        for start in (self.scene, first.scene):
            again = palpate.fit(start, [self.curve(first.fitted_n[0])], parameters=[NAME])
            self.assertAlmostEqual(again.values[NAME] / first.values[NAME], 1.0, delta=0.01)
        self.assertIn("residual", repr(again))

    def test_what_the_curves_cant_tell_is_refused_with_its_reason(self):
        curve = self.curve(palpate.fit(self.scene, self.curve(np.linspace(0.0, 1.0, 21)), parameters=[NAME]).fitted_n[0])
        with self.assertRaisesRegex(palpate.Refused, "can't tell it"):
            palpate.fit(self.scene, curve, parameters=[NAME, "material.viscosity_pa_s"])
        with self.assertRaisesRegex(palpate.Refused, r"curves\[0\]\.force_n"):
            palpate.fit(self.scene, self.curve([1.0]))


if __name__ == "__main__":
    unittest.main()
