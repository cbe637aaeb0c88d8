"""The results of a run."""

import dataclasses
import json

import numpy as np


@dataclasses.dataclass(eq=False)
class Run:
    """The records of a run: one row of each array per moment.

    `points` has the fields displacement_m, velocity_m_per_s, spring_n, anchor_n, damping_n, applied_n, reaction_n and constraint_n
    (NaN for a point that is not held), per moment and point. `tools` has place_m, displacement_m and force_on_tool_n (NaN while the
    tool is away), per moment and tool with a tip. `energy_j` has kinetic, spring and virtual.
    """

    time_s: np.ndarray
    point_names: list
    points: np.ndarray
    tool_numbers: list
    tools: np.ndarray
    energy_j: np.ndarray
    awake_points: np.ndarray
    header: dict
    summary: dict
    warnings: list

    def __post_init__(self):
        self.header, self.summary = (json.loads(text) if isinstance(text, str) else text for text in (self.header, self.summary))

    @property
    def final_hash(self):
        """The hash of the state at the end, as the program `palpate run` prints it."""
        return self.summary["final_hash"]

    def point(self, name):
        """Returns the records of the point `name` over time."""
        names = [tuple(other) if isinstance(other, (list, tuple)) else other for other in self.point_names]
        return self.points[:, names.index(tuple(name) if isinstance(name, (list, tuple)) else name)]

    def __repr__(self):
        return (
            f"<palpate.Run of {self.header['script']!r} on {self.header['scene']!r}: {self.summary['steps']} steps, "
            f"{len(self.time_s)} records, hash {self.final_hash}>"
        )
