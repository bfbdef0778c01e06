"""Speed and accuracy of computed slides: the lookup table, an ODE solver with the same closed-form
friction, and MuJoCo.

Times are the best of several repetitions on one core. Each time is reported with the relative error
of distance and rotation, compared with an integration at a tolerance of 1e-12.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from sliding_reference import disk_force_and_torque

from tapping_cell.mechanics import Disk, Polygon, Sliding
from tapping_cell.mechanics.slide_table import SlideTable

_DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
_FRICTION = 0.17
_GRAVITY = 9.81
_KAPPA = 3.64
_MANY = 1_000_000
_POLYGONS = 2_000
_LAUNCHES = 12
_MUJOCO_LAUNCHES = 4
_MUJOCO_FEET = 61
_TIGHT = 1e-12
# Tolerance of solve_ivp for the comparison of computing times. With this tolerance, the largest
# errors of solve_ivp and of the table are about equal (a few 1e-10).
_EQUAL = 1e-10


def measure() -> dict:
    """Return the results by name: times (s), rates (1/s), relative errors, and ratios of rates."""
    sliding = Sliding(_DISK, _FRICTION, _KAPPA, _GRAVITY)
    report = {
        "table_build_s": _best(lambda: SlideTable("disk", _KAPPA * _DISK.gamma), 5),
        **_rates(sliding),
        **_polygon_table_rates(),
    }
    report["solve_ivp"] = _against_solve_ivp(sliding, report["forward_per_s"])
    report["mujoco"] = _against_mujoco()
    return report


def lines(report: dict) -> list[str]:
    """Format the report as lines of text."""
    peer = report["solve_ivp"]
    text = [
        f"table for a new shape and torque factor: {1e3 * report['table_build_s']:.1f} ms",
        f"forward: {report['forward_per_s']:.3g} taps/s; inverse: "
        f"{report['inverse_per_s']:.3g} taps/s; round trip to {report['round_trip_error']:.1e}",
        f"forward error: {peer['table_error']:.1e} of distance and rotation",
        f"polygon by its table: {report['polygon_table_per_s']:.3g} slides/s of processor time, "
        f"error {report['polygon_table_error']:.1e}, made in "
        f"{report['polygon_table_build_s']:.1f} s",
        f"solve_ivp: {1e3 * peer['seconds']:.1f} ms a tap at an error of {peer['error']:.1e}; "
        f"the table is {peer['ratio']:.3g} times as fast in a million",
    ]
    mujoco = report["mujoco"]
    if "skipped" in mujoco:
        return [*text, f"MuJoCo: skipped, {mujoco['skipped']}"]
    for peer in mujoco["models"]:
        text.append(
            f"MuJoCo {mujoco['version']}, {peer['model']}, torque factor 1: "
            f"{1e3 * peer['seconds']:.1f} ms a tap, error {peer['distance_error']:.1e} of the "
            f"distance and {peer['rotation_error']:.1e} of the rotation; the table is "
            f"{peer['ratio']:.3g} times as fast in a million"
        )
    return text


def _best(task: Callable[[], object], repetitions: int) -> float:
    """Return the time of the fastest repetition, in s."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return min(times)


def _rates(sliding: Sliding) -> dict:
    generator = np.random.default_rng(1)
    speed = generator.uniform(-1.0, 1.0, _MANY)
    spin = generator.uniform(-20.0, 20.0, _MANY)
    distance, rotation, _ = sliding.rest(speed, spin)

    back = sliding.rest(*sliding.launch(distance, rotation))
    return {
        "forward_per_s": _MANY / _best(lambda: sliding.rest(speed, spin), 5),
        "inverse_per_s": _MANY / _best(lambda: sliding.launch(distance, rotation), 5),
        "round_trip_error": float(
            max(np.abs(back[0] / distance - 1).max(), np.abs(back[1] / rotation - 1).max())
        ),
    }


def _polygon_table_rates() -> dict[str, float]:
    """Return the building time, the rate and the largest relative error of the table of a scalene
    triangle. This table cannot be reduced by symmetry."""
    triangle = Polygon([(0, 0), (0.1, 0), (0, 0.07)], 0.2, 0.01)
    start = time.process_time()
    exact = Sliding(triangle, _FRICTION, _KAPPA, _GRAVITY)
    table = exact.tabulated()
    built = time.process_time() - start
    twist = np.random.default_rng(2).uniform(-1, 1, (_MANY, 3)) * [0.3, 0.3, 8.0]
    spent = math.inf
    for _ in range(3):
        start = time.process_time()
        table.displace(twist)
        spent = min(spent, time.process_time() - start)
    few = twist[:_POLYGONS]
    true, tabulated = exact.displace(few), table.displace(few)
    scale = np.array([1.0, 1.0, triangle.radius_of_gyration])
    error = np.linalg.norm((tabulated - true) * scale, axis=1) / np.linalg.norm(
        true * scale, axis=1
    )
    return {
        "polygon_table_build_s": built,
        "polygon_table_per_s": _MANY / spent,
        "polygon_table_error": float(error.max()),
    }


