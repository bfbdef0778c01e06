"""What a report says about launches that the camera saw, and about what was learnt from them."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_bags import STOPS, MadeRun

from tapping_cell.configuration.files import shared_folder
from tapping_cell.mechanics import Sliding
from tapping_cell.planning import CameraNoise, Gains, Scatter
from tapping_cell.planning.gains import Slid
from tapping_cell.report.learnt_words import launch_words, learnt_words, object_of
from tapping_cell.report.run import Launch, Learnt
from tapping_cell.report.run_page import page
from tapping_cell.report.run_reader import IllustratedRun, read_illustrated_run
from tapping_cell.report.velocity_chart import velocity_chart
from tapping_cell.se2 import Pose

FILE = shared_folder() / "objects" / "aluminium_disk.yaml"
DISK = object_of({"cell.yaml": "name: a cell", str(FILE): FILE.read_text()}, "aluminium disk")


def learnt_from(friction: float, torque: float) -> Learnt:
    """Return what is learnt from tracks of an object with these ratios of friction and torque."""
    assert DISK is not None
    body = DISK.body()
    true = Sliding(body, friction * DISK.friction, torque * DISK.torque_factor)
    model = Sliding(body, DISK.friction, DISK.torque_factor)
    asked, gains = np.array([0.03, 0.0, math.radians(8.0)]), Gains.start()
    speed, spin = model.launch(asked[0], asked[2])
    rest, expected = true.rest(speed, spin), model.rest(speed, spin)
    seen = np.array([rest.distance, 0.0, rest.rotation])
    slope = expected.rotation / expected.distance
    slid = Slid(*np.array([expected.distance, slope, 0.02, 0.02]))
    for _ in range(4):
        gains = gains.observe(asked, seen, 0.0, Scatter(), CameraNoise(1e-5, 1e-4), slid)
    numbers = gains.as_numbers()
    return Learnt(**{name: numbers[name] for name in Learnt.__dataclass_fields__})


@pytest.mark.parametrize(("friction", "torque"), [(1.0, 1.0), (1.8, 1.0), (0.4, 0.7), (1.0, 1.4)])
def test_the_friction_and_the_torque_factor_are_those_of_the_slides(friction, torque) -> None:
    learnt = learnt_from(friction, torque)
    words = learnt_words(learnt, DISK).split("; ")
    numbers = [[float(word) for word in re.findall(r"[\d.]+", text)] for text in words]
    assert words[0].endswith("(object file 0.17)") and words[1].endswith("(object file 3.64)")
    assert abs(numbers[0][0] - 0.17 * friction) < 3.0 * numbers[0][1] < 0.05
    off = abs(numbers[1][0] - 3.64 * torque)
    assert off < 3.0 * numbers[1][1] and off < 0.1 + 0.7 * abs(3.64 - 3.64 * torque)
    assert "impact as fast as the model" in words[2]
    assert learnt_words(learnt, None).startswith("friction ")


def test_a_slow_launch_is_compared_with_the_model() -> None:
    launch = Launch(12, 0.240, 0.002, 1.0, 0.05, 1.70, 0.03, 0.250, 1.2, 1.66)
    assert launch_words(launch) == (
        "240 \u00b1 2 mm/s, 4 % slower than the model (250 mm/s); 57 \u00b1 3 deg/s (model 69 "
        "deg/s); deceleration 1.70 \u00b1 0.03 m/s\u00b2 (model 1.66 m/s\u00b2), from 12 poses"
    )
    assert "deg/s" not in launch_words(replace(launch, spin=math.nan))


def with_a_slide(folder: Path) -> IllustratedRun:
    """Return a run whose first tap has a track of 120 Hz."""
    read = read_illustrated_run(MadeRun(STOPS).write(folder) / "bag")
    tap = read.run.taps[0]
    launch = Launch(28, 0.402, 0.004, -1.2, 0.1, 1.55, 0.03, 0.420, -1.3, 1.668)
    way = np.array([STOPS[1].x - STOPS[0].x, STOPS[1].y - STOPS[0].y])
    way *= launch.speed**2 / (2.0 * launch.deceleration) / np.hypot(*way)
    poses = []
    for at in np.arange(tap.fired_at - 0.1, tap.at_rest_at, 1.0 / 120.0):
        left = np.clip(1.0 - (at - tap.fired_at) * launch.deceleration / launch.speed, 0.0, 1.0)
        poses.append((float(at), Pose(*(STOPS[0][:2] + way * (1.0 - left**2)), STOPS[0].theta)))
    learnt = learnt_from(0.7, 1.2)
    taps = (replace(tap, launch=launch, learnt=learnt), *read.run.taps[1:])
    run = replace(read.run, taps=taps, files={str(FILE): FILE.read_text()})
    first = replace(run.first, name="aluminium disk")
    run = replace(run, objects=(first, *run.objects[1:]))
    return replace(read, run=run, tracks={first.name: poses})


def test_the_speed_during_a_slide_lies_on_the_line_of_its_launch(tmp_path: Path) -> None:
    seen = with_a_slide(tmp_path)
    chart = velocity_chart(seen.run.taps[0], seen.tracks["aluminium disk"])
    assert chart is not None
    (_, _, model), (_, _, line) = chart["lines"]
    dots = [dot for dot in chart["dots"][0][1] if line[0][0] < dot[0] < line[1][0]]
    assert len(dots) > 20 and model[0][1] < line[0][1]
    slope = (line[1][1] - line[0][1]) / (line[1][0] - line[0][0])
    assert all(y == pytest.approx(line[0][1] + slope * (x - line[0][0]), abs=3.0) for x, y in dots)
    assert velocity_chart(seen.run.taps[1], seen.tracks["aluminium disk"]) is None
    text = page(seen)
    assert text.count("speed during the slide") == 2 and "times that of" not in text
    assert "friction 0.1" in text and "4 % slower than the model (420 mm/s)" in text
