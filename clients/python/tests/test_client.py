"""A real server, touched and looked at, with and without asyncio."""

import asyncio
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
import unittest
from pathlib import Path
from unittest.mock import ANY

import numpy as np

import palpate
from common import Served


class Hand:
    """A device of Python's making, that presses 2 mm deep. `fails_at` counts its readings."""

    limits = {"force_n": 3.0, "continuous_n": 1.0, "workspace_m": 0.1}

    def __init__(self, fails_at=None, height_m=-0.002):
        self.readings, self.forces, self.fails_at, self.height_m = 0, [], fails_at, height_m
        self.threads = set()

    def read(self):
        self.readings += 1
        self.threads.add(threading.get_ident())
        if self.readings == self.fails_at:
            raise OverflowError("the arm is off its hinge")
        return (0.0, 0.0, max(0.003 - 2e-5 * self.readings, self.height_m)), self.readings % 300 < 150

    def write(self, force_n):
        self.forces.append(force_n)


class Handle(Hand):
    """A device of six axes, whose instrument lies along x and presses 1 mm deep once a second."""

    limits = "sigma7"

    def __init__(self, orientation=(1.0, 0.0, 0.0, 0.0), aside_m=0.0):
        super().__init__()
        self.orientation, self.aside_m, self.torques = orientation, aside_m, []

    def read(self):
        _, enable = super().read()
        # Forces begin while it is above the tissue, where it comes again and again.
        height_m = 0.001 + 0.002 * math.cos(2.0 * math.pi * self.readings / 1000.0)
        return (0.0, self.aside_m, height_m), enable, self.orientation, 0.2

    def write(self, force_n, torque_n_m):
        super().write(force_n)
        self.torques.append(torque_n_m)


# Ends while samples come that are no longer awaited.
ENDING = """
import asyncio, sys
import palpate

async def main(url):
    server = await palpate.aio.connect(url)
    async with await server.create_session("paper") as session:
        streams = [await session.samples() for _ in range(8)]
        await streams[0].__anext__()
        for stream in streams:
            asyncio.ensure_future(stream.__anext__())
        await asyncio.sleep(0.001)

asyncio.run(main(sys.argv[1]))
"""


# A child of fork, which has none of its parent's threads.
FORKED = """
import os, sys
import palpate

server = palpate.connect(sys.argv[1])
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
told = []
for call in (lambda: palpate.connect(sys.argv[1]), server.scenes):
    try:
        call()
    except RuntimeError as error:
        told.append(str(error))
os._exit(0 if len(told) == 2 and all("forked" in text for text in told) else 1)
"""


def felt(touch):
    """What came of a touch in which something was felt. A busy machine may connect only when the device's time is over."""
    for _ in range(20):
        touched = touch()
        if touched.force_n.size and np.abs(touched.force_n).max() > 0.0:
            return touched
    raise AssertionError("nothing was felt")


