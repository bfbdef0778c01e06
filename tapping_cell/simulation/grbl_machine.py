"""Settings of the emulated Grbl controller, and of the arm that it drives."""

from __future__ import annotations

from dataclasses import dataclass, field

from tapping_cell.simulation.grbl_variants import GRBL, GrblVariant
from tapping_cell.simulation.motor_axes import ArmMachine, Joints


def default_settings(variant: GrblVariant = GRBL) -> dict[int, float]:
    """Return the Grbl settings for the simulated arm; rates in units/min, accelerations in
    units/s^2, travels in units."""
    return {
        0: 10,
        1: 255,
        10: 511 if variant.offset_bit else 1,
        11: 0.01,
        12: 0.002,
        13: 0,
        20: 0,
        21: 1,
        22: 1,
        23: 0,
        24: 600,
        25: 3600,
        27: 1,
        44: 4,
        45: 3,
        46: 8,
        47: 0,
        **{100 + axis: value for axis, value in enumerate((200.0, 200.0, 400.0, 100.0))},
        **{110 + axis: value for axis, value in enumerate((6900.0, 8600.0, 15000.0, 20700.0))},
        **{120 + axis: value for axis, value in enumerate((458.0, 573.0, 2000.0, 1720.0))},
        **{130 + axis: value for axis, value in enumerate((265.0, 300.0, 150.0, 410.0))},
    }


@dataclass(frozen=True, slots=True)
class GrblMachine(ArmMachine):
    """The arm that the emulated controller drives, and its firmware."""

    home_joints: Joints = (0.0, 1.5708, 0.0, 0.0)
    settings: dict[int, float] = field(default_factory=dict)
    """Settings that differ from ``default_settings``."""
    variant: GrblVariant = GRBL
