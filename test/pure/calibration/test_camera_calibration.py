"""The camera's calibration: known parameters are recovered, and unsuitable views and sets are
refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import calibration_truths as truths
import cv2
import numpy as np
import pytest
import yaml

from tapping_cell.calibration.camera import CalibrationRefused, calibrate_camera
from tapping_cell.calibration.camera_file import camera_info_yaml
from tapping_cell.calibration.target import Target, TargetError, TargetView, find_target
from tapping_cell.cli import main
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.simulation.rendered_sheet import SheetCamera
from tapping_cell.vision import CameraModel, CameraPose, View

TARGET = Target("charuco", 10, 7, 0.025, 0.01875, "4X4_250")
SMALL = CameraModel(640, 480, 560.0, 561.0, 322.0, 238.0, (-0.15, 0.05, 0.0003, -0.0002, 0.0))


def views_of(
    seed: int, count: int = 20, noise: float = 0.05
) -> tuple[CameraModel, list[TargetView]]:
    random = np.random.default_rng(seed)
    model = truths.camera(random)
    return model, truths.corner_views(random, model, TARGET, count, noise)


def calibrated(model: CameraModel, views: list[TargetView], **options):
    return calibrate_camera(views, TARGET, (model.width, model.height), **options)


def test_twenty_views_reach_the_target_accuracy() -> None:
    for seed in (1, 2):
        model, views = views_of(seed)
        result = calibrated(model, views)
        assert result.rms < 0.1
        assert result.model.fx == pytest.approx(model.fx, rel=0.002)
        assert result.model.fy == pytest.approx(model.fy, rel=0.002)
        for name in ("fx", "fy", "cx", "cy"):
            error = getattr(result.model, name) - getattr(model, name)
            assert abs(error) < 4.5 * result.deviations[name]
        # Compare the complete lens model by its projection of points in the image.
        rays = model.rays(np.random.default_rng(0).uniform([20, 20], [1260, 1000], (50, 2)))
        points = np.concatenate([rays, np.ones((50, 1))], axis=1)
        assert np.abs(result.model.project(points) - model.project(points)).max() < 1.5


def test_inconsistent_views_are_named_with_their_reason() -> None:
    model, views = views_of(3, count=12)
    random = np.random.default_rng(0)
    stranger = replace(views[2], name="stranger", pixels=views[2].pixels * [1.06, 1.0])
    mixed = replace(views[5], name="mixed", pixels=random.permutation(views[5].pixels))
    duplicate = replace(views[7], name="twin", pixels=views[7].pixels + 0.3)
    soft = replace(views[9], name="soft", blur=9.0)
    clean = calibrated(model, views)
    result = calibrated(model, [*views, stranger, mixed, duplicate, soft])
    reasons = {entry.name: entry.reason for entry in result.rejected}
    assert set(reasons) == {"stranger", "mixed", "twin", "soft"}
    assert reasons["stranger"].startswith("outlier")
    assert reasons["mixed"].startswith("outlier")
    assert reasons["twin"].startswith("duplicate") and views[7].name in reasons["twin"]
    assert reasons["soft"].startswith("blurred")
    assert result.model.fx == pytest.approx(clean.model.fx, rel=1e-6)


def test_a_lens_that_needs_it_gets_the_rational_model() -> None:
    random = np.random.default_rng(5)
    # Coefficients of an equidistant lens, whose factor atan(r) / r is approximated by the quotient
    # (15 + 4 r^2) / (15 + 9 r^2).
    lens = (4 / 15, 0.0, 0.0, 0.0, 0.0, 0.6, 0.0, 0.0)
    wide = CameraModel(1280, 960, 750.0, 750.0, 640.0, 480.0, lens, "rational_polynomial")
    views = truths.corner_views(random, wide, TARGET, 16, 0.05)
    result = calibrated(wide, views)
    assert result.model.distortion_model == "rational_polynomial"
    assert result.model.fx == pytest.approx(wide.fx, rel=0.004)
    plain = calibrated(wide, views, lens_model="plumb_bob")
    assert plain.model.distortion_model == "plumb_bob"
    assert plain.rms > result.rms


def flat_views() -> list[TargetView]:
    random = np.random.default_rng(1)
    views = []
    for number in range(12):
        place = (*random.uniform(-0.05, 0.05, 2), random.uniform(0.4, 0.6))
        pose = CameraPose.above(place, place[:2], random.uniform(-3, 3))
        pixels = View(SMALL, pose).project(truths.corners_of(TARGET))
        noisy = pixels + 0.05 * random.standard_normal(pixels.shape)
        views.append(TargetView(f"view {number}", np.arange(len(noisy)), noisy, 0.8, 30.0))
    return views


@pytest.mark.parametrize(
    ("views", "words"),
    [
        (lambda: views_of(4, count=5)[1], "too few"),
        (lambda: [views_of(4, count=1)[1][0]] * 20, "duplicate"),
        (flat_views, "faces the camera"),
        (lambda: views_of(4, count=12, noise=1.0)[1], "limit 1"),
    ],
)
def test_unsuitable_image_sets_are_refused_with_a_message(views, words: str) -> None:
    with pytest.raises(CalibrationRefused, match=words):
        calibrated(SMALL, views())


@pytest.mark.parametrize(
    "arguments",
    [
        ("circles", 9, 7, 0.025),
        ("chessboard", 2, 7, 0.025),
        ("chessboard", 9, 7, 25.0),
        ("charuco", 9, 7, 0.025, 0.030, "4X4_250"),
        ("charuco", 30, 30, 0.025, 0.018, "4X4_50"),
    ],
)
def test_impossible_targets_are_refused(arguments) -> None:
    with pytest.raises(TargetError):
        Target(*arguments)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write eight photographs of a chessboard, one of an empty table, and a blurred one."""
    folder = tmp_path_factory.mktemp("photographs")
    target = Target("chessboard", 9, 7, 0.025)
    random, eye = np.random.default_rng(2), SheetCamera(SMALL, 1)
    sheet = truths.target_sheet(target)
    number = 0
    while number < 8:
        image = eye.photograph(sheet, truths.view_pose(random, SMALL, sheet.size))
        if isinstance(find_target(image, target, ""), str):
            continue
        cv2.imwrite(str(folder / f"view{number}.png"), image)
        number += 1
    cv2.imwrite(str(folder / "blurred.png"), cv2.GaussianBlur(image, (0, 0), 4.0))
    cv2.imwrite(str(folder / "empty.png"), np.full((480, 640), 120, dtype=np.uint8))
    return folder


