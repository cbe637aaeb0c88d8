"""Writes and checks a container image: an OCI layout, with the manifest.json that `docker load` reads.

    image.py write ROOT VERSION ARCHITECTURE FILE     the image of the folder ROOT
    image.py check FILE                               JSON, digests and sizes; exit status 1 if one is wrong
    image.py unpack FILE ROOT                         the files of its layers
"""

import gzip
import hashlib
import io
import json
import os
import sys
import tarfile
from datetime import datetime, timezone
from pathlib import Path

EPOCH = int(os.environ.get("SOURCE_DATE_EPOCH", 0))
OCI = "application/vnd.oci.image"
# As in contrib/Dockerfile.
RUN = {
    "User": "65532:65532",
    "Env": ["PATH=/usr/local/bin", "SSL_CERT_FILE=/etc/ssl/certs/ca-certificates.crt"],
    "WorkingDir": "/usr/local/share/palpate",
    "ExposedPorts": {"7117/tcp": {}, "7117/udp": {}},
    "StopSignal": "SIGTERM",
    "Entrypoint": ["palpate"],
    "Cmd": ["serve", "--listen", "0.0.0.0:7117", "--tls-cert", "/etc/palpate/server.pem",
            "--tls-key", "/etc/palpate/server.key", "--tokens", "/etc/palpate/tokens.toml"],
    # docker's own; OCI has none.
    "Healthcheck": {
        "Test": ["CMD", "palpate-client", "health", "https://localhost:7117", "--ca", "/etc/palpate/ca.pem"],
        "Interval": 10_000_000_000, "Timeout": 3_000_000_000, "StartPeriod": 5_000_000_000,
    },
}


def add(archive, entry, content=None):
    entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname = EPOCH, 0, 0, "", ""
    archive.addfile(entry, io.BytesIO(content) if content is not None else None)


def layer(root):
    """Returns the tar of a folder: sorted, owned by root, all times alike."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.GNU_FORMAT) as archive:
        for path in sorted(root.rglob("*")):
            entry = archive.gettarinfo(path, str(path.relative_to(root)))
            add(archive, entry, path.read_bytes() if entry.isreg() else None)
    return buffer.getvalue()


def digest(content):
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def write(root, version, architecture, file):
    blobs = {}

    def blob(kind, content):
        content = content if isinstance(content, bytes) else json.dumps(content, indent=1).encode()
        name = digest(content)
        blobs[f"blobs/{name.replace(':', '/')}"] = content
        return {"mediaType": kind, "digest": name, "size": len(content)}

    plain = layer(Path(root))
    created = datetime.fromtimestamp(EPOCH, timezone.utc).isoformat().replace("+00:00", "Z")
    packed = blob(f"{OCI}.layer.v1.tar+gzip", gzip.compress(plain, 9, mtime=0))
    config = blob(f"{OCI}.config.v1+json", {
        "created": created, "architecture": architecture, "os": "linux", "config": RUN,
        "rootfs": {"type": "layers", "diff_ids": [digest(plain)]},
        "history": [{"created": created, "comment": "contrib/packages/image.sh"}],
    })
    manifest = blob(f"{OCI}.manifest.v1+json", {
        "schemaVersion": 2, "mediaType": f"{OCI}.manifest.v1+json", "config": config, "layers": [packed],
        "annotations": {
            "org.opencontainers.image.title": "palpate",
            "org.opencontainers.image.version": version,
            "org.opencontainers.image.licenses": "MIT OR Apache-2.0",
        },
    })
    manifest |= {
        "platform": {"architecture": architecture, "os": "linux"},
        "annotations": {"org.opencontainers.image.ref.name": version},
    }
    path = {name: f"blobs/{part['digest'].replace(':', '/')}" for name, part in (("config", config), ("layer", packed))}
    files = {
        "oci-layout": {"imageLayoutVersion": "1.0.0"},
        "index.json": {"schemaVersion": 2, "mediaType": f"{OCI}.index.v1+json", "manifests": [manifest]},
        "manifest.json": [{"Config": path["config"], "RepoTags": [f"palpate:{version}"], "Layers": [path["layer"]]}],
    }
    with tarfile.open(file, "w", format=tarfile.GNU_FORMAT) as archive:
        for name in ("blobs", "blobs/sha256"):
            entry = tarfile.TarInfo(name)
            entry.type, entry.mode = tarfile.DIRTYPE, 0o755
            add(archive, entry)
        for name, content in [*blobs.items(), *((name, json.dumps(text).encode()) for name, text in files.items())]:
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            add(archive, entry, content)


def read(file):
    """Returns the layers of an image, unpacked to plain tars, after it has compared every size and digest."""
    with tarfile.open(file) as archive:
        files = {entry.name: archive.extractfile(entry).read() for entry in archive if entry.isreg()}

    def blob(part):
        content = files[f"blobs/{part['digest'].replace(':', '/')}"]
        assert len(content) == part["size"], f"{part['digest']} has {len(content)} bytes in place of {part['size']}"
        assert digest(content) == part["digest"], f"{part['digest']} is the name of {digest(content)}"
        return content

    assert json.loads(files["oci-layout"]) == {"imageLayoutVersion": "1.0.0"}
    (entry,) = json.loads(files["index.json"])["manifests"]
    manifest = json.loads(blob(entry))
    config = json.loads(blob(manifest["config"]))
    layers = [gzip.decompress(blob(part)) for part in manifest["layers"]]
    assert config["rootfs"]["diff_ids"] == [digest(plain) for plain in layers], "diff_ids are of other layers"
    (for_docker,) = json.loads(files["manifest.json"])
    assert files[for_docker["Config"]] == blob(manifest["config"]), "manifest.json names another configuration"
    assert [files[name] for name in for_docker["Layers"]] == [blob(part) for part in manifest["layers"]]
    assert len(files) == 5 + len(layers), f"the layout has other files too: {sorted(files)}"
    return layers


def main():
    command, *arguments = sys.argv[1:]
    if command == "write":
        write(*arguments)
    elif command == "check":
        read(*arguments)
    elif command == "unpack":
        for plain in read(arguments[0]):
            with tarfile.open(fileobj=io.BytesIO(plain)) as archive:
                # Older versions of Python have no filters, and do the same.
                archive.extractall(arguments[1], **({"filter": "tar"} if hasattr(tarfile, "tar_filter") else {}))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
