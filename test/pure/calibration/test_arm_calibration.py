"""The arm's calibration recovers known parameters, names outliers, and reports what it cannot
determine."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import calibration_truths as truths
import numpy as np
import pytest

from tapping_cell.calibration.arm import ArmRecord, calibrate_arm, predicted
from tapping_cell.calibration.arm_places import arm_places
from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.se2 import Pose

CELL = shared_folder() / "cell.yaml"
MARK = Pose(0.010, 0.030, 0.5)


def simulated(
    seed: int, count: int = 20, noise: float = 1.0
) -> tuple[ScaraGeometry, Pose, np.ndarray]:
    """Return true parameters and a simulated record of an arm. A row of the record contains
    shoulder, elbow, tool, and the measured x, y, theta of a marker on the tip."""
    random = np.random.default_rng(seed)
    geometry = ScaraGeometry(joint_offset=(0.0, random.normal(0, 0.01), 0.0, 0.0))
    base = Pose(random.normal(0, 0.02), 0.47, -math.pi / 2 + random.normal(0, 0.05))
    rows = []
    while len(rows) < count:
        q = random.uniform([-1.3, -2.3, -0.1, -2.5], [1.3, 2.3, 0.0, 2.5])
        tip = geometry.forward(q)
        seen = base @ Pose(tip.x, tip.y, tip.yaw) @ MARK
        if abs(seen.x) < 0.29 and abs(seen.y) < 0.21:
            shake = noise * np.array([1e-4, 1e-4, math.radians(0.1)]) * random.standard_normal(3)
            rows.append([q[0], q[1], q[3], *(np.array(seen) + shake)])
    return geometry, base, np.array(rows)


def as_record(rows: np.ndarray, angles: bool = True) -> ArmRecord:
    numbers = np.arange(2, len(rows) + 2)
    return ArmRecord(rows[:, :3], rows[:, 3:5], rows[:, 5] if angles else None, numbers)


def write(path: Path, rows: np.ndarray) -> Path:
    lines = ["shoulder,elbow,tool,x_mm,y_mm,theta_deg"]
    scale = np.array([1, 1, 1, 1e3, 1e3, math.degrees(1)])
    lines += [",".join(f"{value:.6f}" for value in row * scale) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("angles", [True, False])
def test_without_noise_the_true_parameters_are_recovered(angles: bool) -> None:
    geometry, base, rows = simulated(1, noise=0.0)
    result = calibrate_arm(as_record(rows, angles), ScaraGeometry())
    v = result.values
    assert (v["base_x"], v["base_y"]) == pytest.approx((base.x, base.y), abs=1e-6)
    assert math.remainder(v["base_yaw"] - base.theta, 2 * math.pi) == pytest.approx(0, abs=1e-6)
    assert v["elbow_zero"] == pytest.approx(geometry.joint_offset[1], abs=1e-6)


def test_twenty_noisy_poses_reach_the_target_accuracy(tmp_path: Path) -> None:
    for seed in range(2):
        geometry, base, rows = simulated(seed)
        output = tmp_path / f"cell{seed}.yaml"
        record = write(tmp_path / "poses.csv", rows)
        place = [str(MARK.x * 1e3), str(MARK.y * 1e3), str(math.degrees(MARK.theta))]
        words = ["calibrate", "arm", str(record), "--cell", str(CELL), "--output", str(output)]
        assert main([*words, "--marker-on-tip", *place]) == 0
        # Forward kinematics with the calibrated cell file gives the true tip, at poses that were
        # not measured.
        cell = load_cell(output)
        calibrated = cell.arm.geometry()
        for row in simulated(100 + seed, count=30)[2]:
            joints = [row[0], row[1], -0.05, row[2]]
            a, b = geometry.forward(joints), calibrated.forward(joints)
            true = base @ Pose(a.x, a.y, a.yaw)
            fitted = cell.arm_base @ Pose(b.x, b.y, b.yaw)
            assert true.distance_to(fitted) < 2e-4
            assert abs(true.rotation_to(fitted)) < math.radians(0.09)
        assert cell.arm.calibration is not None
        assert cell.arm.calibration.residual == pytest.approx(1.4e-4, rel=0.5)


def test_outliers_are_named_by_row_and_do_not_affect_the_result(tmp_path: Path) -> None:
    _, _, rows = simulated(3)
    clean = calibrate_arm(as_record(np.delete(rows, [4, 11], axis=0)), ScaraGeometry())
    rows[4, 3] += 0.030
    rows[11, 5] += 0.2
    result = calibrate_arm(as_record(rows), ScaraGeometry())
    assert [outlier.row for outlier in result.outliers] == [6, 13]
    for name, value in clean.values.items():
        assert result.values[name] == pytest.approx(value, abs=1e-9)


def test_standard_deviations_match_the_errors() -> None:
    ratios = []
    for seed in range(15):
        random = np.random.default_rng(seed)
        truth = truths.arm(random)
        record = truths.arm_record(random, truth, 20, 1e-4, math.radians(0.1))
        result = calibrate_arm(record, ScaraGeometry())
        ratios += [
            (result.values[name] - truth[name]) / result.deviations[name]
            for name in ("base_x", "base_y", "elbow_zero", "mount_x")
        ]
    assert 0.8 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.35


def test_parameters_not_determined_by_the_poses_are_fixed_and_reported() -> None:
    random = np.random.default_rng(5)
    truth = truths.arm(random)
    record = truths.arm_record(random, truth, 20, 1e-4, math.radians(0.1))
    stiff = replace(record, joints=np.column_stack([record.joints[:, :2], np.zeros(20)]))
    points, angles = truths.predicted(stiff.joints, truth)
    stiff = replace(stiff, points=np.stack([points.real, points.imag], axis=1), angles=angles)
    result = calibrate_arm(stiff, ScaraGeometry())
    # The tool never turns relative to the forearm, so its forward offset and the forearm's length
    # cannot be separated.
    linked = calibrate_arm(stiff, ScaraGeometry(), links=True)
    assert "forearm" in linked.held
    assert any("forearm" in note and "kept" in note for note in linked.notes)
    assert result.position_rms < 1e-4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[:5], "too few"),
        (lambda rows: np.repeat(rows[:1], 12, axis=0), "1 different poses"),
        (lambda rows: rows[:, [1, 0, 2, 4, 3, 5]], "no arm|consistent"),
    ],
)
def test_unsuitable_records_are_refused_with_a_message(change, words: str) -> None:
    _, _, rows = simulated(2)
    with pytest.raises(CalibrationRefused, match=words):
        calibrate_arm(as_record(change(rows)), ScaraGeometry())


def test_the_verb_refuses_wrong_units_and_keeps_the_file(tmp_path: Path, capsys) -> None:
    record = write(tmp_path / "poses.csv", simulated(2)[2])
    output = tmp_path / "cell.yaml"
    words = ["--cell", str(CELL), "--output", str(output)]
    text = record.read_text()
    record.write_text(text.replace("x_mm", "x"))
    assert main(["calibrate", "arm", str(record), *words]) == 2
    assert "name the column x_mm" in capsys.readouterr().err
    assert not output.exists()
    record.write_text(text)
    assert main(["calibrate", "arm", str(record), *words]) == 0
    before = output.read_text()
    assert "# beyond the table's far edge" in before  # comments are kept
    assert main(["calibrate", "arm", str(record), *words]) == 2
    noisy = write(tmp_path / "noisy.csv", simulated(2, noise=4.0)[2])
    assert main(["calibrate", "arm", str(noisy), *words, "--force"]) == 2
    assert "more accurate than the new one and was kept" in capsys.readouterr().err
    assert output.read_text() == before
    assert main(["calibrate", "arm", str(noisy), *words, "--force", "--accept-worse"]) == 0
    assert output.read_text() != before


@pytest.mark.parametrize("base", [Pose(0.0, 0.47, -math.pi / 2), Pose(-0.55, 0.05, 0.2)])
def test_recording_poses_are_within_limits_and_determine_every_parameter(base: Pose) -> None:
    geometry = ScaraGeometry(joint_offset=(0.01, -0.02, 0.0, 0.03))
    places = arm_places(geometry, base, (0.25, 0.2), 0.05, 20)
    assert places == arm_places(geometry, base, (0.25, 0.2), 0.05, 20) and len(places) == 20
    for joints in places:
        tip = geometry.forward(joints)
        at = base @ Pose(tip.x, tip.y, tip.yaw)
        assert abs(at.x) <= 0.25 and abs(at.y) <= 0.2 and tip.z == pytest.approx(0.05)
        assert geometry.limit_excess(joints)[1] == 0.0
    turned = np.array(places)
    assert (turned[:, 1] > 0.3).any() and (turned[:, 1] < -0.3).any()
    truth = truths.arm(np.random.default_rng(1)) | {"base_x": base.x, "base_y": base.y}
    truth |= {"base_yaw": base.theta}
    joints = turned[:, [0, 1, 3]]
    points, angles = predicted(joints, truth)
    record = ArmRecord(
        joints, np.stack([points.real, points.imag], axis=1), angles, np.arange(2, 22)
    )
    result = calibrate_arm(record, ScaraGeometry())
    assert not result.held and result.wrist_deviation < 5e-5


def test_a_table_out_of_reach_has_no_recording_poses() -> None:
    assert arm_places(ScaraGeometry(), Pose(0.0, 5.0, 0.0), (0.1, 0.1), 0.05, 5) == []
