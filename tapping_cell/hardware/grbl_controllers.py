"""Table of the controllers of the Grbl family and the differences between them.

Sources: the firmwares Grbl 1.1h, grbl-Mega-5X 1.1q, grblHAL core (build 20260817, also run in its
simulator), FluidNC 3.9 and 4.0.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from tapping_cell.hardware import grbl

ORIGIN_BIT = 8
"""Bit of grblHAL's ``$22`` that makes the position at the end of homing the machine zero."""


@dataclass(frozen=True, slots=True)
class GrblController:
    """Properties in which the firmwares of the family differ."""

    name: str
    hold_setting: str = "$1"
    """Setting that must be 255 for the motors to keep their torque at standstill."""
    store_note: str = ""
    """What a person must also do so that the setting survives a restart; empty if no such action is
    needed."""
    has_files: bool = False
    """True if most settings are named and stored in a file. ``$$`` then lists only a
    few settings."""
    report_bits: int = 1
    """Bits of ``$10`` that must be set."""
    report_meaning: str = "must be odd, so that reports contain the machine position"
    homing_masks: tuple[int, ...] = ()
    """Settings that select the axes of each homing cycle; empty if the axes are fixed at build
    time."""
    alarms: Mapping[int, str] = field(default_factory=dict)
    """Alarms whose meaning differs from that in Grbl, and alarms that Grbl does not have."""


GRBL = GrblController("Grbl")
MEGA_5X = GrblController("grbl-Mega-5X")
GRBL_HAL = GrblController(
    "grblHAL",
    report_bits=33,
    report_meaning="bits 0 and 5 must be set, so that reports contain the machine position and the "
    "work offset",
    homing_masks=(44, 45, 46, 47, 48, 49),
    alarms={
        10: "the emergency stop is pressed",
        11: "homing is required",
        12: "a limit switch is closed",
        17: "a motor driver reports a fault",
    },
)
FLUID_NC = GrblController(
    "FluidNC",
    hold_setting="$/stepping/idle_ms",
    store_note="; also set idle_ms to 255 in the section stepping of config.yaml",
    has_files=True,
    alarms={
        10: "the spindle did not answer",
        11: "a control input is active",
        12: "a limit switch is closed, but it is not clear at which end of the axis",
        13: "the emergency stop input is active",
        14: "it has not been homed since it was switched on",
        15: "it was just switched on",
    },
)


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a controller from its answer to ``$I``."""

    controller: GrblController
    version: str
    letters: str
    """Axis letters in the order of the status reports; empty if the firmware does not list them."""
    forces_origin: bool
    """True if the firmware build sets the machine position to zero at the end of homing."""


def identify(messages: Iterable[grbl.Message]) -> Identity | None:
    """Parse the answer to ``$I``; return None if its version is missing or not supported."""
    info = {message.kind: message.text for message in messages}
    version = info.get("VER", "")
    letters = info.get("AXS", "").partition(":")[2]
    options = info.get("OPT", "").split(",")[0]
    if found := re.match(r"^[34]\.\d+ FluidNC v?([34]\.\d+\S*)", version):
        return Identity(FLUID_NC, found[1].rstrip(":"), "", False)
    if not version.startswith("1.1"):
        return None
    number = version.split(":")[0]
    if info.get("FIRMWARE") == "grblHAL":
        return Identity(GRBL_HAL, number, letters, "Z" in options)
    if letters:
        return Identity(MEGA_5X, number, letters, "Z" in options)
    return Identity(GRBL, number, "", "Z" in options)
