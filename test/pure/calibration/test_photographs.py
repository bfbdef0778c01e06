"""Rendered photographs: a folder has all of them or none, also after a failure."""

from __future__ import annotations

import contextlib
import math
import resource
from pathlib import Path

import cv2
import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.cli.calibration.photographs_verb import table_sheet
from tapping_cell.configuration.table import load_reference_map
from tapping_cell.simulation.rendered_sheet import SheetCamera
from tapping_cell.vision.markers.detection import find_markers

WORDS = ["calibrate", "photographs", "--count", "2", "--output"]


def test_images_that_cannot_be_written_are_an_error(tmp_path: Path, capsys) -> None:
    """A limit of the file size has the effect of a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        status = main([*WORDS, str(tmp_path / "pictures")])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 2
    message = capsys.readouterr().err
    assert "target_01.png cannot be written (File too large); free space on the disk" in message
    assert not list(tmp_path.iterdir())


def test_an_interrupted_run_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[object] = []
    photograph = SheetCamera.photograph

    def interrupted(*arguments, **options):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return photograph(*arguments, **options)

    monkeypatch.setattr(SheetCamera, "photograph", interrupted)
    with contextlib.suppress(KeyboardInterrupt):
        main([*WORDS, str(tmp_path / "pictures")])
    assert len(calls) == 2
    assert not list(tmp_path.iterdir())


def test_an_existing_empty_folder_is_filled_and_a_file_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert main([*WORDS, "."]) == 0
    assert sorted(path.name for path in Path.cwd().iterdir()) == ["target_01.png", "target_02.png"]
    file = tmp_path / "file"
    file.touch()
    assert main([*WORDS, str(file)]) == 1
    assert "is a file" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "file"]


@pytest.mark.parametrize("size", [0.04, 0.2])
def test_markers_of_any_size_are_complete_at_the_edge_of_the_sheet(
    tmp_path: Path, size: float
) -> None:
    path = tmp_path / "table.yaml"
    places = [(-0.3, -0.2, 0.0), (0.3, -0.2, math.pi / 2), (-0.3, 0.2, math.pi), (0.3, 0.2, 0.0)]
    markers = [
        {"id": number, "size": size, "x": x, "y": y, "theta": theta}
        for number, (x, y, theta) in enumerate(places, start=1)
    ]
    path.write_text(yaml.safe_dump({"dictionary": "APRILTAG_36h11", "markers": markers}))
    sheet = table_sheet(load_reference_map(path))
    image = cv2.resize(sheet.pattern, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    assert {found.id for found in find_markers(image, "APRILTAG_36h11")} == {1, 2, 3, 4}
