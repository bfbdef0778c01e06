"""Construction of the arm's driver from the section ``arm`` of a cell file."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import cast

from tapping_cell.configuration.cell import ArmSection, Ros2ControlSection
from tapping_cell.hardware import controllers
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.chain_link import ChainLink, ChainSettings
from tapping_cell.hardware.controllers import ControllerWiring
from tapping_cell.hardware.dialect import ArmDialect
from tapping_cell.hardware.ros2_control_dialect import Ros2ControlDialect, Ros2ControlSettings
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.trajectory_link import TrajectoryLink
from tapping_cell.hardware.transport import Transport


def make_arm_driver(
    arm: ArmSection,
    connection: Transport | TrajectoryLink,
    draw_number: Callable[[int], int] = secrets.randbelow,
) -> ArmDriver:
    """Create the driver of the cell's arm. Nothing is sent to the controller.

    ``connection`` is a serial line or, for the dialect ``ros2_control``, a link to the arm's ROS
    controller. It may be open or closed. ``draw_number`` returns a random number from 0 to below
    its argument, for the line numbers of Marlin.
    """
    dialect = make_dialect(arm, connection, draw_number)
    return ArmDriver(connection, dialect, arm.geometry(), arm.driver_settings())


def joint_accelerations(arm: ArmSection) -> tuple[float, ...]:
    """Return the deceleration of each joint of the arm in a braking stop, in rad/s^2 or m/s^2.

    The values of the kinematic chain are returned if the cell file has one, otherwise those of the
    SCARA.
    """
    own = arm.ros2_control
    if own is None or own.chain is None:
        return arm.max_acceleration
    return own.chain.max_acceleration


def make_dialect(
    arm: ArmSection,
    connection: Transport | TrajectoryLink,
    draw_number: Callable[[int], int] = secrets.randbelow,
) -> ArmDialect:
    """Create the dialect of the arm's controller, with the controller settings it requires.

    ``draw_number``: see :func:`make_arm_driver`.
    """
    if arm.ros2_control is not None:
        link = cast(TrajectoryLink, connection)
        chain, section = arm.chain(), arm.ros2_control.chain
        if chain is not None and section is not None:
            upright = ChainSettings(arm.park, section.tilt, arm.travel_height)
            link = ChainLink(link, chain, arm.geometry(), upright)
        return Ros2ControlDialect(link, _trajectory_settings(arm, arm.ros2_control))
    transport = cast(Transport, connection)
    wiring = ControllerWiring(
        letters=arm.axis_letters,
        needs=arm.controller_needs(),
        settings={int(number): value for number, value in arm.grbl_settings},
        home_place=arm.home_place,
        without_switch=tuple(Joints._fields.index(name) for name in arm.axes_without_switch),
        needs_homing=arm.homing == "firmware",
    )
    return controllers.make_dialect(arm.dialect, transport, wiring, draw_number)


def _trajectory_settings(arm: ArmSection, section: Ros2ControlSection) -> Ros2ControlSettings:
    angle, quill = arm.tolerance_angle, arm.tolerance_quill
    return Ros2ControlSettings(
        section.joints,
        arm.max_acceleration,
        (angle, angle, quill, angle),
        section.state_timeout,
        () if section.chain is None else Joints._fields,
    )
