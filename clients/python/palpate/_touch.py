"""Touching: courses to play, and their results."""

import dataclasses
from typing import Optional, Union

import numpy as np


@dataclasses.dataclass(eq=False)
class ToolState:
    """A tool in a session of this process: how the tissue under it is displaced, and the forces there."""

    displacement_m: np.ndarray
    surface_displacement_m: np.ndarray
    velocity_m_per_s: np.ndarray
    force_on_tool_n: np.ndarray
    applied_force_n: np.ndarray


@dataclasses.dataclass(eq=False)
class Course:
    """A device that moves along `places_m`, one row per millisecond, measured from the top of the tissue (`Tissue.top_m`), z up.

    `limits` is the name of a device (`palpate.devices()`), or a dict with force_n, continuous_n, stiffness_n_per_m,
    damping_n_s_per_m, workspace_m, torque_n_m.
    """

    places_m: np.ndarray
    limits: Union[str, dict] = "omega3"


def press(depth_m=0.003, *, seconds=2.0, hover_m=0.005, at_m=(0.0, 0.0), limits="omega3"):
    """Returns a course that moves down from `hover_m` above the tissue, presses `depth_m` deep, holds, and moves up again: smoothly, a
    third of `seconds` each. `at_m` is measured from the top of the tissue: of a sheet its middle, of an organ the highest place of its
    surface above the middle. Where the surface of an organ is lower, give its height as a third number: `at_m=(0.03, 0.0, -0.008)`."""
    moments = np.arange(max(1, round(1000 * seconds))) / max(1, round(1000 * seconds))
    down = np.clip(3 * moments, 0, 1) - np.clip(3 * moments - 2, 0, 1)
    smooth = down * down * (3 - 2 * down)
    heights = hover_m - (hover_m + depth_m) * smooth
    x, y, surface_m = (*at_m, 0.0)[:3]
    places = [np.full_like(heights, x), np.full_like(heights, y), surface_m + heights]
    return Course(np.column_stack(places), limits)


@dataclasses.dataclass(eq=False)
class Touched:
    """The results of a touch: one row of each array per tick of the device's loop, and counts.

    `place_m` is the tool's position in the tissue's frame: a device that reads (0, 0, 0) is at `status()["top_m"]`. `force_n` is the
    force on the hand that the device was given, z up. `time_s` is counted from the first tick; `enabled` says whether forces were
    enabled. `ages_s` is the age of the newest data of the tissue, for ticks since the first data. `limits` counts the ticks in which
    each limit of the safety envelope acted, `energy_j` is the energy that the device gave to the hand, and `lost` is the reason why
    there was no connection at the end, or None. `largest_torque_n_m` is 0 without an instrument. `jaw_overloads` counts how often the
    torque between its jaws exceeded their limit.
    """

    time_s: np.ndarray
    place_m: np.ndarray
    force_n: np.ndarray
    enabled: np.ndarray
    ages_s: np.ndarray
    late_ticks: int
    missed_ticks: int
    predicted_ticks: int
    connections: int
    failed_attempts: int
    samples: int
    poses: int
    refused: int
    datagrams_up: int
    datagrams_down: int
    limits: dict
    energy_j: float
    lost: Optional[str]
    largest_torque_n_m: float = 0.0
    jaw_overloads: int = 0


@dataclasses.dataclass(eq=False)
class Sampled:
    """Samples of a session: one row per tool of each sample. `felt` has displacement_m, surface_displacement_m, velocity_m_per_s,
    force_on_tool_n and applied_force_n."""

    step: np.ndarray
    time_s: np.ndarray
    tool: np.ndarray
    awake_points: np.ndarray
    asleep: np.ndarray
    felt: np.ndarray

    def __len__(self):
        return len(self.step)


@dataclasses.dataclass(eq=False)
class Frame:
    """The surface at one moment. `displacement_m` is the displacement of each vertex, an array [x, y, 3] on a sheet. On a mesh its
    first two axes together are the vertices of `RemoteSession.mesh()`, with possibly some unused rows at the end."""

    step: int
    time_s: float
    frame_id: int
    skipped: int
    displacement_m: np.ndarray
