"""The manifests and alerts of contrib/: by the published schemas, and what must agree between their parts. No cluster is needed."""

import os
import re
import shutil
import subprocess
import tempfile
import unittest

import jsonschema
import kubernetes_validate
import yaml

from server import ROOT

FOLDER = ROOT / "contrib" / "kubernetes"
# The oldest version that the README names, and the newest that the package knows.
VERSIONS = ("1.30", "1.37")
AGONES = ("agones.dev/v1", "autoscaling.agones.dev/v1")


def read(name):
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return [document for document in yaml.load_all((FOLDER / name).read_text(), loader) if document is not None]


def closed(required=(), **properties):
    return {"type": "object", "required": list(required), "properties": properties, "additionalProperties": False}


# Of the schemas in Agones' CRDs (install/helm/agones/templates/crds, release 1.57) the fields that are used here, written down because
# no package has them. Kubernetes drops unknown fields silently; here they are refused. The template of the pod is checked as
# Kubernetes' own.
COUNT = {"type": "integer", "minimum": 0}
TEXT = {"type": "string"}
METADATA = closed(name=TEXT, namespace=TEXT, labels={"type": "object", "additionalProperties": TEXT})
GAME_SERVER = closed(
    ["template"],
    container={"type": "string", "maxLength": 63, "pattern": "^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"},
    health=closed(
        disabled={"type": "boolean"},
        initialDelaySeconds=COUNT,
        periodSeconds=COUNT,
        failureThreshold={"type": "integer", "minimum": 1},
    ),
    eviction=closed(safe={"enum": ["Always", "OnUpgrade", "Never"]}),
    counters={"type": "object", "maxProperties": 1000, "additionalProperties": closed(count=COUNT, capacity=COUNT)},
    sdkServer=closed(grpcPort={"type": "integer", "minimum": 1, "maximum": 65535}, logLevel=TEXT),
    template={"type": "object", "required": ["spec"]},
)
SHARE = {"anyOf": [{"type": "integer"}, {"type": "string"}]}
FLEET = closed(
    ["template"],
    replicas=COUNT,
    scheduling={"enum": ["Packed", "Distributed"]},
    strategy=closed(
        type={"enum": ["Recreate", "RollingUpdate"]}, rollingUpdate=closed(maxSurge=SHARE, maxUnavailable=SHARE)
    ),
    template=closed(["spec"], metadata=METADATA, spec=GAME_SERVER),
)
AUTOSCALER = closed(
    ["fleetName", "policy"],
    fleetName={"type": "string", "minLength": 1, "maxLength": 63},
    policy=closed(
        ["type", "counter"],
        type={"const": "Counter"},
        counter=closed(
            ["key", "bufferSize", "maxCapacity"],
            key=TEXT,
            bufferSize=SHARE,
            minCapacity=COUNT,
            maxCapacity={"type": "integer", "minimum": 1},
        ),
    ),
    sync=closed(
        ["type"],
        type={"const": "FixedInterval"},
        fixedInterval=closed(["seconds"], seconds={"type": "integer", "exclusiveMinimum": 0}),
    ),
)
SPECS = {"Fleet": FLEET, "FleetAutoscaler": AUTOSCALER}

# https://prometheus.io/docs/prometheus/latest/configuration/alerting_rules
DURATION = {"type": "string", "pattern": "^([0-9]+(ms|s|m|h|d|w|y))+$"}
TEXTS = {"type": "object", "additionalProperties": TEXT}
RULE = closed(["alert", "expr"], alert=TEXT, expr=TEXT, labels=TEXTS, annotations=TEXTS, **{"for": DURATION})
GROUP = closed(["name", "rules"], name=TEXT, rules={"type": "array", "items": RULE}, interval=DURATION)
RULES = closed(["groups"], groups={"type": "array", "items": GROUP})


def pods(documents):
    """The spec of each kind's pods, with their labels."""
    for document in documents:
        if document["kind"] == "StatefulSet":
            template = document["spec"]["template"]
        elif document["kind"] == "Fleet":
            template = document["spec"]["template"]["spec"]["template"]
        else:
            continue
        yield document, template["metadata"]["labels"], template["spec"]


