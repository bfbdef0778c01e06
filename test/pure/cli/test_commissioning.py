"""Commissioning stores the results of each step, continues where it stopped, and writes a
report."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from rich.console import Console

from tapping_cell.calibration.target import find_target
from tapping_cell.calibration.yaml_edit import with_value
from tapping_cell.cli import commission, main
from tapping_cell.cli.calibration.photographs_verb import TARGET
from tapping_cell.cli.commissioning import steps
from tapping_cell.cli.commissioning.session import Proof, Session, StepFailed
from tapping_cell.report.commissioning_page import PAGE


def session_in(folder: Path) -> Session:
    made = Session(folder, Console(quiet=True), hardware=False, unattended=True)
    made.load()
    return made


def test_starting_files_are_copied_once_and_checked(tmp_path: Path) -> None:
    session = session_in(tmp_path)
    assert "consistent" in steps.files(session).sentence
    text = session.cell_file.read_text(encoding="utf-8").replace("length: 0.60", "length: 0.59")
    session.cell_file.write_text(text, encoding="utf-8")
    steps.files(session)
    assert session.cell_file.read_text(encoding="utf-8") == text
    session.cell_file.write_text(text.replace("length: 0.59", "length: wide"), encoding="utf-8")
    with pytest.raises(StepFailed, match=r"table\.length"):
        steps.files(session)


def test_a_recorded_proof_is_found_again(tmp_path: Path) -> None:
    session_in(tmp_path).prove("camera", Proof("sharp", {"rms_px": 0.1}), 3.21)
    found = session_in(tmp_path).proofs["camera"]
    assert (found["sentence"], found["values"], found["seconds"]) == ("sharp", {"rms_px": 0.1}, 3.2)


def test_a_failed_step_is_reported_and_the_next_call_resumes_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []

    def good(_: Session) -> Proof:
        done.append("good")
        return Proof("it is <good>")

    def bad(_: Session) -> Proof:
        done.append("bad")
        if done.count("bad") == 1:
            raise StepFailed("the lamp is off (limit on): switch it on")
        return Proof("it is lit")

    made = (steps.Step("good", "Good", good), steps.Step("bad", "Bad", bad))
    monkeypatch.setattr(commission, "STEPS", made)
    words = ["commission", "--yes", "--out", str(tmp_path)]
    assert main(words) == 1
    assert "error: step bad: the lamp is off" in capsys.readouterr().err
    assert "1 of 2 steps are done" in (tmp_path / PAGE).read_text(encoding="utf-8")
    assert main(words) == 0
    assert done == ["good", "bad", "bad"]
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert "The cell is commissioned" in page and "it is &lt;good&gt;" in page


def test_commissioning_hardware_without_confirmations_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["commission", "--yes", "--hardware"]) == 2
    assert "a person must watch every step" in capsys.readouterr().err


def test_only_the_key_of_the_given_section_is_replaced() -> None:
    text = "port: here\narm:\n  port: ~/x   # of the arm\n  baud: 1\n"
    assert with_value(text, "arm.port", "/dev/arm") == text.replace("~/x", "/dev/arm")
    assert with_value(text, "arm.nothing", "1") == text


def test_the_rendered_target_is_detected_like_a_printed_one(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    assert main(["calibrate", "photographs", "--count", "2", "--output", str(folder)]) == 0
    for path in folder.iterdir():
        found = find_target(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), TARGET, path.name)
        assert not isinstance(found, str) and len(found.ids) > 20
    assert main(["calibrate", "photographs", "--output", str(folder)]) == 1
