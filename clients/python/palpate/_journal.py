"""What a journal tells, as arrays."""

import dataclasses
from typing import Optional

import numpy as np


@dataclasses.dataclass(eq=False)
class Course:
    """What one tool did and felt, some 100 times a second."""

    time_s: np.ndarray
    step: np.ndarray
    place_m: np.ndarray
    displacement_m: np.ndarray
    force_n: np.ndarray

    def __len__(self):
        return len(self.step)


@dataclasses.dataclass(eq=False)
class Commands:
    """Every command, by the step at which it acted: one row of each array.

    `kind` is push, grasp, pose, release or end_of_lease. `place_m` is where a force acts, where a pose leads, or by how much a grasp
    displaces its point (`point`, an index; -1 where no point was named); `force_n` is of a push. NaN where there is none.
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
    """Whether a journal that is simulated again gives the same bits."""

    begin_step: int
    end_step: int
    hashes: int
    snapshots: int
    differs_at_step: Optional[int]
    difference: Optional[str]

    def __bool__(self):
        return self.difference is None
