"""Differences between the controllers of the Grbl family that are visible to a host.

The table is based on the source code of the firmwares and is independent of the driver's table of
controllers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

GREETING = b"\r\n%s ['$' for help]\r\n"


@dataclass(frozen=True, slots=True)
class GrblVariant:
    """Behaviour of one firmware; ``GrblMachine`` describes the arm that it drives."""

    banner: bytes = GREETING % b"Grbl 1.1h"
    information: tuple[bytes, ...] = (b"[VER:1.1h.20190825:]", b"[OPT:V,15,128]")
    """Answer to ``$I``."""
    axes: int = 4
    """Number of axes in a report; axes beyond the arm's four remain at zero."""
    unlisted: frozenset[int] = frozenset()
    """Settings that ``$$`` does not list."""
    names: dict[str, str] = field(default_factory=dict)
    """Named settings, such as ``/stepping/idle_ms``."""
    hold_name: str = ""
    """Named setting that replaces ``$1``."""
    alarm_cuts_torque: bool = True
    """Whether an alarm, or a reset during a motion, cuts the motors' power."""
    reset_delay: float = 0.0
    """Time from a soft reset during a motion to the greeting, s; lines sent meanwhile are lost."""
    unhomed_alarm: int | None = None
    """Alarm that is reported after the greeting until the arm has been homed."""
    reports_while_homing: bool = False
    offset_bit: int = 0
    """Bit of ``$10`` without which a report never contains the work offset; 0 if there is no such
    bit."""
    locked_until_homed_bit: int = 0
    """Bit of ``$22`` with which ``$X`` is refused until the arm is homed; 0 if there is no such
    bit."""
    homing_masks: tuple[int, ...] = ()
    """Settings that select the axes of each homing cycle; if empty, all four axes home."""
    unhomed_axes: frozenset[int] = frozenset()
    """Axes that homing does not move in this build."""
    forces_origin: bool = False
    """Whether the machine position is zero after homing in this build."""
    ends_at_place: bool = False
    """Whether the machine position after homing is the named setting ``mpos_mm`` of each axis."""


GRBL = GrblVariant()
GRBL_3_AXES = GrblVariant(axes=3)
MEGA_5X = GrblVariant(
    banner=GREETING % b"Grbl 1.1q",
    information=(b"[VER:1.1q.20210103:]", b"[AXS:5:XYZAB]", b"[OPT:VMH,35,255]"),
    axes=5,
    unhomed_axes=frozenset({3}),
)
GRBL_HAL = GrblVariant(
    banner=b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n",
    information=(
        b"[VER:1.1f.20260817:]",
        b"[OPT:VNML+,100,1024,4,0]",
        b"[AXS:4:XYZA]",
        b"[NEWOPT:ENUMS,RT+,TC,SED]",
        b"[FIRMWARE:grblHAL]",
        b"[NVS STORAGE:*FLASH]",
    ),
    reports_while_homing=True,
    offset_bit=32,
    locked_until_homed_bit=4,
    homing_masks=(44, 45, 46, 47),
)


def fluid_nc(version: str, unlisted: frozenset[int]) -> GrblVariant:
    """Return one version of FluidNC, whose settings are stored in a file; ``$$`` lists only a few
    of them."""
    names = {"/stepping/idle_ms": "255", "/report_inches": "false"}
    for axis in "xyza":
        names[f"/axes/{axis}/homing/cycle"] = "1"
        names[f"/axes/{axis}/homing/mpos_mm"] = "0.000"
    short = ".".join(version.split(".")[:2])
    return GrblVariant(
        banner=f"\r\nGrbl {short} [FluidNC v{version} (wifi) '$' for help]\r\n".encode(),
        information=(
            f"[VER:{short} FluidNC v{version}:]".encode(),
            b"[OPT:PHS]",
            b"[MSG: Machine: arm]",
        ),
        unlisted=unlisted,
        names=names,
        hold_name="/stepping/idle_ms",
        alarm_cuts_torque=False,
        reset_delay=0.5,
        unhomed_alarm=14,
        reports_while_homing=True,
        ends_at_place=True,
    )


FLUID_NC_3 = fluid_nc("3.9.5", frozenset({0, 1, 11, 12, 13, 24, 25, 26, 27, 28}))
FLUID_NC_4 = fluid_nc("4.0.3", frozenset({0, 1, 3, 11, 12, 13, 24, 25, 26, 27, 28}))

VARIANTS = {
    "grbl": GRBL,
    "grbl-mega-5x": MEGA_5X,
    "grblhal": GRBL_HAL,
    "fluidnc3": FLUID_NC_3,
    "fluidnc4": FLUID_NC_4,
}
"""Variants with at least four axes, by name."""
