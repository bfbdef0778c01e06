"""Required controller settings for an arm, and their comparison with the actual settings.

All values are in the controller's units: degrees for the revolute axes, mm for the quill, and s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.hardware.axis_units import TO_UNITS
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.scara import ScaraGeometry

TOLERANCE = 1e-3
"""Maximum relative difference at which a setting counts as equal to its required value."""

Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ControllerNeeds:
    """Required settings of the four axes; None skips the check of a setting."""

    speed: Four | None = None
    """Minimum value of the controller's speed limit, units/s. With a lower limit, moves take longer
    than computed."""
    acceleration: Four | None = None
    """Minimum value of the controller's acceleration limit, units/s^2. With a lower limit, moves
    take longer than computed."""
    travel: Four | None = None
    """Travel that the soft limits must allow, in the controller's units: the range between the
    joint limits."""
    steps: Four | None = None
    """Exact steps per unit; with another value the arm moves by a wrong angle or distance."""


def needs_of(geometry: ScaraGeometry, steps_per_unit: Sequence[float] = ()) -> ControllerNeeds:
    """Return the required settings of an arm. If ``steps_per_unit`` is empty, any number of
    steps per unit is accepted."""

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
    names: Sequence[str], found: Sequence[float | None], needed: Four | None, command: str = ""
) -> list[Finding]:
    """Return a finding for each setting that has a minimum. ``found``: None for a missing value.

    ``command``: template of the command that corrects the setting, with ``{name}`` and ``{value}``.
    """
    return [
        Finding(
            name,
            _shown(value),
            f"must be at least {least:g}",
            value is not None and value >= least * (1 - TOLERANCE),
            command.format(name=name, value=f"{least:g}"),
        )
        for name, value, least in zip(names, found, needed or (), strict=False)
    ]


def exactly(
    names: Sequence[str], found: Sequence[float | None], needed: Four | None, command: str = ""
) -> list[Finding]:
    """Return a finding for each setting that must match exactly; ``command``: see ``at_least``."""
    return [
        Finding(
            name,
            _shown(value),
            f"must be {wanted:g}",
            value is not None and abs(value - wanted) <= TOLERANCE * max(abs(wanted), 1.0),
            command.format(name=name, value=f"{wanted:g}"),
        )
        for name, value, wanted in zip(names, found, needed or (), strict=False)
    ]


def refuse(findings: Sequence[Finding]) -> None:
    """Raise HardwareFault (SETTINGS_MISMATCH) if a setting is not as required."""
    differences = [finding.sentence for finding in findings if not finding.met]
    if differences:
        raise HardwareFault(
            FaultReason.SETTINGS_MISMATCH,
            "the controller's settings differ from the required ones; set them on the controller "
            "or correct the configuration: " + "; ".join(differences),
        )


def _shown(value: float | None) -> str:
    return "missing" if value is None else f"{value:g}"
