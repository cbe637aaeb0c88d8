"""Journals open in the stock readers of MCAP, schema by schema."""

import pathlib
import struct
import subprocess
import tempfile
import unittest

from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from server import PROGRAM, ROOT

GOLDEN = ROOT / "tests/journal/golden.6.mcap"
MESSAGES = {
    "/header": "Header",
    "/inputs": "Inputs",
    "/hashes": "Hash",
    "/snapshots": "Snapshot",
    "/felt": "Felt",
    "/waiting": "Waiting",
    "/end": "End",
}


def read(path):
    """(schema, topic, message) of each message, and the summary."""
    with open(path, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        found = [
            (schema.name, channel.topic, message)
            for schema, channel, _, message in reader.iter_decoded_messages(log_time_order=False)
        ]
    return found, summary


class Journals(unittest.TestCase):
    def test_every_message_is_decoded_by_its_own_schema(self):
        found, summary = read(GOLDEN)
        self.assertEqual(summary.statistics.message_count, len(found))
        self.assertEqual({channel.topic for channel in summary.channels.values()}, set(MESSAGES))
        for schema, topic, _ in found:
            self.assertEqual(schema, f"palpate.journal.v1.{MESSAGES[topic]}")
        of = lambda topic: [message for _, other, message in found if other == topic]
        (header,) = of("/header")
        self.assertEqual((header.session_id, header.scene.name, header.rate_hz), ("0123456789abcdef", "paper", 1000.0))
        inputs = of("/inputs")
        self.assertEqual([batch.batch for batch in inputs], list(range(len(inputs))))
        self.assertEqual(inputs[-1].until_step, 1000)
        steps = [one.step for batch in inputs for one in batch.inputs]
        self.assertEqual(steps, sorted(steps))
        self.assertEqual(len(steps), 10 + 5 * 151)
        moments = [moment for felt in of("/felt") for moment in felt.moments]
        self.assertEqual(len(moments), 100)
        self.assertGreater(max(tool.force_n.z for moment in moments for tool in moment.tools), 0.0)
        self.assertEqual([end.message for end in of("/end")], ["the server ended"])

    def test_an_unfinished_file_is_read_as_a_stream(self):
        whole = GOLDEN.read_bytes()
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "torn.1.mcap"
            path.write_bytes(whole[: len(whole) // 2])
            chunks = 0
            with open(path, "rb") as stream:
                try:
                    for record in StreamReader(stream, emit_chunks=True).records:
                        chunks += type(record).__name__ == "Chunk"
                except Exception:
                    pass
            self.assertGreater(chunks, 10)
            finished = pathlib.Path(folder) / "whole.1.mcap"
            subprocess.run([PROGRAM, "journal", "recover", path, "--output", finished], check=True, capture_output=True)
            found, summary = read(finished)
            self.assertEqual(summary.statistics.message_count, len(found))
            self.assertEqual(found[-1][1], "/end")

    def test_the_export_keeps_to_the_conventions_of_foxglove(self):
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "foxglove.mcap"
            command = [PROGRAM, "journal", "export", GOLDEN, "--format", "mcap", "--output", path]
            subprocess.run(command, check=True, capture_output=True)
            found, _ = read(path)
        clouds = [message for schema, topic, message in found if (schema, topic) == ("foxglove.PointCloud", "/surface")]
        curves = [message for _, topic, message in found if topic == "/tool/0"]
        tissue = [message for _, topic, message in found if topic == "/tissue"]
        self.assertGreater(len(clouds), 25)
        self.assertGreater(len(curves), 90)
        self.assertGreater(len(tissue), 90)
        cloud = clouds[5]
        self.assertEqual((cloud.point_stride, len(cloud.data), cloud.frame_id), (16, 16 * 49, "tissue"))
        self.assertEqual([(field.name, field.offset, field.type) for field in cloud.fields],
                         [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("displacement_m", 12, 7)])
        x, y, z, far = struct.unpack_from("<4f", cloud.data, 16 * 24)
        self.assertLess(z, 0.0)
        self.assertGreaterEqual(far, abs(z) * 0.999)
        self.assertTrue(any(curve.force_magnitude_n > 0.0 for curve in curves))
        self.assertTrue(any(energy.spring_j > 0.0 for energy in tissue))


if __name__ == "__main__":
    unittest.main()
