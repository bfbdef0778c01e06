"""Parameters of the simulated world that planners do not receive: ``config/truth/*.yaml``.

Factors multiply the values of the object, cell and camera files, and offsets are added to them, so
that one file applies to every object.
"""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.schema import choice, quantity, section, text


@dataclass(frozen=True, slots=True)
class SupportTruth:
    """True support of the object on the table."""

    friction_factor: float = quantity("true over configured friction", "", 0.1, 10.0, default=1.0)
    torque_factor_factor: float = quantity(
        "true over configured torque factor", "", 0.05, 20.0, default=1.0
    )
    pressure: str = choice(
        "where the weight rests: evenly on the whole underside, on the rim, on three points, or on "
        "a grid of pads",
        "even",
        "rim",
        "three_points",
        "pads",
        default="even",
    )
    edge_weight: float = quantity(
        "extra pressure at the rim relative to the middle", "", 0.0, 20.0, default=0.0
    )
    feet_radius: float = quantity(
        "distance of three points from the middle, over that of the outline",
        "",
        0.05,
        1.0,
        default=0.8,
    )
    feet_turn: float = quantity(
        "direction of the first of three points in the object", "rad", -7.0, 7.0, default=0.0
    )
    pads: int = quantity("pads along the longer side of the object", "", 3, 40, default=9)
    pad_scatter: float = quantity(
        "standard deviation of the logarithm of a pad's load", "", 0.0, 3.0, default=0.5
    )
    pad_seed: int = quantity("seed of the pads' loads", "", 0, 2**31 - 1, default=1)
    lean: tuple[float, float] = quantity(
        "friction of the underside larger towards +x and +y of the object",
        "",
        -1.0,
        1.0,
        default=(0.0, 0.0),
    )
    mass_offset: tuple[float, float] = quantity(
        "x and y of the centre of mass in the object's frame", "m", -0.2, 0.2, default=(0.0, 0.0)
    )
    inertia_factor: float = quantity(
        "true moment of inertia over that of a uniform object", "", 0.1, 3.0, default=1.0
    )
    slope: tuple[float, float] = quantity(
        "tilt of the table, downhill along +x and +y", "rad", -0.05, 0.05, default=(0.0, 0.0)
    )


@dataclass(frozen=True, slots=True)
class PatchTruth:
    """A round patch of the table with different friction."""

    middle: tuple[float, float] = quantity("x and y in table", "m", -3.0, 3.0)
    radius: float = quantity("radius", "m", 0.001, 3.0)
    factor: float = quantity("friction over that of the table", "", 0.05, 20.0)


@dataclass(frozen=True, slots=True)
class SurfaceTruth:
    """Dependence of the table's friction on direction, speed and place."""

    anisotropy: float = quantity(
        "friction across the grain over that along it", "", 0.2, 5.0, default=1.0
    )
    grain: float = quantity("direction of the grain in table", "rad", -7.0, 7.0, default=0.0)
    slow_rise: float = quantity(
        "friction of a creeping point over that of a fast one, less 1", "", -0.9, 5.0, default=0.0
    )
    slow_speed: float = quantity(
        "speed at which the slow rise has fallen to a third (1 / e)",
        "m/s",
        0.001,
        5.0,
        default=0.02,
    )
    viscous: float = quantity(
        "relative rise of the friction with the speed", "s/m", 0.0, 20.0, default=0.0
    )
    patches: tuple[PatchTruth, ...] = section(
        "patches with another friction; where they overlap the factors multiply", default=()
    )


@dataclass(frozen=True, slots=True)
class ImpactTruth:
    """True impact between striker and object."""

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
    contact_time: float = quantity(
        "duration of a central impact, if it were elastic", "s", 0.00002, 0.005, default=0.0002
    )
    tangential_stiffness: float = quantity(
        "stiffness of the contact along the tangent over that along the normal; 0 for rigid",
        "",
        0.0,
        2.0,
        default=0.0,
    )
    oblique_loss: float = quantity(
        "share of the restitution that a grazing impact loses (by the sine squared of its angle)",
        "",
        0.0,
        1.0,
        default=0.0,
    )
    follow_through: float = quantity(
        "time after the first touch for which the striker goes on, to the end of its stroke at "
        "most, before it is drawn back",
        "s",
        0.0,
        2.0,
        default=0.1,
    )


@dataclass(frozen=True, slots=True)
class ScatterTruth:
    """Standard deviations of the random errors of each tap."""

    speed: float = quantity("of the launch speed, relative", "", 0.0, 0.5, default=0.0)
    spin: float = quantity("of the launch spin, relative", "", 0.0, 1.0, default=0.0)
    direction: float = quantity("of the direction", "rad", 0.0, 0.5, default=0.0)


@dataclass(frozen=True, slots=True)
class ArmTruth:
    """True pose and motion errors of the arm."""

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
class MountsTruth:
    """True lines of travel of fixed tappers, drawn at random around those of the cell file."""

    offset: float = quantity(
        "standard deviation of a line beside its place", "m", 0.0, 0.01, default=0.0002
    )
    angle: float = quantity(
        "standard deviation of a line's direction", "rad", 0.0, 0.1, default=0.002
    )


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """True parameters of the camera, compared with its calibration file."""

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
    shows_arm: bool = text("the picture shows the arm over the table", default=False)
    latency: float = quantity("from exposure to publication", "s", 0.0, 0.5, default=0.015)


@dataclass(frozen=True, slots=True)
class TruthFile:
    """Parameters of the simulated world."""

    object_start: tuple[float, float, float] = quantity(
        "x and y in m and theta in rad of the object when the world begins", "", -7.0, 7.0
    )
    support: SupportTruth = section("support of the object", default=SupportTruth())
    surface: SurfaceTruth = section("friction of the table", default=SurfaceTruth())
    impact: ImpactTruth = section("impact", default=ImpactTruth())
    scatter: ScatterTruth = section("scatter of a tap", default=ScatterTruth())
    arm: ArmTruth = section("arm", default=ArmTruth())
    mounts: MountsTruth = section("mounts of fixed tappers", default=MountsTruth())
    camera: CameraTruth = section("camera", default=CameraTruth())
    further_starts: tuple[tuple[float, float, float], ...] = quantity(
        "the same of the cell's further objects, in their order; those without one begin at random "
        "free places",
        "",
        -7.0,
        7.0,
        default=(),
    )
