"""From the arm's section of a cell file to its driver."""

from __future__ import annotations

from tapping_cell.configuration.cell import ArmSection
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.dialect import ArmDialect
from tapping_cell.hardware.grbl_dialect import GrblDialect, GrblSettings
from tapping_cell.hardware.marlin_dialect import MarlinDialect, MarlinSettings
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.transport import Transport


def make_arm_driver(arm: ArmSection, transport: Transport) -> ArmDriver:
    """The driver of the cell's arm on an open or closed line; nothing is sent."""
    return ArmDriver(transport, make_dialect(arm, transport), arm.geometry(), arm.driver_settings())


def make_dialect(arm: ArmSection, transport: Transport) -> ArmDialect:
    """The language of the cell's controller, with what its settings must be."""
    needs = arm.controller_needs()
    if arm.dialect == "marlin":
        return MarlinDialect(transport, MarlinSettings(letters=arm.axis_letters, needs=needs))
    # $13 = 0: reports in mm and degrees.
    expected = {13: 0.0} | {int(number): value for number, value in arm.grbl_settings}
    return GrblDialect(
        transport,
        GrblSettings(
            letters=arm.axis_letters,
            expected=expected,
            needs=needs,
            home_place=arm.home_place,
            without_switch=tuple(Joints._fields.index(name) for name in arm.axes_without_switch),
            needs_homing=arm.homing == "firmware",
        ),
    )
