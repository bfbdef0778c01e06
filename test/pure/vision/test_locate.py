"""The verb ``locate``: its input files, results and refusals."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scenes import CAMERA, MARKER, REFERENCES, renderer

from tapping_cell.cli import main

PLACES = (np.array([0.11, -0.07, 2.0]), np.array([-0.2, 0.12, -0.4]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("locate")
    scene = renderer()
    for k, place in enumerate(PLACES):
        cv2.imwrite(str(folder / f"shot{k}.png"), scene.render(place))
    for k in range(6):
        cv2.imwrite(str(folder / f"film{k}.png"), scene.render(PLACES[0]))
    cv2.imwrite(str(folder / "empty.png"), scene.render([5.0, 5.0, 0.0]))
    (folder / "text.png").write_text("no image")
    camera = {
        "image_width": CAMERA.width,
        "image_height": CAMERA.height,
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(CAMERA.distortion)},
        "camera_matrix": {"rows": 3, "cols": 3, "data": CAMERA.matrix.ravel().tolist()},
    }
    table = {
        "dictionary": REFERENCES.dictionary,
        "markers": [
            {"id": m.id, "size": m.size, "x": m.x, "y": m.y, "theta": m.theta}
            for m in REFERENCES.markers
        ],
    }
    seen = {
        "shape": {"kind": "disk", "radius": 0.048},
        "height": MARKER.height,
        "marker": {"dictionary": MARKER.dictionary, "id": MARKER.id, "size": MARKER.size},
    }
    for name, content in (("camera", camera), ("table", table), ("object", seen)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


def locate(folder: Path, *names: str) -> int:
    files = [str(folder / n) if n.endswith(".png") else n for n in names]
    options = [f"--{kind}={folder / f'{kind}.yaml'}" for kind in ("camera", "table", "object")]
    return main(["locate", *files, *options])


def test_poses_in_mm_and_degrees(folder, capsys):
    assert locate(folder, "shot0.png", "shot1.png", "empty.png", "--json") == 0
    results = json.loads(capsys.readouterr().out)
    for result, place in zip(results, PLACES, strict=False):
        assert result["visible"]
        assert result["x"] == pytest.approx(place[0] * 1e3, abs=0.03)
        assert result["y"] == pytest.approx(place[1] * 1e3, abs=0.03)
        assert result["theta"] == pytest.approx(math.degrees(place[2]), abs=0.03)
        assert abs(result["x"] - place[0] * 1e3) < 5 * result["sd_x"]
        assert result["references"] == list(range(101, 109))
        assert result["milliseconds"] > 0
    assert not results[2]["visible"] and results[2]["x"] is None
    assert results[2]["problem"] == "object_hidden"


def test_the_exif_rotation_of_a_photograph_is_not_applied(folder, capsys):
    """The EXIF orientation of a JPEG is ignored, because the lens model refers to the pixels as
    stored."""
    good, data = cv2.imencode(".jpg", cv2.imread(str(folder / "shot0.png")))
    assert good
    orientation = bytes.fromhex("49492a00080000000100120103000100000006000000" + "00000000")
    exif = b"Exif\0\0" + orientation
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    jpeg = bytes(data)
    (folder / "turned.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    turned = cv2.imread(str(folder / "turned.jpg"))
    assert turned.shape[:2] == (CAMERA.width, CAMERA.height)
    assert locate(folder, str(folder / "turned.jpg"), "--json") == 0
    (result,) = json.loads(capsys.readouterr().out)
    assert result["x"] == pytest.approx(PLACES[0][0] * 1e3, abs=0.05)


def test_images_in_other_formats_are_read(folder, capsys):
    """The result is the same for 12-bit images stored with 16 bits, rotated portrait photographs,
    colour images and other formats."""
    grey = cv2.imread(str(folder / "shot0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "deep.png"), grey.astype(np.uint16) * 16)
    cv2.imwrite(str(folder / "grey.tiff"), grey)
    cv2.imwrite(str(folder / "colour.bmp"), cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    cv2.imwrite(str(folder / "float.tiff"), grey.astype(np.float32))
    # A viewer rotates this image by 90 degrees clockwise (Exif orientation 6), which gives the
    # camera's size.
    turned = cv2.rotate(grey, cv2.ROTATE_90_COUNTERCLOCKWISE)
    coded = cv2.imencode(".jpg", turned, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    tag = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    head = b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big")
    (folder / "portrait.jpg").write_bytes(coded[:2] + head + tag + coded[2:])
    names = ["deep.png", "grey.tiff", "colour.bmp", "portrait.jpg", "float.tiff", "none.png", ""]
    assert locate(folder, *(str(folder / name) for name in names), "--json") == 0
    *right, unusual, missing, directory = json.loads(capsys.readouterr().out)
    for entry in right:
        assert entry["visible"], entry
        assert entry["x"] == pytest.approx(PLACES[0][0] * 1e3, abs=0.05)
        assert entry["theta"] == pytest.approx(math.degrees(PLACES[0][2]), abs=0.05)
    assert "8 or 16 bits" in unusual["sentence"]
    assert "does not exist" in missing["sentence"]
    assert "is a folder" in directory["sentence"]


def test_a_sequence_is_fused(folder, capsys):
    names = [f"film{k}.png" for k in range(6)]
    assert locate(folder, *names, "--sequence", "--json") == 0
    results = json.loads(capsys.readouterr().out)
    assert results[-1]["at_rest"] and results[-1]["frames_fused"] == 6
    assert results[-1]["sd_x"] < results[0]["sd_x"]


def test_nothing_found_is_exit_status_1(folder, capsys):
    (folder / "pointer.png").write_text("version https://git-lfs.github.com/spec/v1\n")
    assert locate(folder, "empty.png", "text.png", "pointer.png") == 1
    text = capsys.readouterr().out
    assert "not found" in text and "cannot be read" in text and "`git lfs pull`" in text


def test_annotated_images_are_written(folder, capsys):
    assert locate(folder, "shot0.png", "--annotate", str(folder / "out")) == 0
    assert cv2.imread(str(folder / "out" / "shot0.png")).shape == (1024, 1280, 3)


def test_annotating_never_replaces_an_input_image(folder, tmp_path, capsys):
    shot = folder / "shot0.png"
    before = shot.read_bytes()
    link = tmp_path / "linked" / "shot0.png"
    link.parent.mkdir()
    link.symlink_to(shot)
    for target, words in ((folder, "is the folder of"), (link.parent, "would replace")):
        assert locate(folder, "shot0.png", "--annotate", str(target)) == 2
        assert words in capsys.readouterr().err
    assert locate(folder, "shot0.png", "--annotate", str(shot)) == 2
    assert "is a file; give a folder" in capsys.readouterr().err
    assert shot.read_bytes() == before


def test_images_with_equal_names_have_annotated_copies_of_their_own(folder, tmp_path, capsys):
    paths = []
    for part, shot, end in (("a", 0, "png"), ("b", 1, "png"), ("b", 1, "bmp")):
        path = tmp_path / part / f"x.{end}"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), cv2.imread(str(folder / f"shot{shot}.png")))
        paths.append(str(path))
    assert locate(folder, *paths, "--annotate", str(tmp_path / "out")) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "a_x.png",
        "b_x.png",
        "x.png",
    ]
    printed = capsys.readouterr().out
    assert "a/x.png" in printed and "b/x.png" in printed


def test_an_annotated_image_that_cannot_be_written_is_named(folder, tmp_path, capsys):
    full = tmp_path / "shot0.png"
    full.symlink_to("/dev/full")
    assert locate(folder, "shot0.png", "--annotate", str(tmp_path)) == 2
    assert f"{full} cannot be written (No space left on device)" in capsys.readouterr().err


def test_an_invalid_file_is_named(folder, capsys):
    bad = folder / "bad.yaml"
    bad.write_text("dictionary: nonsense_9x9\nmarkers: [{id: 1, size: 0.04, x: 0, y: 0}]\n")
    assert main(["locate", str(folder / "shot0.png"), f"--table={bad}"]) == 2
    assert "nonsense_9x9" in capsys.readouterr().err


def test_markers_seen_in_place_of_the_reference_markers_are_named(folder, tmp_path, capsys):
    image = cv2.imread(str(folder / "shot0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "negative.png"), 255 - image)
    text = (folder / "table.yaml").read_text()
    (tmp_path / "table.yaml").write_text(text.replace(REFERENCES.dictionary, "4x4_250"))
    assert locate(folder, str(tmp_path / "negative.png")) == 1
    assert "are visible inverted; print black markers on white" in capsys.readouterr().out
    assert main(["locate", str(folder / "shot0.png"), f"--table={tmp_path / 'table.yaml'}"]) == 1
    assert "of APRILTAG_36H11 are visible; correct the dictionary" in capsys.readouterr().out
    assert locate(folder, "empty.png") == 1
    assert "correct the" not in capsys.readouterr().out


def test_a_mirrored_image_and_a_mirrored_table_are_named(folder, tmp_path, capsys):
    """The object is not in view: only the reference markers show the mistake."""
    image = cv2.imread(str(folder / "empty.png"))
    cv2.imwrite(str(tmp_path / "mirrored.png"), image[:, ::-1])
    assert locate(folder, str(tmp_path / "mirrored.png")) == 1
    assert "are seen mirrored; turn off mirroring" in capsys.readouterr().out
    table = yaml.safe_load((folder / "table.yaml").read_text())
    for marker in table["markers"]:
        marker["x"], marker["y"] = marker["y"], marker["x"]
    (tmp_path / "table.yaml").write_text(yaml.safe_dump(table))
    options = [f"--{kind}={folder / f'{kind}.yaml'}" for kind in ("camera", "object")]
    image_file, table_file = str(folder / "shot0.png"), f"--table={tmp_path / 'table.yaml'}"
    assert main(["locate", image_file, table_file, *options]) == 1
    assert "exchanged coordinates or a wrong sign mirror the table" in capsys.readouterr().out
