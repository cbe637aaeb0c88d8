"""Record types of the arrays that the library creates."""

import numpy as np

from ._touch import ToolState

_VECTOR = (np.float64, (3,))


def _of(*names):
    return np.dtype([(name, *_VECTOR) for name in names])


POINT = _of(
    "displacement_m",
    "velocity_m_per_s",
    "spring_n",
    "anchor_n",
    "damping_n",
    "applied_n",
    "reaction_n",
    "constraint_n",
)
TOOL = _of("place_m", "displacement_m", "force_on_tool_n")
FELT = _of("displacement_m", "surface_displacement_m", "velocity_m_per_s", "force_on_tool_n", "applied_force_n")
ENERGY = np.dtype([("kinetic", np.float64), ("spring", np.float64), ("virtual", np.float64)])


def tool_state(rows):
    """Creates a `ToolState` from five vectors."""
    return ToolState(*rows)