def _launches(count: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(3)
    return generator.uniform(0.1, 0.5, count), generator.uniform(0.5, 5.0, count)


def _against_solve_ivp(sliding: Sliding, forward_per_s: float) -> dict:
    speeds, spins = _launches(_LAUNCHES)
    exact = np.array([_solve(v, w, _KAPPA, _TIGHT) for v, w in zip(speeds, spins, strict=True)])
    start = time.perf_counter()
    equal = np.array([_solve(v, w, _KAPPA, _EQUAL) for v, w in zip(speeds, spins, strict=True)])
    seconds = (time.perf_counter() - start) / _LAUNCHES
    table = np.array(sliding.rest(speeds, spins)[:2]).T
    return {
        "seconds": seconds,
        "error": float(np.abs(equal / exact - 1).max()),
        "table_error": float(np.abs(table / exact - 1).max()),
        "ratio": seconds * forward_per_s,
    }


def _solve(speed: float, spin: float, kappa: float, tolerance: float) -> tuple[float, float]:
    """Integrate distance and rotation with ``solve_ivp`` and the textbook formulas, which contain
    the complete elliptic integrals K and E.

    The integration variable is the logarithm of the speed, so that the solution is smooth at the
    end of the slide. The integration ends at 1e-7 of the initial speed; the omitted distance is
    1e-14 of the total.
    """
    r, g, gain = _DISK.radius, _FRICTION * _GRAVITY, kappa * _DISK.gamma

    def rates(_: float, state: np.ndarray) -> list[float]:
        v, s = math.exp(state[0]), math.exp(state[1])
        force, torque = disk_force_and_torque(v / s)
        size = math.hypot(v, s)
        per = size / max(force, gain * torque)
        return [-force * per / v, -gain * torque * per / s, v * per, s * per]

    def stopped(_: float, state: np.ndarray) -> float:
        return max(state[0], state[1]) - end

    stopped.terminal = True
    start = [math.log(speed), math.log(spin * r), 0.0, 0.0]
    end = max(start[0], start[1]) - 7 * math.log(10)
    solution = solve_ivp(
        rates,
        (0.0, 1e3),
        start,
        method="DOP853",
        rtol=tolerance,
        atol=1e-3 * tolerance,
        events=stopped,
    )
    return solution.y[2, -1] / g, solution.y[3, -1] / (g * r)


def _against_mujoco() -> dict:
    try:
        import mujoco
    except ImportError:
        return {"skipped": "it is not installed (pip install mujoco)"}
    sliding = Sliding(_DISK, _FRICTION, 1.0, _GRAVITY)
    speeds, spins = _launches(_MUJOCO_LAUNCHES)
    distance, rotation, _ = sliding.rest(speeds, spins)
    generator = np.random.default_rng(4)
    v, w = generator.uniform(0.1, 0.5, _MANY), generator.uniform(0.5, 5.0, _MANY)
    per_tap = _best(lambda: sliding.rest(v, w), 3) / _MANY
    models = []
    for name, geometry in (
        ("a cylinder", _cylinder()),
        (f"{_MUJOCO_FEET} feet spread evenly", _feet()),
    ):
        model = mujoco.MjModel.from_xml_string(_scene(geometry))
        start = time.perf_counter()
        ends = np.array(
            [_simulate(mujoco, model, a, b) for a, b in zip(speeds, spins, strict=True)]
        )
        seconds = (time.perf_counter() - start) / len(speeds)
        models.append(
            {
                "model": name,
                "seconds": seconds,
                "distance_error": float(np.abs(ends[:, 0] / distance - 1).max()),
                "rotation_error": float(np.abs(ends[:, 1] / rotation - 1).max()),
                "ratio": seconds / per_tap,
            }
        )
    return {"version": mujoco.__version__, "models": models}


def _scene(geometry: str) -> str:
    inertia = _DISK.inertia
    tilt = inertia / 2 + _DISK.mass * _DISK.height**2 / 12
    return f"""<mujoco>
      <option timestep="0.001" gravity="0 0 -{_GRAVITY}" cone="elliptic" impratio="20"/>
      <worldbody>
        <geom type="plane" size="2 2 0.1" friction="{_FRICTION} 0 0"/>
        <body pos="0 0 {_DISK.height / 2}"><freejoint/>
          <inertial pos="0 0 0" mass="{_DISK.mass}" diaginertia="{tilt} {tilt} {inertia}"/>
          {geometry}
        </body>
      </worldbody>
    </mujoco>"""


def _cylinder() -> str:
    return (
        f'<geom type="cylinder" size="{_DISK.radius} {_DISK.height / 2}" '
        f'friction="{_FRICTION} 0 0" condim="3"/>'
    )


def _feet() -> str:
    """Return MuJoCo feet in a sunflower arrangement (Fermat's spiral), each of which represents the
    same area."""
    size = 5e-4
    index = np.arange(_MUJOCO_FEET) + 0.5
    radius = _DISK.radius * np.sqrt(index / _MUJOCO_FEET)
    angle = index * math.pi * (3 - math.sqrt(5))
    return "\n".join(
        f'<geom type="sphere" size="{size}" pos="{r * math.cos(a)} {r * math.sin(a)} '
        f'{size - _DISK.height / 2}" friction="{_FRICTION} 0 0" condim="3"/>'
        for r, a in zip(radius, angle, strict=True)
    )


def _simulate(mujoco, model, speed: float, spin: float) -> tuple[float, float]:
    """Return distance and rotation of one slide of a disk that has settled on the table."""
    data = mujoco.MjData(model)
    for _ in range(200):
        mujoco.mj_step(model, data)
    start = data.qpos.copy()
    data.qvel[:] = [speed, 0, 0, 0, 0, spin]
    turned, last = 0.0, _yaw(start)
    for _ in range(5000):
        mujoco.mj_step(model, data)
        yaw = _yaw(data.qpos)
        turned += (yaw - last + math.pi) % (2 * math.pi) - math.pi
        last = yaw
        if math.hypot(data.qvel[0], data.qvel[1]) < 1e-4 and abs(data.qvel[5]) < 1e-3:
            break
    moved = data.qpos[:2] - start[:2]
    return float(np.hypot(*moved)), turned


def _yaw(qpos: np.ndarray) -> float:
    w, x, y, z = qpos[3:7]
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
