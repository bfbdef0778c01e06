"""What is true in the simulated world and told to no planner: ``config/truth/*.yaml``.

Factors multiply and offsets are added to what the object, cell and camera files say, so that one
truth file serves every object.
"""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.schema import quantity, section


@dataclass(frozen=True, slots=True)
class SupportTruth:
    """How the object really rests on the table."""

    friction_factor: float = quantity("true over configured friction", "", 0.1, 10.0, default=1.0)
    torque_factor_factor: float = quantity(
        "true over configured torque factor", "", 0.05, 20.0, default=1.0
    )
    edge_weight: float = quantity(
        "extra pressure at the rim relative to the middle", "", 0.0, 20.0, default=0.0
    )
    lean: tuple[float, float] = quantity(
        "pressure towards +x and +y of the object", "", -1.0, 1.0, default=(0.0, 0.0)
    )
    slope: tuple[float, float] = quantity(
        "tilt of the table, downhill along +x and +y", "rad", -0.05, 0.05, default=(0.0, 0.0)
    )


@dataclass(frozen=True, slots=True)
class ImpactTruth:
    """How the striker and the object really meet."""

    restitution_factor: float = quantity("true over configured", "", 0.1, 3.0, default=1.0)
    contact_friction_factor: float = quantity("true over configured", "", 0.1, 10.0, default=1.0)
    striker_speed_factor: float = quantity(
        "true over commanded striker speed", "", 0.1, 3.0, default=1.0
    )
    gate_noise: float = quantity(
        "standard deviation of the tapper's own measurement of the speed, relative",
        "",
        0.0,
        0.2,
        default=0.0,
    )


@dataclass(frozen=True, slots=True)
class ScatterTruth:
    """One standard deviation, drawn anew for every tap."""

    speed: float = quantity("of the launch speed, relative", "", 0.0, 0.5, default=0.0)
    spin: float = quantity("of the launch spin, relative", "", 0.0, 1.0, default=0.0)
    direction: float = quantity("of the direction", "rad", 0.0, 0.5, default=0.0)


@dataclass(frozen=True, slots=True)
class ArmTruth:
    """How the arm really stands and moves."""

    base_offset: tuple[float, float, float] = quantity(
        "true minus configured base pose: m, m, rad", "", -0.05, 0.05, default=(0.0, 0.0, 0.0)
    )
    joint_offset: tuple[float, float, float, float] = quantity(
        "true minus reported joints: rad, rad, m, rad", "", -0.05, 0.05, default=(0.0,) * 4
    )
    backlash: tuple[float, float, float, float] = quantity(
        "full play of the drives: rad, rad, m, rad", "", 0.0, 0.05, default=(0.0,) * 4
    )
    repeatability: tuple[float, float, float, float] = quantity(
        "standard deviation of where a target ends: rad, rad, m, rad",
        "",
        0.0,
        0.05,
        default=(0.0,) * 4,
    )
    holds: tuple[float, float, float] | None = quantity(
        "pose of the object on the striker, where the arm holds it to be calibrated: m, m, rad",
        "",
        -7.0,
        7.0,
        default=None,
    )


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """How the camera really is, against its calibration file."""

    position: tuple[float, float, float] = quantity(
        "of the lens in table", "m", -3.0, 3.0, default=(0.02, -0.015, 0.7)
    )
    aim: tuple[float, float] = quantity(
        "where the optical axis meets the table", "m", -3.0, 3.0, default=(0.0, 0.0)
    )
    turn: float = quantity("of the image about its axis", "rad", -7.0, 7.0, default=0.01)
    focal_factor: float = quantity("true over calibrated", "", 0.9, 1.1, default=1.0)
    distortion_offset: float = quantity(
        "added to the first radial coefficient", "", -0.2, 0.2, default=0.0
    )
    noise: float = quantity("standard deviation of a pixel", "grey levels", 0.0, 20.0, default=2.0)
    light_falloff: float = quantity(
        "light lost from the brightest to the darkest side", "", 0.0, 0.9, default=0.3
    )
    exposure: float = quantity("time of exposure", "s", 0.0001, 0.03, default=0.006)
    latency: float = quantity("from exposure to publication", "s", 0.0, 0.5, default=0.015)


@dataclass(frozen=True, slots=True)
class TruthFile:
    """The simulated world's own parameters."""

    object_start: tuple[float, float, float] = quantity(
        "x and y in m and theta in rad of the object when the world begins", "", -7.0, 7.0
    )
    support: SupportTruth = section("support of the object", default=SupportTruth())
    impact: ImpactTruth = section("impact", default=ImpactTruth())
    scatter: ScatterTruth = section("scatter of a tap", default=ScatterTruth())
    arm: ArmTruth = section("arm", default=ArmTruth())
    camera: CameraTruth = section("camera", default=CameraTruth())
