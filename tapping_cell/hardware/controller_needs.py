"""What the arm's configuration asks of its controller's own settings, and what was found there.

All in the controller's units: degrees for the revolute axes, mm for the quill, and seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.hardware.axis_units import TO_UNITS
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.scara import ScaraGeometry

TOLERANCE = 1e-3
"""Relative difference forgiven in a setting."""

Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ControllerNeeds:
    """What the four axes must at least be allowed to do; None is not looked at."""

    speed: Four | None = None
    """Units/s: a slower controller makes a move last longer than the driver computes."""
    acceleration: Four | None = None
    """Units/s^2: the same."""
    travel: Four | None = None
    """Units between the joint limits: what soft limits must leave free."""
    steps: Four | None = None
    """Steps per unit, exactly: else the arm moves by another angle than it says."""


def needs_of(geometry: ScaraGeometry, steps_per_unit: Sequence[float] = ()) -> ControllerNeeds:
    """The needs of an arm; ``steps_per_unit`` empty: whatever the controller has."""

    def units(values: Sequence[float]) -> Four:
        a, b, c, d = (scale * value for scale, value in zip(TO_UNITS, values, strict=True))
        return a, b, c, d

    steps: Four | None = None
    if steps_per_unit:
        a, b, c, d = steps_per_unit
        steps = (a, b, c, d)
    spans = [high - low for low, high in zip(geometry.lower, geometry.upper, strict=True)]
    return ControllerNeeds(
        units(geometry.max_speed), units(geometry.max_acceleration), units(spans), steps
    )


def at_least(
    names: Sequence[str], found: Sequence[float], needed: Four | None, command: str = ""
) -> list[Finding]:
    """A finding for each setting that must not be smaller than needed.

    ``command``: how it is set, with ``{name}`` and ``{value}``.
    """
    return [
        Finding(
            name,
            f"{value:g}",
            f"must be at least {least:g}",
            value >= least * (1 - TOLERANCE),
            command.format(name=name, value=f"{least:g}"),
        )
        for name, value, least in zip(names, found, needed or (), strict=False)
    ]


def exactly(
    names: Sequence[str], found: Sequence[float], needed: Four | None, command: str = ""
) -> list[Finding]:
    """A finding for each setting that must be just what is needed; ``command`` as above."""
    return [
        Finding(
            name,
            f"{value:g}",
            f"must be {wanted:g}",
            abs(value - wanted) <= TOLERANCE * max(abs(wanted), 1.0),
            command.format(name=name, value=f"{wanted:g}"),
        )
        for name, value, wanted in zip(names, found, needed or (), strict=False)
    ]


def refuse(findings: Sequence[Finding]) -> None:
    """Raise HardwareFault (SETTINGS_MISMATCH) where a need is not met."""
    differences = [finding.sentence for finding in findings if not finding.met]
    if differences:
        raise HardwareFault(
            FaultReason.SETTINGS_MISMATCH,
            "the controller's settings differ from what is needed: "
            + "; ".join(differences)
            + ": set them on the controller or correct the configuration",
        )
