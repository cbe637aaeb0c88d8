"""The chart of contrib/helm, the version in each package, and the archives that Python packs. `make test` builds no package."""

import base64
import hashlib
import importlib.util
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import unittest
import zipfile

import kubernetes_validate

from server import ROOT
from test_kubernetes import VERSIONS, read


def load(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "contrib" / "packages" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def keyed(documents):
    return {(document["kind"], document["metadata"]["name"]): document for document in documents}


class Chart(unittest.TestCase):
    helm = load("helm")

    def test_the_defaults_give_the_plain_manifests(self):
        rendered, plain = keyed(self.helm.manifests()[0]), keyed(read("palpate.yaml"))
        self.assertEqual(rendered.keys(), plain.keys())
        # The manifest leaves this to Kubernetes, with the same effect for a tag that is not `latest`.
        (server, _) = rendered["StatefulSet", "palpate"]["spec"]["template"]["spec"]["containers"]
        self.assertEqual(server.pop("imagePullPolicy"), "IfNotPresent")
        for key, document in plain.items():
            with self.subTest(key):
                self.assertEqual(rendered[key], document)

    def test_other_values_give_valid_manifests(self):
        others = {
            "cluster.etcd": [],
            "autoscaling.enabled": False,
            "replicas": 1,
            "journal.storageClass": "fast",
            "image.repository": "registry.example/palpate",
            "image.tag": "0.2.0",
            "domain": "palpate.example.org",
        }
        for changes in ({}, others):
            documents, notes = self.helm.manifests(**changes)
            self.assertNotIn("{{", notes)
            for document in documents:
                for version in VERSIONS:
                    with self.subTest(f"{document['kind']} {version} {bool(changes)}"):
                        kubernetes_validate.validate(document, version, strict=True)
        one = keyed(documents)
        self.assertNotIn(("HorizontalPodAutoscaler", "palpate"), one)
        servers = one["StatefulSet", "palpate"]["spec"]
        self.assertEqual(servers["replicas"], 1)
        text = str(one)
        self.assertNotIn("etcd", text)
        self.assertIn("registry.example/palpate:0.2.0", text)


class Version(unittest.TestCase):
    def test_files_that_have_a_version_have_that_of_cargo(self):
        version = re.search(r'\[workspace\.package\]\s+version = "(.*?)"', (ROOT / "Cargo.toml").read_text())[1]
        for name in ("clients/typescript/package.json", "clients/csharp/unity/package.json"):
            with self.subTest(name):
                self.assertEqual(json.loads((ROOT / name).read_text())["version"], version)
        chart = (ROOT / "contrib" / "helm" / "palpate" / "Chart.yaml").read_text()
        self.assertEqual(re.findall(r"^(?:appVersion|version): (.*)$", chart, re.MULTILINE), [version, version])


def pack(script, *arguments):
    """Runs a script of contrib/packages, with a fixed time, and returns what it prints."""
    command = [sys.executable, ROOT / "contrib" / "packages" / script, *arguments]
    environment = dict(os.environ, SOURCE_DATE_EPOCH="1700000000")
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()


class Archives(unittest.TestCase):
    @unittest.skipIf(sys.version_info < (3, 11), "wheel.py needs tomllib")
    def test_a_wheel_has_the_module_of_its_system_and_a_true_record(self):
        modules = {"manylinux_2_34_x86_64": "_native.abi3.so", "win_amd64": "_native.pyd"}
        for platform, module in modules.items():
            with self.subTest(platform), tempfile.TemporaryDirectory() as folder:
                folder = pathlib.Path(folder)
                (folder / module).write_bytes(b"a module")
                (folder / "licences").mkdir()
                (folder / "licences" / "LICENSE-MIT").write_text("a licence")
                wheel = pack("wheel.py", "1.2.3", platform, folder / module, folder / "licences", folder)
                self.assertEqual(pathlib.Path(wheel).name, f"palpate-1.2.3-cp39-abi3-{platform}.whl")
                with zipfile.ZipFile(wheel) as archive:
                    names = archive.namelist()
                    natives = [name for name in names if pathlib.Path(name).suffix in (".so", ".pyd")]
                    self.assertEqual(natives, [f"palpate/{module}"])
                    self.assertIn("palpate/__init__.py", names)
                    self.assertIn(f"Tag: cp39-abi3-{platform}\n", archive.read("palpate-1.2.3.dist-info/WHEEL").decode())
                    record = archive.read("palpate-1.2.3.dist-info/RECORD").decode().splitlines()
                    self.assertEqual([line.split(",")[0] for line in record], names)
                    for line in record[:-1]:
                        name, digest, size = line.split(",")
                        content = archive.read(name)
                        own = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
                        self.assertEqual((digest, size), (f"sha256={own}", str(len(content))), name)

    def test_the_same_files_give_the_same_archive(self):
        with tempfile.TemporaryDirectory() as folder:
            folder = pathlib.Path(folder)
            (folder / "package" / "bin").mkdir(parents=True)
            (folder / "package" / "bin" / "palpate.dll").write_bytes(b"a library")
            (folder / "package" / "palpate.h").write_text("a header")
            pack("zip.py", folder, "package", folder / "a.zip")
            os.utime(folder / "package" / "palpate.h", (0, 0))
            pack("zip.py", folder, "package", folder / "b.zip")
            self.assertEqual((folder / "a.zip").read_bytes(), (folder / "b.zip").read_bytes())
            with zipfile.ZipFile(folder / "a.zip") as archive:
                self.assertEqual(archive.namelist(), ["package/bin/palpate.dll", "package/palpate.h"])


class Unity(unittest.TestCase):
    def complete(self, folder):
        """Fills the folder of a package as unity.sh does, with files in place of libraries."""
        source = ROOT / "clients" / "csharp"
        package = folder / "package"
        shutil.copytree(source / "unity", package)
        shutil.copy(source / "Palpate.cs", package / "Runtime")
        plugins = package / "Plugins" / "x86_64"
        plugins.mkdir(parents=True)
        for library in ("libpalpate.so", "palpate.dll"):
            (plugins / library).write_bytes(b"a library")
        for name in ("LICENSE.md", "CHANGELOG.md"):
            (package / name).write_text("a text")
        pack("unity.py", "complete", package, "1.2.3")
        return package

    def test_each_system_loads_its_own_library(self):
        with tempfile.TemporaryDirectory() as folder:
            plugins = self.complete(pathlib.Path(folder)) / "Plugins" / "x86_64"
            for library, system, player in (("libpalpate.so", "Linux", "Linux64"), ("palpate.dll", "Windows", "Win64")):
                meta = (plugins / f"{library}.meta").read_text()
                self.assertEqual(re.findall(r"OS: (\w+)|Standalone: (\w+)", meta), [(system, ""), ("", player)], library)

    def test_the_sample_scene_refers_to_what_is_there(self):
        with tempfile.TemporaryDirectory() as folder:
            package = self.complete(pathlib.Path(folder))
            sample = package / "Samples~" / "Touch"
            guid = re.search(r"^guid: (\w+)$", (sample / "TouchSample.cs.meta").read_text(), re.MULTILINE)[1]
            scene = (sample / "Touch.unity").read_text()
            self.assertIn(f"guid: {guid}", scene)
            for now, then, wrong in ((guid, "0" * 32, "asset"), ("fileID: 302}", "fileID: 303}", "object 303")):
                (sample / "Touch.unity").write_text(scene.replace(now, then))
                with self.assertRaises(subprocess.CalledProcessError) as refused:
                    pack("unity.py", "check", package)
                self.assertIn(wrong, refused.exception.stderr)


if __name__ == "__main__":
    unittest.main()