class Manifests(unittest.TestCase):
    def test_kubernetes_takes_them(self):
        checked = 0
        for name in ("etcd.yaml", "palpate.yaml", "agones.yaml"):
            for document in read(name):
                with self.subTest(f"{name}: {document['kind']}"):
                    if document["apiVersion"] in AGONES:
                        jsonschema.validate(document["metadata"], METADATA)
                        jsonschema.validate(document["spec"], SPECS[document["kind"]])
                        if document["kind"] != "Fleet":
                            continue
                        pod = document["spec"]["template"]["spec"]["template"]
                        document = {"apiVersion": "v1", "kind": "Pod", **pod}
                    for version in VERSIONS:
                        kubernetes_validate.validate(document, version, strict=True)
                        checked += 1
        self.assertGreater(checked, 20)

    def test_a_mistake_is_found(self):
        (fleet, autoscaler) = read("agones.yaml")
        fleet["spec"]["template"]["spec"]["counters"]["sessions"]["capacity"] = "70"
        autoscaler["spec"]["policy"]["counter"]["buffer"] = autoscaler["spec"]["policy"]["counter"].pop("bufferSize")
        for document in (fleet, autoscaler):
            with self.assertRaises(jsonschema.ValidationError):
                jsonschema.validate(document["spec"], SPECS[document["kind"]])
        (stateful,) = [document for document in read("palpate.yaml") if document["kind"] == "StatefulSet"]
        stateful["spec"]["template"]["spec"]["containers"][0]["imagePullPolice"] = "Always"
        with self.assertRaises(kubernetes_validate.ValidationError):
            kubernetes_validate.validate(stateful, VERSIONS[0], strict=True)

    def test_what_is_named_is_there(self):
        documents = [document for name in ("etcd.yaml", "palpate.yaml", "agones.yaml") for document in read(name)]
        there = {(document["kind"], document["metadata"]["name"]) for document in documents}
        self.assertEqual({document["metadata"]["namespace"] for document in documents}, {"palpate"})
        labels = {tuple(labels.items()) for _, labels, _ in pods(documents)}
        services = {}
        for document in documents:
            spec = document.get("spec", {})
            if document["kind"] == "Service":
                self.assertIn(tuple(spec["selector"].items()), labels)
                services[document["metadata"]["name"]] = {port["port"] for port in spec["ports"]}
            elif document["kind"] == "PodDisruptionBudget":
                self.assertIn(tuple(spec["selector"]["matchLabels"].items()), labels)
            elif document["kind"] == "HorizontalPodAutoscaler":
                self.assertIn((spec["scaleTargetRef"]["kind"], spec["scaleTargetRef"]["name"]), there)
            elif document["kind"] == "FleetAutoscaler":
                self.assertIn(("Fleet", spec["fleetName"]), there)
        secrets = set(re.findall(r"create secret generic (\S+)", (FOLDER / "README.md").read_text()))
        for document, labels_of_pod, spec in pods(documents):
            with self.subTest(document["kind"] + " " + document["metadata"]["name"]):
                if document["kind"] == "StatefulSet":
                    self.assertEqual(document["spec"]["selector"]["matchLabels"], labels_of_pod)
                    self.assertIn(("Service", document["spec"]["serviceName"]), there)
                volumes = {volume["name"] for volume in spec.get("volumes", [])}
                volumes |= {claim["metadata"]["name"] for claim in document["spec"].get("volumeClaimTemplates", [])}
                for volume in spec["volumes"]:
                    if "secret" in volume:
                        self.assertIn(volume["secret"]["secretName"], secrets)
                    elif "configMap" in volume:
                        self.assertIn(("ConfigMap", volume["configMap"]["name"]), there)
                for container in spec.get("initContainers", []) + spec["containers"]:
                    mounts = {mount["mountPath"]: mount["name"] for mount in container.get("volumeMounts", [])}
                    self.assertLessEqual(set(mounts.values()), volumes)
                    names = {variable["name"] for variable in container.get("env", [])}
                    words = [*container.get("command", []), *container.get("args", [])]
                    for name in re.findall(r"\$\((\w+)\)", " ".join(words)):
                        self.assertIn(name, names)
                    # Files of options are in a volume.
                    for path in re.findall(r"=(/\S+)", " ".join(words)):
                        self.assertTrue(any(path.startswith(mount) for mount in mounts), path)
        # etcd is asked under its members' names.
        (asked,) = [
            word for _, _, spec in pods(read("palpate.yaml")) for word in spec["containers"][0]["args"] if "--cluster=" in word
        ]
        for url in asked.split("=")[1].split(","):
            host, port = re.fullmatch(r"https://etcd-[0-2]\.(\w+)\.palpate\.svc\.cluster\.local:(\d+)", url).groups()
            self.assertIn(int(port), services[host])

    def test_both_fleets_are_of_the_same_servers(self):
        served = []
        for name in ("palpate.yaml", "agones.yaml"):
            ((_, _, spec),) = pods(read(name))
            container = spec["containers"][0]
            words = " ".join(container["args"]).split("palpate serve")[-1]
            options = dict(re.findall(r"--([\w-]+)=?(\S*)", words))
            # The drain finishes within the time that it is given.
            self.assertGreaterEqual(spec["terminationGracePeriodSeconds"], 300)
            self.assertIn('palpate cluster drain "$POD"', container["lifecycle"]["preStop"]["exec"]["command"][-1])
            served.append(options)
        own = ("agones", "node", "advertise", "datagrams-advertise")
        plain, agones = ({name: value for name, value in options.items() if name not in own} for options in served)
        self.assertEqual(plain, agones)
        self.assertIn("agones", served[1])
        # The counter that the server counts.
        fleet, autoscaler = read("agones.yaml")
        for key in (*fleet["spec"]["template"]["spec"]["counters"], autoscaler["spec"]["policy"]["counter"]["key"]):
            self.assertEqual(key, "sessions")


