"""Runs every block of code in README and guide literally, except those that are marked with `not-run: REASON`."""

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

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAM, CLIENT = "target/release/palpate", "target/release/palpate-client"
LANGUAGES = {"", "c", "powershell", "python", "rust", "toml", "sh"}


def blocks():
    """(file, line, language, mark, text) of every fenced block."""
    for path in DOCUMENTS:
        text = path.read_text()
        for match in re.finditer(r"^```(\S*)[ ]*(.*)\n((?:.*\n)*?)```$", text, re.MULTILINE):
            line = text[: match.start()].count("\n") + 1
            yield path.relative_to(ROOT), line, match[1], match[2], match[3]


def run_of(language):
    return [block for block in blocks() if block[2] == language and not block[3].startswith("not-run:")]


class EveryBlock(unittest.TestCase):
    def test_every_block_is_run_or_says_why_not(self):
        for path, line, language, mark, _ in blocks():
            with self.subTest(f"{path}:{line}"):
                self.assertIn(language, LANGUAGES)
                if mark or language in ("c", "powershell", "rust"):
                    self.assertRegex(mark, r"^not-run: \w+", "a mark is `not-run: REASON`")

    def test_the_commands_succeed(self):
        with Server() as server:
            for path, line, _, _, text in run_of("sh"):
                if "grpcurl" in text or "grpc_tools" in text:
                    continue  # FirstClient
                for command in text.splitlines():
                    with self.subTest(f"{path}:{line}: {command}"):
                        self.run_command(command, server)

    def run_command(self, command, server):
        # `make run` builds the same programs into target/quick.
        words = shlex.split(command.replace("target/quick/", "target/release/"), comments=True)
        if not words or words[:2] == [PROGRAM, "serve"]:
            return  # the server runs: `Server` began it by that command
        self.assertIn(words[0], (PROGRAM, CLIENT), "only our programs; mark the block as not run")
        if words[:2] == [CLIENT, "replay"]:
            words += ["--server", server.url]
        ran = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
        self.assertEqual(ran.returncode, 0, ran.stderr)

    def test_scenes_and_scripts_are_as_described(self):
        files = {"[sheet]": "scene.toml", "duration_s": "script.toml"}
        with tempfile.TemporaryDirectory() as folder:
            found = {}
            for path, line, _, _, text in run_of("toml"):
                (name,) = [name for key, name in files.items() if key in text] or [None]
                if name:
                    found[name] = pathlib.Path(folder) / name
                    found[name].write_text(text)
            self.assertEqual(set(found), set(files.values()))
            command = [PROGRAM, "run", found["scene.toml"], found["script.toml"]]
            ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
            self.assertEqual(ran.returncode, 0, ran.stderr)


def anchors(path):
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


class Links(unittest.TestCase):
    def test_every_link_leads_to_a_file_and_a_heading(self):
        folders = ("docs/**/*.md", "clients/*/README.md", "clients/*/*/README.md", "contrib/**/*.md")
        top = (ROOT / name for name in ("ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md"))
        pages = {*DOCUMENTS, *top, *(page for folder in folders for page in ROOT.glob(folder))}
        for page in sorted(page for page in pages if "node_modules" not in page.parts):
            for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
                with self.subTest(f"{page.relative_to(ROOT)}: {link}"):
                    name, _, anchor = link.partition("#")
                    target = page.parent / name if name else page
                    self.assertTrue(name.startswith("http") or target.exists())
                    if anchor and target.suffix == ".md":
                        self.assertIn(anchor, anchors(target))


class FirstClient(unittest.TestCase):
    def test_the_python_client_presses_feels_a_force_and_sees_the_surface(self):
        # Those of the package palpate are run by clients/python/tests.
        ((*_, program),) = [block for block in run_of("python") if "import grpc" in block[-1]]
        (install,) = [block[-1] for block in run_of("sh") if "grpc_tools" in block[-1]]
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
        self.assertGreaterEqual(len(lines), 6, ran.stdout)
        depth_m, force_n = (float(re.search(rf"{word} (\S+)", lines[-2])[1]) for word in ("depth", "force"))
        # Liver under a fingertip that has come to rest 3 mm deep, by some 70 N/m.
        self.assertTrue(-0.0032 < depth_m < -0.0028, lines[-2])
        self.assertTrue(0.15 < force_n < 0.35, lines[-2])
        # The point under its middle is deeper than the mean over it.
        x, y, deepest_m = re.search(r"frame of (\d+) x (\d+) vertices, the deepest at (\S+) m", lines[-1]).groups()
        self.assertEqual((x, y), ("31", "31"))
        self.assertTrue(-0.005 < float(deepest_m) < -0.003, lines[-1])

    def test_the_grpcurl_calls_are_answered_by_reflection(self):
        (calls,) = [block[-1] for block in run_of("sh") if "grpcurl" in block[-1]]
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
