"""The chart of contrib/helm and the version in each package. `make test` builds no package."""

import importlib.util
import json
import re
import unittest

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


if __name__ == "__main__":
    unittest.main()
