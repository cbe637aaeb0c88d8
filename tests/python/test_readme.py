"""What the README tells a newcomer to do, done to the letter with stock grpcio."""

import json
import pathlib
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import unittest

import grpc
from google.protobuf import descriptor_pool, json_format, message_factory
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

from server import ROOT, Server

README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


class FirstClient(unittest.TestCase):
    def test_the_python_client_presses_and_feels_a_force(self):
        (program,) = blocks("python")
        (install,) = [block for block in blocks("sh") if "grpc_tools" in block]
        (compile_protocol,) = [line for line in install.splitlines() if "grpc_tools.protoc" in line]
        with Server() as server, tempfile.TemporaryDirectory() as folder:
            shutil.copytree(ROOT / "proto", pathlib.Path(folder) / "proto")
            # The packages that the README installs are those this test runs on.
            command = compile_protocol.replace("venv/bin/python", shlex.quote(sys.executable))
            subprocess.run(command, shell=True, check=True, cwd=folder)
            program = program.replace("127.0.0.1:7117", server.address)
            ran = subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, timeout=60)
            self.assertEqual(ran.returncode, 0, ran.stderr)
        lines = ran.stdout.splitlines()
        self.assertGreaterEqual(len(lines), 5, ran.stdout)
        depth_m, force_n = (float(re.search(rf"{word} (\S+)", lines[-1])[1]) for word in ("depth", "force"))
        # Half a second of 1 N: the tissue has settled, down and pushing back with nearly all of it.
        self.assertTrue(-0.1 < depth_m < -0.03, lines[-1])
        self.assertTrue(0.9 < force_n < 1.1, lines[-1])

    def test_the_grpcurl_calls_are_answered_by_reflection(self):
        (calls,) = [block for block in blocks("sh") if "grpcurl" in block]
        with Server() as server, grpc.insecure_channel(server.address) as channel:
            reflection = ProtoReflectionDescriptorDatabase(channel)
            pool = descriptor_pool.DescriptorPool(reflection)
            answers = []
            for call in calls.splitlines():
                if call.startswith("#"):
                    continue
                words = shlex.split(call.replace("127.0.0.1:7117", server.address))
                self.assertEqual(words[:2], ["grpcurl", "-plaintext"])
                if words[-1] == "list":
                    services = reflection.get_services()
                    self.assertIn("palpate.v1.SessionService", services)
                    self.assertIn("grpc.health.v1.Health", services)
                    continue
                data = json.loads(words[words.index("-d") + 1]) if "-d" in words else {}
                service, method = words[-1].split("/")
                method = pool.FindServiceByName(service).FindMethodByName(method)
                request = json_format.ParseDict(data, message_factory.GetMessageClass(method.input_type)())
                invoke = channel.unary_unary(
                    f"/{words[-1]}",
                    request_serializer=lambda message: message.SerializeToString(),
                    response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
                )
                answers.append(json_format.MessageToDict(invoke(request), preserving_proto_field_name=True))
        created, listed = answers
        self.assertEqual(created["session"]["scene"]["name"], "paper")
        self.assertEqual(listed["sessions"][0]["session_id"], created["session"]["session_id"])


if __name__ == "__main__":
    unittest.main()
