"""The contents of journals, as arrays."""

import dataclasses
from typing import Optional

import numpy as np


@dataclasses.dataclass(eq=False)
class Course:
    """What one tool did and felt, about 100 times per second: one row of each array per moment."""

    time_s: np.ndarray
    step: np.ndarray
    place_m: np.ndarray
    displacement_m: np.ndarray
    force_n: np.ndarray

    def __len__(self):
        return len(self.step)


@dataclasses.dataclass(eq=False)
class Commands:
    """All commands, by the step at which they acted: one row of each array per command.

    `kind` is push, grasp, pose, tie, release or end_of_lease. `place_m` is the place of a push, the position of a pose, or the
    displacement by a grasp; `force_n` is the force of a push; NaN for other kinds. `point` is the row of the point, or -1.
    """

    time_s: np.ndarray
    step: np.ndarray
    tool: np.ndarray
    kind: np.ndarray
    place_m: np.ndarray
    force_n: np.ndarray
    point: np.ndarray
    client_time_ns: np.ndarray
    late: np.ndarray

    def __post_init__(self):
        self.kind = np.array(self.kind, dtype="U12")

    def __len__(self):
        return len(self.step)


@dataclasses.dataclass
class Verdict:
    """The result of simulating a journal again: true if all compared hashes and snapshots are equal, bit by bit."""

    begin_step: int
    end_step: int
    hashes: int
    snapshots: int
    differs_at_step: Optional[int]
    difference: Optional[str]

    def __bool__(self):
        return self.difference is None
