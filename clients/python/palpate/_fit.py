"""Measured curves, and the result of a fit."""

import dataclasses
from typing import Any, Optional

import numpy as np


@dataclasses.dataclass(eq=False)
class Curve:
    """A measured curve: what a tip did, and the force on it, for `fit`.

    `time_s` ascends; `depth_m` is 0 where the tip touches the tissue at rest, and negative above it; `force_n` is the force of the
    tissue on the tip, outward. `tip` is disc (an even pressure), rigid (a flat rigid disc) or sphere; the last two need a solid.
    `place_m` is where the tip goes in, x, y and z; by default the middle of a sheet, or the top of a mesh or solid.
    """

    time_s: Any
    depth_m: Any
    force_n: Any
    tip: str = "disc"
    radius_m: float = 0.005
    place_m: Optional[Any] = None
    name: str = ""


@dataclasses.dataclass(eq=False)
class Fit:
    """The parameters of a tissue with which runs of it have the measured forces.

    `values` has the value of each fitted parameter by its key in the scene, `intervals` its 95 % interval, `start` its value before,
    and `units` its unit. `untold` has the reason for each parameter that the curves can't tell, which keeps its value.
    `correlations` are those between the errors of each two parameters, in the order of `values`. `fitted_n` and `residual_n` (fitted −
    measured) have an array for each curve. `rms_n` is the root of the mean square of all residuals, `relative_rms` the same divided by
    the largest force, `noise_of_curves_n` the standard deviation of the noise of each curve. `autocorrelation` is the correlation between a residual and the
    next one, 0 if it is within what chance makes. `runs` counts the runs of a curve. `scene` has the fitted values.
    """

    values: dict
    intervals: dict
    start: dict
    units: dict
    untold: dict
    correlations: np.ndarray
    fitted_n: list
    residual_n: list
    rms_n: float
    relative_rms: float
    r_squared: float
    noise_of_curves_n: list
    autocorrelation: float
    runs: int
    warnings: list
    scene: Any

    def __repr__(self):
        values = ", ".join(f"{name} = {value:.4g} {self.units[name]}" for name, value in self.values.items())
        return f"<palpate.Fit {values}; residual {self.rms_n:.3g} N>"
