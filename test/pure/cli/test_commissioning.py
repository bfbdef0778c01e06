"""Commissioning stores the results of each step, continues where it stopped, and writes a
report."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from rich.console import Console

from tapping_cell.calibration.target import find_target
from tapping_cell.calibration.yaml_edit import with_value
from tapping_cell.cli import commission, main
from tapping_cell.cli.calibration.photographs_verb import TARGET
from tapping_cell.cli.commission import PAGE
from tapping_cell.cli.commissioning import steps
from tapping_cell.cli.commissioning.session import RECORD, Proof, Session, StepFailed
from tapping_cell.nodes.clients.single_tap_client import NoAnswer


def session_in(folder: Path) -> Session:
    made = Session(folder, Console(quiet=True), hardware=False, unattended=True)
    made.load()
    return made


def use_step(monkeypatch: pytest.MonkeyPatch, run: Callable[[Session], Proof]) -> None:
    """Replace the steps of the verb by one step with the name ``arm``."""
    monkeypatch.setattr(commission, "STEPS", (steps.Step("arm", "Arm", run),))


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


def test_a_failed_step_is_reported_and_the_next_call_resumes_there(tmp_path, monkeypatch, capsys):
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
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert "1 of 2 steps of the simulated cell are done" in page
    assert main(words) == 0
    assert done == ["good", "bad", "bad"]
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    assert "The simulated cell is commissioned" in page and "it is &lt;good&gt;" in page


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("--yes", "--hardware", "contains a simulated session"),
        ("--hardware", "--yes", "contains a session on hardware"),
    ],
)
def test_a_folder_is_either_simulated_or_on_hardware(
    first, second, words, tmp_path, monkeypatch, capsys
):
    done: list[bool] = []

    def step(session: Session) -> Proof:
        done.append(session.hardware)
        return Proof("measured")

    use_step(monkeypatch, step)
    folder = str(tmp_path / "cell")
    assert main(["commission", first, "--out", folder]) == 0
    page = (tmp_path / "cell" / PAGE).read_text(encoding="utf-8")
    assert ("The simulated cell is" if first == "--yes" else "The cell is") in page
    before = (tmp_path / "cell" / RECORD).read_bytes()
    capsys.readouterr()
    for again in ([], ["--again", "arm"]):
        assert main(["commission", second, "--out", folder, *again]) == 2
        output = capsys.readouterr()
        assert words in output.err and f"--out {folder}_" in output.err and not output.out
    assert done == [first == "--hardware"]
    assert (tmp_path / "cell" / RECORD).read_bytes() == before


def test_the_mode_is_stored_before_the_first_step_has_succeeded(tmp_path, monkeypatch):
    def step(_: Session) -> Proof:
        raise StepFailed("the lamp is off")

    use_step(monkeypatch, step)
    assert main(["commission", "--yes", "--out", str(tmp_path)]) == 1
    assert main(["commission", "--hardware", "--out", str(tmp_path)]) == 2


def test_the_examples_use_one_folder_for_the_simulation_and_another_for_hardware() -> None:
    guide = Path(__file__).parents[3] / "docs" / "build" / "README.md"
    for text in (commission.__doc__ or "", guide.read_text(encoding="utf-8")):
        folders = re.findall(r"^ {4}python -m tapping_cell commission .*--out (\w+)$", text, re.M)
        assert len(folders) == len(set(folders)) == 2


@pytest.mark.parametrize("end", [StepFailed("the lamp is off"), KeyboardInterrupt()])
def test_a_repetition_that_does_not_succeed_loses_the_earlier_result(
    end, tmp_path, monkeypatch, capsys
):
    recording, found, ends = tmp_path / "arm.csv", [], [None, end, end, None]

    def step(_: Session) -> Proof:
        found.append(recording.read_text() if recording.exists() else "")
        recording.write_text(f"{found[-1]}{len(found)}")
        error = ends[len(found) - 1]
        if error is not None:
            raise error
        return Proof(f"measured {len(found)} times")

    use_step(monkeypatch, step)
    words = ["commission", "--yes", "--out", str(tmp_path)]
    status = 1 if isinstance(end, StepFailed) else 130
    assert main(words) == 0
    assert main([*words, "--again", "arm"]) == status
    output = capsys.readouterr().out
    assert "the same command without --again resumes at this step" in output
    assert "arm.csv; --again arm discards them" in output
    assert session_in(tmp_path).proofs == {}
    assert main(words) == status
    assert "the same command resumes at this step" in capsys.readouterr().out
    assert main(words) == 0
    assert found == ["", "", "2", "23"]
    assert session_in(tmp_path).proofs["arm"]["sentence"] == "measured 4 times"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not JSON"),
        (b'{"hardware": fal', "is not JSON"),
        (b"\xff", "is not JSON"),
        (b"[]", "must be a mapping"),
        (b'{"files": {"sentence": "good"}}', "key 'hardware' must be true or false"),
        (b'{"hardware": false}', "key 'steps' must be a mapping"),
        (b'{"hardware": false, "steps": {"arm": 3}}', "key 'steps.arm.sentence'"),
        (
            b'{"hardware": true, "steps": {"arm": {"sentence": "", "values": {}, "seconds": ""}}}',
            "key 'steps.arm.seconds'",
        ),
    ],
)
def test_a_damaged_record_is_refused(content, words, tmp_path, monkeypatch, capsys):
    use_step(monkeypatch, lambda _: Proof("measured"))
    (tmp_path / RECORD).write_bytes(content)
    assert main(["commission", "--yes", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path / RECORD}: ") and words in error
    assert "choose another folder with --out" in error
    assert [path.name for path in tmp_path.iterdir()] == [RECORD]
    assert (tmp_path / RECORD).read_bytes() == content


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (TimeoutError("there was no response within 5 s"), "no response within 5 s"),
        (NoAnswer("check tap_planner, then continue with --resume"), "check tap_planner"),
        (StepFailed("too slow; continue with --resume"), "too slow"),
    ],
)
def test_an_error_in_a_step_is_reported_in_a_sentence(error, words, tmp_path, monkeypatch, capsys):
    def step(_: Session) -> Proof:
        raise error

    use_step(monkeypatch, step)
    assert main(["commission", "--yes", "--out", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("error: step arm: ") and words in printed.err
    assert "--resume" not in printed.err and "finished steps are kept" in printed.out


def test_a_full_disk_while_a_result_is_stored_is_reported(tmp_path, monkeypatch, capsys):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    def step(_: Session) -> Proof:
        monkeypatch.setattr(Path, "replace", full)
        monkeypatch.setattr(Path, "write_text", full)
        return Proof("measured")

    use_step(monkeypatch, step)
    assert main(["commission", "--yes", "--out", str(tmp_path)]) == 1
    step_error, page_error = capsys.readouterr().err.splitlines()
    assert "error: step arm: " in step_error and "the page" in page_error
    monkeypatch.undo()
    assert session_in(tmp_path).proofs == {}


@pytest.mark.parametrize("hardware", [True, False])
@pytest.mark.parametrize("prompt", ["instruct", "ask"])
def test_the_end_of_the_input_at_a_prompt_is_reported(
    prompt, hardware, tmp_path, monkeypatch, capsys
):
    def step(session: Session) -> Proof:
        if prompt == "instruct":
            session.instruct("close the guard")
        else:
            session.ask("which port?", "/dev/arm")
        return Proof("confirmed")

    use_step(monkeypatch, step)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    words = ["--hardware"] if hardware else []
    assert main(["commission", *words, "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "the standard input ended before an answer; run the command in a terminal" in error
    assert ("--yes" in error) is not hardware


def test_an_interrupted_calibration_interrupts_the_session(tmp_path, monkeypatch, capsys):
    def step(session: Session) -> Proof:
        session.verb("calibrate", "arm")
        return Proof("calibrated")

    use_step(monkeypatch, step)
    run = main
    monkeypatch.setattr("tapping_cell.cli.main", lambda _: 130)
    assert run(["commission", "--yes", "--out", str(tmp_path)]) == 130
    output = capsys.readouterr()
    assert "interrupted; the same command resumes at this step" in output.out and not output.err


def test_an_interrupted_copy_of_the_files_is_completed(tmp_path, monkeypatch):
    copy = shutil.copytree

    def interrupted(source: Path, target: Path, **options: object) -> None:
        copy(source / "objects", target / "objects")
        raise KeyboardInterrupt

    session = session_in(tmp_path)
    monkeypatch.setattr(shutil, "copytree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        steps.files(session)
    assert not session.config.exists()
    monkeypatch.undo()
    assert "consistent" in steps.files(session).sentence
    assert [path.name for path in tmp_path.iterdir()] == ["config"]


def test_commissioning_hardware_without_confirmations_is_refused(capsys):
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
