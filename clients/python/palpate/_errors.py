"""The exceptions of this package."""

import re


class Error(Exception):
    """The base class of all errors of Palpate."""


class Refused(Error, ValueError):
    """An input was refused; nothing was changed.

    `reason` is a stable name (docs/protocol.md lists them). `field` is the path of the wrong field, or "". `message` says what is
    wrong and what would be right. `place` is where the input was written, such as "scene.toml:5"; None if it is not from a text.
    """

    def __init__(self, reason, field, message, place=None):
        super().__init__(reason, field, message, place)
        self.reason = reason
        self.field = field
        self.message = message
        self.place = place

    @property
    def line(self):
        """The line of the TOML text, from 1; None if the refusal is not about a line."""
        found = re.search(r":(\d+)$", self.place or "")
        return int(found.group(1)) if found else None

    def __str__(self):
        return ": ".join(part for part in (self.place, self.field, self.message) if part)


class Failed(Error, RuntimeError):
    """The tissue could not continue: the guard has stopped the session."""


class Disconnected(Error, ConnectionError):
    """The server can't be reached, or the connection broke."""
