"""A fleet of two servers on etcd, for tests."""

import json
import os
import pathlib
import shutil
import socket
import subprocess
import tempfile
import time
import unittest

from common import PROGRAM, ROOT

TEST_TIMEOUT_S = 60.0


def port():
    """A port that is free now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def needs_etcd():
    """Leaves a test out where etcd is missing. Where CI says that it must be there, its absence is an error."""
    if shutil.which("etcd") is None:
        missing = "etcd is missing (Debian: apt-get install etcd-server)"
        assert "CI" not in os.environ, missing
        raise unittest.SkipTest(missing)


def until(what, holds):
    """Waits until `holds`; gives what it gave."""
    end = time.monotonic() + TEST_TIMEOUT_S
    while time.monotonic() < end:
        found = holds()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"never: {what}")


class Fleet:
    """Started by `with`, ended after it. `urls` has the server of each name."""

    def __enter__(self):
        self.folder = tempfile.TemporaryDirectory()
        self.processes = {}
        folder = pathlib.Path(self.folder.name)
        etcd, peer = (f"http://127.0.0.1:{port()}" for _ in range(2))
        options = {
            "name": "m0",
            "data-dir": folder / "etcd",
            "listen-client-urls": etcd,
            "advertise-client-urls": etcd,
            "listen-peer-urls": peer,
            "initial-advertise-peer-urls": peer,
            "initial-cluster": f"m0={peer}",
            "log-level": "error",
        }
        command = ["etcd", *(word for name, value in options.items() for word in (f"--{name}", str(value)))]
        quiet = subprocess.DEVNULL
        self.processes["etcd"] = subprocess.Popen(command, stdout=quiet, stderr=quiet)
        self.urls = {name: f"http://127.0.0.1:{port()}" for name in ("a", "b")}
        try:
            for name, url in self.urls.items():
                command = [PROGRAM, "serve", "--listen", url[7:], "--advertise", url, "--node", name, "--cluster", etcd]
                command += ["--journal", folder / name, "--threads", "1", "--durable", "two", "--log", "error"]
                process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=quiet, text=True, cwd=ROOT)
                self.processes[name] = process
                assert "http://" in process.stdout.readline(), "a server of the fleet did not start"
            # Each knows of the other.
            for url in self.urls.values():
                until("the fleet is whole", lambda url=url: len(self.told("nodes", url)) == len(self.urls))
        except BaseException:
            self.__exit__()
            raise
        return self

    def told(self, what, url):
        """Returns the nodes or sessions that `palpate cluster` prints."""
        command = [PROGRAM, "cluster", what, "--json", "--server", url]
        ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        return json.loads(ran.stdout) if ran.returncode == 0 else []

    def name_of(self, session):
        """The server of a session."""
        return next(name for name, url in self.urls.items() if url == session.server)

    def move(self, session):
        """Moves a session to the other server; gives that server's URL."""
        here = self.name_of(session)
        there = next(name for name in self.urls if name != here)
        command = [PROGRAM, "cluster", "move", session.id, there, "--server", self.urls[here]]
        moved = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert moved.returncode == 0, moved.stderr
        return self.urls[there]

    def until_stood_by(self, session):
        """Waits until the other server has all of a session: only then may its own die."""

        def has_standby():
            told = self.told("sessions", session.server)
            return any(other["session_id"] == session.id and other["standby"] for other in told)

        until("the session has a standby", has_standby)

    def kill(self, name):
        process = self.processes.pop(name)
        process.kill()
        process.wait()
        process.stdout.close()

    def __exit__(self, *_):
        for name in list(self.processes):
            process = self.processes.pop(name)
            process.kill()
            process.wait()
            if process.stdout:
                process.stdout.close()
        self.folder.cleanup()
