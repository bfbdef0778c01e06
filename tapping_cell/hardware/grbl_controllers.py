"""The controllers of the Grbl family by name: one table of what differs between them.

Sources: the firmwares themselves: Grbl 1.1h, grbl-Mega-5X 1.1q, grblHAL core (build 20260817, also
run as its simulator), FluidNC 3.9 and 4.0.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from tapping_cell.hardware import grbl

ORIGIN_BIT = 8
"""Bit of grblHAL's ``$22`` that makes the place where homing ends zero."""


@dataclass(frozen=True, slots=True)
class GrblController:
    """What one firmware of the family does in its own way."""

    name: str
    hold_setting: str = "$1"
    """The setting that is 255 where the motors keep their torque while they stand."""
    store_words: str = ""
    """What a person must do besides, for the setting to outlive a restart."""
    has_files: bool = False
    """Keeps most settings under names in a file; ``$$`` lists only some of them."""
    homing_masks: tuple[int, ...] = ()
    """Settings that name the axes that homing moves, one a cycle; empty: the build decides."""
    alarms: Mapping[int, str] = field(default_factory=dict)
    """Alarms that mean something else than in Grbl, or that Grbl does not have."""
    cuts_torque_on_alarm: bool = True
    """Motors lose their power on an alarm and on a reset in motion, whatever the hold setting."""


GRBL = GrblController("Grbl")
MEGA_5X = GrblController("grbl-Mega-5X")
GRBL_HAL = GrblController(
    "grblHAL",
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
    store_words="; write idle_ms: 255 under stepping: in config.yaml as well",
    has_files=True,
    alarms={
        10: "the spindle did not answer",
        11: "a control input is active",
        12: "a switch is closed on both ends of an axis",
        13: "the emergency stop input is active",
        14: "it has not been homed since it was switched on",
        15: "it was just switched on",
    },
    cuts_torque_on_alarm=False,
)
CONTROLLERS = (GRBL, MEGA_5X, GRBL_HAL, FLUID_NC)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who answered ``$I``."""

    controller: GrblController
    version: str
    letters: str
    """Axis letters in the order of its reports; empty where it does not tell."""
    forces_origin: bool
    """Built to call the place where homing ends zero."""


def identify(messages: Iterable[grbl.Message]) -> Identity | None:
    """Read the answer to ``$I``; None where it names no version that is understood."""
    told = {message.kind: message.text for message in messages}
    version = told.get("VER", "")
    letters = told.get("AXS", "").partition(":")[2]
    options = told.get("OPT", "").split(",")[0]
    if found := re.match(r"^[34]\.\d+ FluidNC v?([34]\.\d+\S*)", version):
        return Identity(FLUID_NC, found[1].rstrip(":"), "", False)
    if not version.startswith("1.1"):
        return None
    number = version.split(":")[0]
    if told.get("FIRMWARE") == "grblHAL":
        return Identity(GRBL_HAL, number, letters, "Z" in options)
    if letters:
        return Identity(MEGA_5X, number, letters, "Z" in options)
    return Identity(GRBL, number, "", "Z" in options)