class Clients(Served, unittest.TestCase):
    def test_a_program_may_end_while_something_comes(self):
        for _ in range(12):
            done = subprocess.run([sys.executable, "-c", ENDING, self.url], capture_output=True, text=True, timeout=60)
            self.assertEqual(done.returncode, 0, done.stderr)

    @unittest.skipUnless(hasattr(os, "fork"), "no fork here")
    def test_a_forked_child_is_refused_and_does_not_hang(self):
        done = subprocess.run([sys.executable, "-c", FORKED, self.url], capture_output=True, text=True, timeout=60)
        self.assertEqual(done.returncode, 0, done.stderr)

    def test_a_session_runs_pauses_changes_and_ends(self):
        server = palpate.connect(self.url)
        self.assertIn("paper", server.scenes())
        with server.create_session("paper", paused=True) as session:
            status = session.status()
            self.assertEqual((status["state"], status["step"], status["points"]), ("paused", 0, 961))
            self.assertEqual(session.change(stiffness_n_per_m=20.0), 0)
            session.start(until_step=50)
            step, digest = session.hash(at_step=50)
            self.assertEqual((step, session.status()["state"]), (50, "paused"))
            self.assertEqual(server.session(session.id).hash(), (50, digest))
            self.assertIn(session.id, [other["session_id"] for other in server.sessions()])
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "moment.mcap"
                path.write_bytes(session.save())
                here = palpate.Journal(path).session()
            self.assertEqual((here.steps, here.hash), (50, digest))
        with self.assertRaises(palpate.Refused) as raised:
            session.status()
        self.assertEqual(raised.exception.reason, "UNKNOWN_SESSION")

    def test_a_scene_of_ones_own_has_the_bits_of_this_process(self):
        scene = palpate.Scene("paper", set={"sheet.points": [20, 24], "springs.stiffness_n_per_m": 15.0})
        with palpate.connect(self.url).create_session(scene, paused=True) as session:
            self.assertEqual(session.status()["points"], 480)
            self.assertEqual(session.hash()[1], palpate.Session(scene).hash)

    def test_a_course_is_felt_and_seen(self):
        with palpate.connect(self.url).create_session("liver") as session:
            frames, samples = session.frames(rate_hz=30), session.samples()
            first = next(frames)
            touched = felt(lambda: session.touch(palpate.press(depth_m=0.003, seconds=2.0)))
            self.assertIsNone(touched.lost)
            self.assertGreater(len(touched.time_s), 300)
            # It pushes the hand up, and only where there is tissue.
            self.assertGreater(touched.force_n[:, 2].max(), 0.0)
            self.assertEqual(np.abs(touched.force_n[~touched.enabled]).max(initial=0.0), 0.0)
            self.assertLess(np.linalg.norm(touched.force_n, axis=1).max(), 3.3 + 1e-9)
            self.assertGreater(touched.poses, 10)
            self.assertGreater(touched.samples, 3)
            sampled = samples.take(500)
            self.assertTrue((np.diff(sampled.step.astype(np.int64)) > 0).all())
            self.assertEqual(set(sampled.tool), {0})
            self.assertGreater(sampled.felt["force_on_tool_n"][:, 2].max(), 0.0)
            # Each one that comes is newer, and of the whole surface.
            self.assertGreater(next(frames).step, first.step)
            mesh = session.mesh()
            self.assertEqual(mesh["rest_m"].shape[0], np.prod(mesh["grid"]))
            self.assertEqual(first.displacement_m.shape[:2], mesh["grid"])
            self.assertLess(mesh["triangles"].max(), mesh["rest_m"].shape[0])

    def test_a_press_begins_above_the_surface_at_the_height_that_is_given(self):
        flat, organ = palpate.press(0.003, hover_m=0.005), palpate.press(0.003, hover_m=0.005, at_m=(0.01, 0.0, 0.035))
        self.assertTrue(np.allclose(organ.places_m - flat.places_m, (0.01, 0.0, 0.035)))
        self.assertAlmostEqual(organ.places_m[:, 2].min(), 0.032)

    def test_a_press_touches_an_organ_and_one_beside_it_is_warned_of(self):
        with palpate.connect(self.url).create_session("liver-organ") as session:
            status = session.status()
            self.assertEqual(status["top_m"][:2], status["middle_m"][:2])
            self.assertEqual(status["top_m"], palpate.Tissue("liver-organ").top_m)
            self.assertGreater(status["top_m"][2], status["middle_m"][2] + 0.01)
            with self.assertWarnsRegex(RuntimeWarning, "never touched the tissue"):
                session.touch(palpate.press(depth_m=-0.004, seconds=0.5))
            touched = felt(lambda: session.touch(palpate.press(depth_m=0.003, seconds=2.0)))
            np.testing.assert_allclose(touched.place_m[-1], np.add(status["top_m"], (0.0, 0.0, 0.005)), atol=1e-4)

    def test_a_thread_on_a_server_stays_when_its_tool_is_released_and_is_taken_off(self):
        with palpate.connect(self.url).create_session("liver") as session:
            bites_m = [(0.03, 0.03, 0.0), (0.035, 0.034, 0.0), (0.04, 0.03, 0.0)]
            session.thread(3, 7, bites_m, 0.01, friction=0.1)
            session.clip(3, 2, [(0.03, 0.05, 0.0), (0.034, 0.05, 0.0)])

            def until(is_so):
                deadline = time.monotonic() + 60
                while not is_so(session.status()["ties"]):
                    assert time.monotonic() < deadline, session.status()
                    time.sleep(0.02)

            until(lambda ties: sorted(ties) == [2, 7] and ties[7]["path_m"] < 0.0101 and ties[7]["tension_n"] > 1e-3)
            session.release(3)
            status = session.status()
            self.assertEqual((status["pieces"], status["severed"], status["severed_anchors"]), (1, 0, 0))
            self.assertFalse(status["cuts_exhausted"])
            session.untie(4, 7)
            until(lambda ties: sorted(ties) == [2])
            with self.assertRaises(palpate.Refused) as refused:
                session.thread(3, 0, bites_m[:1], 0.01)
            self.assertEqual(refused.exception.field, "tie.bites")

    def test_a_tool_that_is_held_is_refused_at_once(self):
        server = palpate.connect(self.url)
        with server.create_session("paper") as session:
            session.pose(0, (0.05, 0.05, 0.01))
            with self.assertRaises(palpate.Refused) as own:
                session.touch(palpate.press(0.003, seconds=0.5))
            self.assertEqual((own.exception.reason, own.exception.field), ("TOOL_HELD", "tool"))
            self.assertIn("tool 0 is held by this session object", own.exception.message)
            with self.assertRaises(palpate.Refused) as other:
                server.session(session.id).touch(palpate.press(0.003, seconds=0.5))
            self.assertEqual(other.exception.reason, "TOOL_HELD")
            self.assertIn("tool 0 is held by `python`", other.exception.message)
            session.release(0)
            session.touch(palpate.press(-0.004, seconds=0.2), tool=1)

    def test_a_copy_of_the_tissue_is_made_when_it_is_asked_for(self):
        with palpate.connect(self.url).create_session("liver") as session:
            press = palpate.press(depth_m=0.003, seconds=2.0)
            self.assertEqual(session.touch(press).predicted_ticks, 0)
            # A busy machine may have it only when the device's time is over.
            self.assertTrue(any(session.touch(press, prediction="always").predicted_ticks for _ in range(20)))

    def test_a_device_in_python_is_called_by_one_thread_and_left_without_force(self):
        with palpate.connect(self.url).create_session("liver") as session:
            for _ in range(20):
                hand = Hand()
                touched = session.touch(hand, seconds=1.5, remember=False)
                if any(any(force) for force in hand.forces):
                    break
        self.assertEqual(hand.readings + 1, len(hand.forces))
        self.assertGreater(max(force[2] for force in hand.forces), 0.0)
        self.assertEqual(hand.forces[-1], (0.0, 0.0, 0.0))
        self.assertEqual(len(hand.threads), 1)
        self.assertNotEqual(hand.threads, {threading.get_ident()})
        self.assertEqual(len(touched.time_s), 0)

    def test_a_device_of_six_axes_feels_force_and_torque_on_an_instrument(self):
        instrument = palpate.Instrument(jaws_m=0.01, shaft_m=0.012, tip=palpate.Tip(0.004))
        self.assertGreater(instrument.tips, 6)
        with palpate.connect(self.url).create_session("liver") as session:
            for _ in range(20):
                handle = Handle()
                touched = session.touch(handle, seconds=3.0, instrument=instrument)
                if touched.largest_torque_n_m > 1e-3:
                    break
            # What presses the shaft, which lies along -x of the tip, up, turns it about y.
            most = max(handle.torques, key=lambda torque: abs(torque[1]))
            self.assertGreater(most[1], 1e-3)
            self.assertGreater(max(force[2] for force in handle.forces), 0.05)
            self.assertEqual((handle.forces[-1], handle.torques[-1]), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
            self.assertEqual(touched.refused, 0)
            self.assertGreater(touched.predicted_ticks, 0)
            with self.assertRaisesRegex(palpate.Refused, "length is not 1"):
                session.touch(Handle((2.0, 0.0, 0.0, 0.0)), seconds=1.0, instrument=instrument)
        for wrong, names in [({}, "jaws"), ({"jaws_m": -1.0}, "jaws_m"), ({"shaft_m": 0.9}, "tips"), ({"shaft_m": 0.01, "handle_m": 9.0}, "handle_m")]:
            with self.assertRaisesRegex(palpate.Refused, names):
                palpate.Instrument(**wrong)

    def test_two_hands_lead_an_instrument_each_and_serve_once(self):
        instrument = palpate.Instrument(jaws_m=0.012, shaft_m=0.008, tip=palpate.Tip(0.004))

        async def touch_with_both():
            server = await palpate.aio.connect(self.url)
            async with await server.create_session("liver") as session:
                for _ in range(20):
                    hands = palpate.two_hands()
                    # Beside each other: instruments that begin within each other push at once, and forces do not begin.
                    handles = [Handle(aside_m=0.012), Handle((0.0, 0.0, 0.0, 1.0), aside_m=-0.012)]
                    calls = [
                        session.touch(handles[number], seconds=3.0, instrument=instrument, tool=number * instrument.tips, hand=hand)
                        for number, hand in enumerate(hands)
                    ]
                    touched = await asyncio.gather(*calls)
                    if all(max(force[2] for force in handle.forces) > 0.05 for handle in handles):
                        break
                for one, handle in zip(touched, handles):
                    self.assertGreater(one.largest_torque_n_m, 1e-4)
                    self.assertGreater(max(force[2] for force in handle.forces), 0.05)
                with self.assertRaisesRegex(palpate.Refused, "used this hand"):
                    await session.touch(Handle(), seconds=1.0, instrument=instrument, hand=hands[0])
                async with await server.create_session("paper") as other:
                    with self.assertRaisesRegex(palpate.Refused, "another session"):
                        await other.touch(Handle(), seconds=1.0, instrument=instrument, hand=hands[1])

        asyncio.run(touch_with_both())

    def test_an_exception_of_a_device_comes_back_as_itself(self):
        hand = Hand(fails_at=200)
        with palpate.connect(self.url).create_session("liver") as session:
            with self.assertRaisesRegex(OverflowError, "off its hinge"):
                session.touch(hand, seconds=5.0)
        self.assertEqual((hand.readings, hand.forces[-1]), (200, (0.0, 0.0, 0.0)))
        with palpate.connect(self.url).create_session("liver") as session:
            for device in (object(), palpate.Course([[0, 0, float("inf")]]), palpate.Course([[0, 0, 0]], "omega4")):
                with self.assertRaises(palpate.Refused):
                    session.touch(device, seconds=0.1)
            with self.assertRaisesRegex(palpate.Refused, "prediction"):
                session.touch(palpate.press(0.003), prediction="maybe")

    def test_refusals_and_broken_connections_are_told_apart(self):
        server = palpate.connect(self.url)
        for refused, reason in [
            (lambda: server.create_session("no-such-scene"), "UNKNOWN_SCENE"),
            (lambda: server.session("0" * 16), "UNKNOWN_SESSION"),
            (lambda: server.create_session(17), "WRONG_KIND"),
            (lambda: palpate.connect("ftp://here"), "OUT_OF_RANGE"),
        ]:
            with self.assertRaises(palpate.Refused) as raised:
                refused()
            self.assertEqual(raised.exception.reason, reason, raised.exception)
        with self.assertRaises(palpate.Disconnected):
            palpate.connect("http://127.0.0.1:1", within_s=2.0)
        with self.assertRaises(ConnectionError):
            palpate.connect("http://127.0.0.1:1", within_s=2.0)

    def test_a_trainee_does_an_exercise_and_both_see_its_result(self):
        server = palpate.connect(self.url)
        self.assertIn("lumps-1", [exercise["name"] for exercise in server.exercises()])
        with server.create_exercise("lumps-1", seed=7) as session:
            told = session.exercise()
            self.assertEqual((told["role"], told["seed"], told["finished"]), ("trainer", 7, False))
            trainee = server.session(told["trainee_id"])
            known = trainee.exercise()
            self.assertEqual((known["role"], known["seed"], known["trainee_id"]), ("trainee", None, None))
            with self.assertRaises(palpate.Refused) as raised:
                trainee.save()
            self.assertEqual(raised.exception.reason, "NOT_FOR_TRAINEE")
            with server.session(told["trainee_id"]):
                pass  # A trainee leaves; the session stays.
            session.advise("press deeper", place_m=(0.01, 0.0, 0.04))
            lump = {"centre_m": (-0.03, 0.03, 0.027), "radius_m": 0.008, "stiffness_factor": 6.0}
            self.assertEqual({**lump, "step": ANY}, session.hide_lump(**lump))
            with self.assertRaises(palpate.Refused) as raised:
                session.hide_lump(radius_m=0.008)
            self.assertEqual(raised.exception.field, "centre_m")
            live, seen = session.measures(), trainee.measures()
            self.assertEqual(next(seen)["advice"], [{"number": 1, "text": "press deeper", "place_m": (0.01, 0.0, 0.04)}])
            for height_mm in range(43, 34, -1):
                trainee.pose(0, (0.01, 0.0, 1e-3 * height_mm), palpate.Tip(radius_m=0.008))
            trainee.mark(0, (0.01, 0.0, 0.04))
            trainee.release(0)
            result = trainee.finish_exercise()
            moments = list(live)
            self.assertEqual((moments[-1]["result"], moments[-1]["figures"]), (result, result["figures"]))
            self.assertGreater(result["tools"][0]["peak_force_n"], 0.1)
            self.assertEqual((len(result["answers"]), result["answers"][0]["place_m"]), (1, (0.01, 0.0, 0.04)))
            self.assertEqual(result["lumps"][-1], lump)
            self.assertTrue(result["is_told"] and 0.0 <= result["score_percent"] <= 100.0)
            self.assertNotIn("hits", list(seen)[-1]["figures"])
        with server.create_session("paper") as session:
            self.assertIsNone(session.exercise())
            with self.assertRaises(palpate.Refused) as raised:
                session.finish_exercise()
            self.assertEqual(raised.exception.reason, "UNKNOWN_EXERCISE")


class Awaiting(Served, unittest.IsolatedAsyncioTestCase):
    async def test_several_sessions_are_touched_and_watched_at_once(self):
        server = await palpate.aio.connect(self.url)
        self.assertIn("liver", await server.scenes())

        async def one(depth_m):
            async with await server.create_session("liver") as session:
                frames = await session.frames(rate_hz=20)
                touching = asyncio.ensure_future(session.touch(palpate.press(depth_m, seconds=2.0)))
                # The first frame comes at once; others only while something moves.
                first = await frames.__anext__()
                more = asyncio.ensure_future(frames.__anext__())
                touched = await touching
                more.cancel()
                return first.displacement_m.shape, touched

        found = await asyncio.gather(*(one(depth_m) for depth_m in (0.001, 0.004)))
        for shape, touched in found:
            self.assertEqual(shape, (31, 31, 3))
            self.assertIsNone(touched.lost)
            self.assertGreater(len(touched.time_s), 0)
        with self.assertRaises(palpate.Refused):
            await server.session("0" * 16)

    async def test_a_stream_ends_with_its_session_and_a_wait_can_be_cancelled(self):
        server = await palpate.aio.connect(self.url)
        session = await server.create_session("liver", paused=True)
        samples = await session.samples()
        waiting = asyncio.ensure_future(session.hash(at_step=10**6))
        await asyncio.sleep(0.1)
        waiting.cancel()
        with self.assertRaises(asyncio.CancelledError):
            await waiting
        hand = Hand()
        touching = asyncio.ensure_future(session.touch(hand))
        while len(hand.forces) < 50 and not touching.done():
            await asyncio.sleep(0.02)
        touching.cancel()
        with self.assertRaises(asyncio.CancelledError):
            await touching
        while hand.readings == len(hand.forces) or hand.forces[-1] != (0.0, 0.0, 0.0):
            await asyncio.sleep(0.02)
        await session.delete()
        with self.assertRaises(palpate.Refused) as raised:
            async for _ in samples:
                pass
        self.assertEqual(raised.exception.reason, "SESSION_DELETED")


if __name__ == "__main__":
    unittest.main()
