"""What can go wrong."""

import re


class Error(Exception):
    """Any error of Palpate."""


class Refused(Error, ValueError):
    """An input was refused, and changed nothing.

    `reason` is a stable name (docs/protocol.md lists them), `field` the offending field as a path, "" if none is, `message` says
    what is wrong and what would be right, and `place` where it was written, as "scene.toml:5"; None if it came in no text.
    """

    def __init__(self, reason, field, message, place=None):
        super().__init__(reason, field, message, place)
        self.reason = reason
        self.field = field
        self.message = message
        self.place = place

    @property
    def line(self):
        """The line of TOML, from 1; None if the refusal is of no line."""
        found = re.search(r":(\d+)$", self.place or "")
        return int(found.group(1)) if found else None

    def __str__(self):
        return ": ".join(part for part in (self.place, self.field, self.message) if part)


class Failed(Error, RuntimeError):
    """The tissue could not go on: the guard has ended the session."""


class Disconnected(Error, ConnectionError):
    """The server can't be reached, or the connection broke."""
