"""Soft tissue to touch: in this process at full speed, over a network, and as it was recorded.

In this process, `run` plays a script on a scene, `study` many of them over threads, and a `Session` is a tissue that you step
and touch yourself. `connect` (and `palpate.aio.connect`) leads to a server, and `load` finds out what it bears. A `Journal` is a
recorded session, and `Offline` renders the forces of a recorded touch.

SI units; the unit of a value is in its name. Arrays have one row for each point, in the order of `Tissue.rest_m`.
"""

import pkgutil

# Messages that protoc has made of the protocol are `palpate.v1` too, in a folder of their user's.
__path__ = pkgutil.extend_path(__path__, __name__)

from . import aio  # noqa: E402
from ._errors import Disconnected, Error, Failed, Refused
from ._journal import Commands, Verdict
from ._native import (
    Frames,
    Journal,
    Offline,
    RemoteSession,
    Samples,
    Scene,
    Script,
    Session,
    Tip,
    Tissue,
    __version__,
    devices,
    run,
    scenes,
    scripts,
    study,
)
from ._native import Server as Client
from ._run import Run
from ._touch import Course, Frame, Sampled, ToolState, Touched, press

__all__ = [
    "Client",
    "Commands",
    "Course",
    "Disconnected",
    "Error",
    "Failed",
    "Frame",
    "Frames",
    "Journal",
    "Offline",
    "Refused",
    "RemoteSession",
    "Run",
    "Sampled",
    "Samples",
    "Scene",
    "Script",
    "Session",
    "Tip",
    "Tissue",
    "ToolState",
    "Touched",
    "Verdict",
    "__version__",
    "aio",
    "connect",
    "devices",
    "load",
    "press",
    "run",
    "scenes",
    "scripts",
    "study",
]


def connect(url, *, token=None, ca=None, tls_name=None, cert=None, key=None, within_s=10.0):
    """A connection to the server at `url`; you may omit http://. `ca`, `cert` and `key` are PEM texts."""
    return Client.connect(
        url, token=token, ca=ca, tls_name=tls_name, cert=cert, key=key, within_s=within_s, awaited=False
    )


def load(plan, server="http://127.0.0.1:7117", *, report=None):
    """Loads a server with users by a plan, and gives the report: `Client.load` of a connection, or of a URL."""
    client = connect(server) if isinstance(server, str) else server
    return client.load(plan, report=report)
