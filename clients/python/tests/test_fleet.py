"""A session of a real fleet that moves, and one whose server dies: Python goes on where the session is."""

import asyncio
import unittest

import numpy as np

import palpate
from fleet import Fleet, needs_etcd


class Follows(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        needs_etcd()

    def test_calls_streams_and_tools_go_on_where_a_session_has_moved(self):
        with Fleet() as fleet:
            # Either may be asked, and either may make it.
            session = palpate.connect(fleet.urls["a"]).create_session("liver")
            other = palpate.connect(fleet.urls["b"]).session(session.id)
            self.assertEqual(other.server, session.server)
            middle_m = np.array(session.status()["middle_m"])
            session.pose(0, middle_m - (0, 0, 0.002))
            samples, frames = other.samples(), other.frames(rate_hz=30)
            next(frames)
            felt = lambda sample: 0 in sample["tools"] and sample["tools"][0]["force_on_tool_n"][2] > 0.05
            before = next(sample for sample in samples if felt(sample))
            for _ in range(2):
                url = fleet.move(session)
                status = session.status()
                self.assertEqual(session.server, url)
                # The tool is still in the tissue, and its holder the same.
                self.assertEqual(status["held_tools"], [(0, "python")])
                after = next(sample for sample in samples if sample["step"] >= status["step"])
                self.assertTrue(felt(after), after)
                self.assertGreater(after["step"], before["step"])
                self.assertEqual(other.server, url)
                session.pose(0, middle_m - (0, 0, 0.0025))
                session.change(stiffness_n_per_m=25.0)
                # Frames that were on their way are of before.
                next(frame for frame in frames if frame.step > after["step"])
                before = after
            session.pause()
            step, digest = other.hash()
            # What was made of an earlier object too.
            self.assertEqual(session.hash(), (step, digest))
            session.release(0)
            other.delete()
            for gone in (session, other):
                with self.assertRaises(palpate.Refused) as raised:
                    gone.status()
                self.assertEqual(raised.exception.reason, "UNKNOWN_SESSION")
            with self.assertRaises(palpate.Refused):
                list(samples)

    def test_a_touch_goes_on_at_the_server_that_takes_over_from_a_dead_one(self):
        with Fleet() as fleet:
            client = palpate.connect(fleet.urls["a"])
            session = client.create_session("liver")
            session.push(1, (0.0, 0.0, -0.1), point=(5, 5))
            fleet.until_stood_by(session)
            dead = fleet.name_of(session)
            samples = session.samples()
            step = next(samples)["step"]
            fleet.kill(dead)
            # Another server reports it, and a tool is acquired once more: its lease has ended with the server.
            session.push(1, (0.0, 0.0, -0.2), point=(5, 5))
            self.assertNotEqual(fleet.name_of(session), dead)
            self.assertEqual(session.status()["held_tools"], [(1, "python")])
            sampled = samples.take(200)
            self.assertGreater(sampled.step[-1], step)
            touched = session.touch(palpate.press(depth_m=0.003, seconds=3.0))
            self.assertEqual((touched.connections, touched.lost), (1, None))

    def test_where_all_servers_are_gone_there_is_no_connection(self):
        with Fleet() as fleet:
            session = palpate.connect(fleet.urls["a"], within_s=2.0).create_session("paper")
            for name in ("a", "b"):
                fleet.kill(name)
            with self.assertRaises(palpate.Disconnected):
                session.status()


class FollowsAwaited(unittest.IsolatedAsyncioTestCase):
    @classmethod
    def setUpClass(cls):
        needs_etcd()

    async def test_what_is_awaited_goes_on_where_a_session_has_moved(self):
        with Fleet() as fleet:
            server = await palpate.aio.connect(fleet.urls["b"])
            async with await server.create_session("liver") as session:
                await session.pose(0, (0.0375, 0.0375, -0.002))
                samples = await session.samples()
                first = await samples.__anext__()
                url = await asyncio.to_thread(fleet.move, session)
                # Nobody has called yet: the stream finds the way.
                async for sample in samples:
                    if sample["step"] > first["step"] + 50 and session.server == url:
                        break
                self.assertEqual((await session.status())["held_tools"], [(0, "python")])
                await session.pose(0, (0.0375, 0.0375, -0.003))


if __name__ == "__main__":
    unittest.main()