def test_the_verb_writes_what_ros_and_the_nodes_read(
    photographs: Path, tmp_path: Path, capsys
) -> None:
    output = tmp_path / "camera_info.yaml"
    words = ["--target", "chessboard", "--square-size", "25", "--output", str(output)]
    one = ["calibrate", "camera", str(photographs / "view0.png"), *words]
    assert main([*one, "--squares", "8x6"]) == 1  # inner corners were given instead of squares
    assert "--corners 8x6" in capsys.readouterr().err
    words = ["calibrate", "camera", str(photographs), *words, "--squares", "9x7"]
    assert main([*words, "--annotate", str(tmp_path / "drawn")]) == 0
    text = capsys.readouterr().out
    assert "left out: empty.png: no target" in text
    assert "left out: blurred.png: blurred" in text
    model = load_camera_model(output)
    assert model.fx == pytest.approx(SMALL.fx, rel=0.01)
    document = yaml.safe_load(output.read_text())
    for name, rows, columns in (
        ("camera_matrix", 3, 3),
        ("distortion_coefficients", 1, 5),
        ("rectification_matrix", 3, 3),
        ("projection_matrix", 3, 4),
    ):
        assert (document[name]["rows"], document[name]["cols"]) == (rows, columns)
        assert len(document[name]["data"]) == rows * columns
    assert document["calibration"]["residual"] < 0.1
    assert (tmp_path / "drawn" / "coverage.png").is_file()
    assert (tmp_path / "drawn" / "view3.png").is_file()


def test_images_of_another_size_are_named(photographs: Path, tmp_path: Path, capsys) -> None:
    odd = tmp_path / "odd.png"
    cv2.imwrite(str(odd), np.zeros((400, 640), dtype=np.uint8))
    words = ["calibrate", "camera", str(photographs), str(odd), "--target", "chessboard"]
    words += ["--squares", "9x7", "--square-size", "25", "--output", str(tmp_path / "c.yaml")]
    assert main(words) == 1
    assert "odd.png (640 x 400)" in capsys.readouterr().err


def test_annotating_never_replaces_or_adds_to_the_photographs(
    photographs: Path, tmp_path: Path, capsys
) -> None:
    before = {path: path.read_bytes() for path in photographs.iterdir()}
    words = ["calibrate", "camera", str(photographs), "--target", "chessboard", "--squares", "9x7"]
    words += ["--square-size", "25", "--output", str(tmp_path / "camera_info.yaml")]
    assert main([*words, "--annotate", f"{photographs}/../{photographs.name}"]) == 2
    assert "is the folder of the input images" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in photographs.iterdir()} == before


def test_photographs_with_equal_names_are_distinguished(
    photographs: Path, tmp_path: Path, capsys
) -> None:
    views = sorted(photographs.glob("view*.png"))
    for number, view in enumerate(views):
        path = tmp_path / ("a" if number < 4 else "b") / f"{number % 4}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(view.read_bytes())
    (tmp_path / "a" / "coverage.png").write_bytes((photographs / "empty.png").read_bytes())
    output, drawn = tmp_path / "camera_info.yaml", tmp_path / "drawn"
    folders = [str(tmp_path / "a"), str(tmp_path / "b")]
    words = ["calibrate", "camera", *folders, "--target", "chessboard", "--squares", "9x7"]
    words += ["--square-size", "25", "--output", str(output), "--json"]
    assert main([*words, "--annotate", str(drawn)]) == 0
    named = [view["image"] for view in json.loads(capsys.readouterr().out)["views"]]
    assert set(named) <= {f"{part}/{number}.png" for part in "ab" for number in range(4)}
    assert len(set(named)) == len(named) >= 6
    copies = {name.replace("/", "_") for name in named}
    assert {path.name for path in drawn.iterdir()} == {*copies, "coverage.png"}
    # Each copy shows its own photograph: they agree outside the coloured marks.
    for name in named:
        copy = cv2.imread(str(drawn / name.replace("/", "_")))
        own = cv2.imread(str(tmp_path / name))
        assert (copy == own).all(axis=2).mean() > 0.5
    cv2.imwrite(str(tmp_path / "b" / "1.png"), np.zeros((240, 320), dtype=np.uint8))
    assert main([*words, "--force"]) == 1
    assert "b/1.png (320 x 240)" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["left: a # b", "[", "yes", "", "Käse 📷", "a\nb: c", '"'])
def test_any_name_of_a_camera_is_read_back(name: str) -> None:
    record = Provenance("calibrate camera", "", (), 0, 0, 0.0, "", 0.0, "", {}, ())
    document = yaml.safe_load(camera_info_yaml(SMALL, name, record))
    assert document["camera_name"] == name
