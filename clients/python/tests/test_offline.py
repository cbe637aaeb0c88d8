"""A touch loop without a network: the forces of a record are those of C, and so of Rust (tests/abi), bit by bit."""

import os
import pathlib
import struct
import subprocess
import tempfile
import unittest

import numpy as np

import palpate
from common import PROGRAM, ROOT

RECORD = ROOT / "tests/abi/touch.record"


def events():
    """The middle of the tissue; and messages (bytes) and ticks (five numbers) in order, as clients/c/tests/replay.c reads them."""
    record = RECORD.read_bytes()
    middle_m, at, found = struct.unpack_from("<3d", record), 24, []
    while at < len(record):
        (kind,) = struct.unpack_from("<I", record, at)
        if kind == 0:
            (length,) = struct.unpack_from("<I", record, at + 4)
            found.append(record[at + 8 : at + 8 + length])
            at += 8 + length
        else:
            found.append(struct.unpack_from("<5d", record, at + 4))
            at += 44
    return middle_m, found


def rendered(offline, found):
    """The force of each tick."""
    forces_n = []
    for event in found:
        if isinstance(event, bytes):
            offline.arrive(event)
        else:
            time_s, *place_m, enable = event
            forces_n.append(offline.tick(place_m, time_s, enable != 0.0))
    return np.array(forces_n)


class Records(unittest.TestCase):
    def test_the_forces_are_those_of_the_c_library(self):
        middle_m, found = events()
        offline = palpate.Offline("omega3", middle_m=middle_m, in_tissue_frame=True)
        self.assertEqual((offline.state, offline.age_s), ("waiting", None))
        forces_n = rendered(offline, found)
        self.assertEqual(offline.state, "enabled")
        self.assertLess(offline.age_s, 0.1)
        self.assertEqual(forces_n.shape, (1500, 3))
        self.assertGreater(forces_n[:, 2].max(), 0.1)
        with tempfile.TemporaryDirectory() as folder:
            library, replay, forces = (pathlib.Path(folder) / name for name in ("lib", "replay", "forces"))
            library.mkdir()
            # As it is installed (contrib/install.sh).
            for name in ("libpalpate.so", "libpalpate.so.0"):
                (library / name).symlink_to(PROGRAM.with_name("libpalpate_c.so"))
            compiler = ["cc", "-std=c99", ROOT / "clients/c/tests/replay.c", "-I", ROOT / "clients/c/include", "-o", replay]
            try:
                subprocess.run([*compiler, f"-L{library}", "-lpalpate"], check=True)
            except FileNotFoundError:
                assert "CI" not in os.environ, "cc is missing (Debian: apt-get install gcc)"
                self.skipTest("cc is missing (Debian: apt-get install gcc)")
            subprocess.run([replay, RECORD, forces], check=True, env={**os.environ, "LD_LIBRARY_PATH": str(library)})
            of_c = np.fromfile(forces, "<f8").reshape(-1, 3)
        self.assertEqual(forces_n.tobytes(), of_c.tobytes())

    def test_a_place_of_the_device_lies_on_the_middle_of_the_tissue(self):
        middle_m, found = events()
        in_tissue = rendered(palpate.Offline("omega3", middle_m=middle_m, in_tissue_frame=True), found)
        shifted = [event if isinstance(event, bytes) else (event[0], *np.subtract(event[1:4], middle_m), event[4]) for event in found]
        # Up to what the subtraction has rounded.
        np.testing.assert_allclose(rendered(palpate.Offline("omega3", middle_m=middle_m), shifted), in_tissue, atol=1e-6)

    def test_nothing_is_rendered_before_a_connection_or_when_it_is_disabled(self):
        middle_m, found = events()
        offline = palpate.Offline("omega3", middle_m=middle_m, in_tissue_frame=True)
        self.assertEqual(offline.tick((0.0, 0.0, -0.003), 5.0), (0.0, 0.0, 0.0))
        rendered(offline, found[: len(found) // 2])
        offline.disable()
        self.assertEqual(offline.state, "disabled")
        time_s, *place_m, _ = next(event for event in reversed(found[: len(found) // 2]) if not isinstance(event, bytes))
        for tick in range(500):
            force_n = offline.tick(place_m, time_s + 1e-3 * (1 + tick))
        self.assertLess(np.linalg.norm(force_n), 1e-3)
        self.assertEqual(offline.place_m, tuple(place_m))
        offline.tick((float("nan"), 0.0, 0.0), time_s + 1.0)
        self.assertEqual(offline.state, "fault")

    def test_what_is_wrong_is_refused(self):
        for wrong in (
            lambda: palpate.Offline("omega4"),
            lambda: palpate.Offline(middle_m=(0.0, 0.0)),
            lambda: palpate.Offline(middle_m=(0.0, 0.0, float("inf"))),
            lambda: palpate.Offline().arrive(b"\xff" * 9),
        ):
            with self.assertRaises(palpate.Refused):
                wrong()


if __name__ == "__main__":
    unittest.main()
