"""A real `palpate serve` on a free port, for tests."""

import os
import pathlib
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROGRAM = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/palpate"


class Server:
    """Started by `with`, ended after it; `address` is host:port, `url` with http:// before it."""

    def __enter__(self):
        command = [PROGRAM, "serve", "--listen", "127.0.0.1:0", "--log", "warn"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        line = self.process.stdout.readline()
        assert "http://" in line, f"the server did not start: {line!r}"
        self.address = line.split("http://")[1].strip()
        self.url = f"http://{self.address}"
        return self

    def __exit__(self, *_):
        self.process.terminate()
        try:
            # On Windows `terminate` ends the process itself, with another status.
            assert self.process.wait(timeout=20) == 0 or os.name == "nt"
        finally:
            self.process.kill()
            self.process.stdout.close()
