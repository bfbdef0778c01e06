"""Labels and units of fitted values, for the terminal and the report of ``object fit``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tapping_cell.calibration.estimates import Estimate
    from tapping_cell.calibration.object_fit import ObjectFit

_LABELS = {
    "friction": "friction with the table",
    "torque_factor": "torque factor",
    "restitution": "restitution",
    "contact_friction": "friction with the striker",
    "scale_b1": "scale of B1",
    "scale_b2": "scale of B2",
    "scale_b3": "scale of B3",
    "scatter_speed": "scatter of launch speed (%)",
    "scatter_spin": "scatter of launch spin (%)",
    "scatter_direction": "scatter of direction (degrees)",
    "scatter_distance": "scatter of distance (%)",
    "scatter_rotation": "scatter of rotation (%)",
    "scatter_position_floor": "scatter of small taps (mm)",
    "scatter_angle_floor": "scatter of small rotations (degrees)",
}


def speed_lines(fit: ObjectFit) -> list[str]:
    """Format the measured striker speed at each setting."""
    found = []
    for point in fit.tapper:
        setting = (
            f"commanded {1e3 * point.commanded:.0f} mm/s"
            if math.isnan(point.draw)
            else f"spring deflection {1e3 * point.draw:.2f} mm"
        )
        found.append(
            f"{setting}: {1e3 * point.measured:.1f} mm/s, scatter {1e3 * point.scatter:.1f} mm/s "
            f"in {point.trials} taps"
        )
    return found


def shown(entry: Estimate) -> tuple[str, float]:
    """Return the label of an estimate, and the factor that converts its value to the unit in the
    label."""
    factor = 1.0
    if entry.name.startswith("scatter"):
        factor = {"rad": 180 / math.pi, "m": 1e3}.get(entry.unit, 100.0)
    return _LABELS[entry.name], factor