@unittest.skipUnless(shutil.which("openssl"), "there is no openssl")
class Certificates(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.keys = folder.name
        script = ["sh", FOLDER / "certificates.sh", cls.keys]
        subprocess.run(script, check=True, env={**os.environ, "DOMAIN": "palpate.example.org"})
        subprocess.run([*script, "client", "bench-1.palpate"], check=True)

    def test_they_are_of_the_names_that_the_manifests_use(self):
        tokens = (FOLDER / "tokens.toml").read_text()
        for authority, name, hosts in (
            ("palpate", "node", ["palpate-7.palpate.palpate.svc.cluster.local", "palpate-entry.palpate.svc", "localhost"]),
            ("palpate", "node", ["node.palpate", "palpate-7.palpate.example.org"]),
            ("etcd", "member", [f"etcd-{member}.etcd.palpate.svc.cluster.local" for member in range(3)]),
            ("etcd", "etcd-client", ["palpate"]),
            ("palpate", "client-bench-1.palpate", ["bench-1.palpate"]),
        ):
            for host in hosts:
                verify = ["openssl", "verify", "-CAfile", f"{self.keys}/{authority}-ca.crt", "-verify_hostname", host]
                subprocess.run([*verify, f"{self.keys}/{name}.crt"], check=True, capture_output=True)
        for name in ("node.palpate", "bench-1.palpate", "operator.palpate"):
            self.assertIn(f'name = "{name}"', tokens)
        # Files of the README's secrets.
        for path in re.findall(r"keys/([\w.-]+)", (FOLDER / "README.md").read_text()):
            self.assertTrue("operator" in path or os.path.exists(f"{self.keys}/{path}"), path)

    def test_the_server_takes_its_arguments_and_its_configuration(self):
        documents = read("palpate.yaml")
        ((_, _, spec),) = pods(documents)
        (config,) = [document["data"]["palpate.toml"] for document in documents if document["kind"] == "ConfigMap"]
        with tempfile.TemporaryDirectory() as folder:
            for name, authority, certificate in (("tls", "palpate", "node"), ("etcd", "etcd", "etcd-client")):
                os.mkdir(f"{folder}/{name}")
                shutil.copy(f"{self.keys}/{authority}-ca.crt", f"{folder}/{name}/ca.crt")
                for end in ("crt", "key"):
                    shutil.copy(f"{self.keys}/{certificate}.{end}", f"{folder}/{name}/tls.{end}")
            for name in ("tokens", "config", "journals"):
                os.mkdir(f"{folder}/{name}")
            shutil.copy(FOLDER / "tokens.toml", f"{folder}/tokens/tokens.toml")
            with open(f"{folder}/config/palpate.toml", "w") as file:
                file.write(config.replace("/etc/palpate", folder))
            # Its own address, and no etcd: that is what it must complain of.
            other = {
                "--listen": "127.0.0.1:0",
                "--metrics": "127.0.0.1:0",
                "--journal": f"{folder}/journals",
                "--cluster": "https://127.0.0.1:1",
            }
            words = []
            for word in spec["containers"][0]["args"]:
                option, has_value, value = word.partition("=")
                value = other.get(option, value.replace("/etc/palpate", folder))
                value = value.replace("$(POD)", "palpate-0").replace("$(DOMAIN)", "palpate.palpate.svc.cluster.local")
                words.append(option + has_value + value)
            program = [ROOT / "target" / "release" / "palpate", *words]
            ran = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=60)
        self.assertEqual(ran.returncode, 2, ran.stderr)
        self.assertIn("cluster.etcd: no member of etcd can grant a lease", ran.stderr)


class Alerts(unittest.TestCase):
    def test_prometheus_takes_them(self):
        rules = yaml.safe_load((ROOT / "contrib" / "prometheus-rules.yaml").read_text())
        jsonschema.validate(rules, RULES)
        alerts = [rule for group in rules["groups"] for rule in group["rules"]]
        names = [rule["alert"] for rule in alerts]
        self.assertEqual(len(names), len(set(names)))
        told = (FOLDER / "README.md").read_text()
        functions = {"and", "or", "unless", "avg", "increase", "max", "max_over_time", "min", "rate", "sum"}
        for rule in alerts:
            with self.subTest(rule["alert"]):
                self.assertIn(f"`{rule['alert']}`", told, "the README says what to do")
                self.assertLessEqual({"summary", "description"}, set(rule["annotations"]))
                expression = rule["expr"]
                for opening, closing in ("()", "[]", "{}"):
                    self.assertEqual(expression.count(opening), expression.count(closing))
                # Known metrics and functions; src/server/metrics.rs compares the metrics with those that it defines.
                for word in re.findall(r"[a-zA-Z_]\w*", re.sub(r"\[\w+\]", "", expression)):
                    self.assertTrue(word in functions or word.startswith("palpate_"), word)


if __name__ == "__main__":
    unittest.main()
