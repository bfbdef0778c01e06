"""Wrong input is refused immediately with a message of one sentence, before anything starts."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tapping_cell.cli import main
from tapping_cell.configuration.files import shared_folder

WRONG: list[tuple[str, str]] = [
    ("", "no verb was given"),
    ("dance", "there is no verb 'dance'"),
    ("gaol 1 2 3", "did you mean 'goal'?"),
    ("--planner exact", "there is no verb '--planner'"),
    ("bench", "python -m benchmarks"),
    ("goal", "give either X Y THETA"),
    ("goal 1 2", "give either X Y THETA"),
    ("goal 1 2 3 --layout a.yaml", "give either X Y THETA"),
    ("goal --layout a.yaml --ask", "for the goal of one object"),
    ("goal 1 2 3 4", "there is no argument 4"),
    ("goal nan 0 0", "'nan' is not a finite number"),
    ("goal 0 inf 0", "'inf' is not a finite number"),
    ("goal 0 0 east", "'east' is not a finite number"),
    ("goal 20000 0 0", "limits -10000 to 10000"),
    ("goal 1 2 3 --tolerance -1 1", "limits 0 to 1000"),
    ("goal 1 2 3 --tolerence 1 1", "did you mean '--tolerance'?"),
    ("goal 1 2 3 --wait -1", "limits 0 to 3600"),
    ("goal 1 2 3 --namespace bad-name!", "'bad-name!' is not a ROS namespace"),
    ("goal 1 2 3 --namespace 9lives", "not a ROS namespace"),
    ("up --namespace a//b", "not a ROS namespace"),
    ("up --planner guess", "no planning method 'guess'"),
    ("up --planner guess", "(404)"),
    ("up --seed -1", "limits 0 to 2147483647"),
    ("up --seed 1.5", "'1.5' is not a whole number"),
    ("up --page 99999999", "neither PORT nor ADDRESS:PORT"),
    ("up --wait nan", "'nan' is not a finite number"),
    ("up --cell /nowhere/cell.yaml", "/nowhere/cell.yaml"),
    ("up --object /nowhere/disk.yaml", "/nowhere/disk.yaml"),
    ("up --truth /nowhere/truth.yaml", "/nowhere/truth.yaml"),
    ("up --params /nowhere/parameters.yaml", "/nowhere/parameters.yaml"),
    ("up --hardware", "a port of the simulated cell"),
    ("up --hardware --cell HARDWARE", "the arm's port /dev/no_arm"),
    ("up --hardware --cell HARDWARE", "the tapper's port /dev/no_tapper"),
    ("up --hardware --cell HARDWARE --camera /dev/no_camera", "the camera /dev/no_camera"),
    ("demo --planner guess", "no planning method 'guess'"),
    ("demo --move nan 0 0", "'nan' is not a finite number"),
    ("demo --move 1 2", "--move"),
    ("demo --cell /nowhere/cell.yaml", "/nowhere/cell.yaml"),
    ("evaluate --planner guess", "no planning method 'guess'"),
    ("evaluate --trials many", "'many' is not a whole number"),
    ("evaluate --goal nan 0 0", "'nan' is not a finite number"),
    ("status --namspace left", "did you mean '--namespace'?"),
    ("stop now", "there is no argument now"),
    ("home --wait 0", "limits 1 to 3600"),
    ("clear all", "there is no argument all"),
    ("status --watch -5", "limits 0 to"),
    ("locate /nowhere/picture.png --camera /nowhere/camera.yaml", "/nowhere/camera.yaml"),
    ("calibrate lens", "choose from"),
    ("urdf --cell /nowhere/cell.yaml", "/nowhere/cell.yaml"),
    ("check-config HARDWARE --write", "give --devices too"),
    ("doctor --cell HARDWARE", "check-config FILE --devices"),
    ("completion --shell tcsh", "choose from bash, zsh, fish"),
    ("object fit /nowhere/records", "/nowhere/records"),
    ("fit /nowhere/records", "python -m tapping_cell object fit"),
    ("watch", "python -m tapping_cell status --watch"),
    ("sensitivity --distance nan", "'nan' is not a finite number"),
    # Options that exclude each other or have no effect.
    ("demo --move 10 0 10 --goal 0 0 0", "not allowed with argument --move"),
    ("demo --objects 3 --move 1 0 0", "not allowed with argument --objects"),
    ("demo --goals swap", "only with --objects"),
    ("up --camera /dev/video3", "only with --hardware"),
    ("up --hardware --truth FILES/empty.yaml", "must be a mapping"),
    ("up --hardware --seed 3", "only in simulation"),
    ("up --no-record --runs elsewhere", "only without --no-record"),
    ("evaluate --sweep friction=0.1:0.4:7", "--report"),
    # Values that no cell can accept.
    ("demo --goal 5000 0 0", "outside the usable area"),
    ("demo --goal 0 -221 0", "(103)"),
    ("demo --objects 9", "choose from 1, 2"),
    ("demo --seed 99999999999", "limits 0 to 2147483647"),
    ("goal --preset line", "at least two objects, and cell.yaml has one"),
    ("goal 1e400 0 0", "'1e400' is not a finite number"),
    ("goal 10mm 0 0", "'10mm' is not a finite number"),
    ("goal 1,5 0 0", "'1,5' is not a finite number"),
    ("goal 1 2 3 --tolerance 0 nan", "'nan' is not a finite number"),
    ("up --wait 1e9", "limits 1 to 3600"),
    ("up --page localhost:0", "neither PORT nor ADDRESS:PORT"),
    ("up --page 0.0.0.0:http", "neither PORT nor ADDRESS:PORT"),
    ("up --page 192.0.2.7:8010", "no server can listen at 192.0.2.7"),
    ("evaluate --box nan", "'nan' is not a finite number"),
    ("commission --again breakfast", "choose from"),
    # Files of the wrong kind or with wrong content.
    ("demo --cell FILES/binary.yaml", "is not UTF-8 text"),
    ("demo --cell FILES/latin.yaml", "is not UTF-8 text"),
    ("demo --cell FILES/huge.yaml", "the limit is 1 MB"),
    ("demo --cell FILES/deep.yaml", "nested too deeply"),
    ("demo --cell FILES/list.yaml", "must be a mapping"),
    ("demo --cell FILES/tab.yaml", "line 2"),
    ("demo --cell FILES", "Is a directory"),
    ("demo --cell FILES/metres.yaml", "key 'table.length' is 600"),
    ("demo --cell FILES/nan.yaml", "key 'arm.travel_speed' is nan"),
    ("demo --cell FILES/words.yaml", "key 'arm.park' is 'over there'"),
    ("demo --cell FILES/twice.yaml", "the key 'baud' appears twice"),
    ("demo --cell FILES/misspelt.yaml", "unknown key 'arm.homming'"),
    ("demo --object FILES/empty.yaml", "must be a mapping"),
    ("demo --truth FILES/list.yaml", "must be a mapping"),
    ("demo --truth-object FILES/empty.yaml", "must be a mapping"),
    ("demo --out FILES/empty.yaml/run", "is a file, not a folder"),
    ("up --runs FILES/empty.yaml", "is a file, not a folder"),
    ("up --logs FILES/empty.yaml/logs", "is a file, not a folder"),
    ("up --params FILES/list.yaml", "is not a ROS parameter file"),
    ("up --params FILES/outside.yaml", "key 'use_sim_time' must be under 'ros__parameters'"),
    ("commission --yes --out FILES/empty.yaml", "is a file, not a folder"),
    ("object new FILES/text.png --name a --height 12 --output o.yaml", "read as an image"),
    ("object new FILES/text.png --name a --height -3 --output o.yaml", "limits 0.5 to 500"),
    ("report FILES", "FILES"),
    ("report /nowhere/run", "/nowhere/run does not exist"),
    ("evaluate --probe", "only with --table"),
    ("evaluate --all --trials 10 --report FILES/empty.yaml", "is a file, not a folder"),
    ("single-tap --namespace left", "only with --attach"),
    ("single-tap --truth FILES/list.yaml", "must be a mapping"),
    ("single-tap --incidences 90", "within +-60 deg"),
    (
        "calibrate arm a.csv --record --namespace a$b --output c.yaml",
        "'a$b' is not a ROS namespace",
    ),
    ("calibrate tapper a.csv --record --namespace 9a --output c.yaml", "not a ROS namespace"),
]


@pytest.fixture(scope="module")
def hardware_cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a cell file with ports that do not exist."""
    folder = tmp_path_factory.mktemp("cell")
    for entry in shared_folder().iterdir():
        (folder / entry.name).symlink_to(entry)
    text = (folder / "cell.yaml").read_text(encoding="utf-8")
    for device in ("arm", "tapper"):
        port = f"port: ~/.ros/tapping_cell/{{cell}}/{device}"
        assert port in text
        text = text.replace(port, f"port: /dev/no_{device}")
    (folder / "cell.yaml").unlink()
    (folder / "cell.yaml").write_text(text, encoding="utf-8")
    return folder / "cell.yaml"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a folder of files that no verb can use."""
    folder = tmp_path_factory.mktemp("FILES", numbered=False)
    for name, content in (
        ("empty.yaml", b""),
        ("binary.yaml", bytes(range(256)) * 8),
        ("latin.yaml", "name: Zelle für Käse".encode("latin-1")),
        ("huge.yaml", b"a: [" + b"1, " * 1_000_000 + b"1]"),
        ("deep.yaml", b"[" * 2_000),
        ("list.yaml", b"- 1\n- 2\n"),
        ("tab.yaml", b"name: cell\n\tarm: 3\n"),
        ("outside.yaml", b"tap_planner: {ros__parameters: {ask: true}, use_sim_time: false}"),
        ("text.png", b"this is no image"),
    ):
        (folder / name).write_bytes(content)
    cell = (shared_folder() / "cell.yaml").read_text(encoding="utf-8")
    for name, before, after in (
        ("metres.yaml", "length: 0.60", "length: 600"),
        ("nan.yaml", "travel_speed: 0.8", "travel_speed: .nan"),
        ("words.yaml", "park: [1.2, 1.2, -0.020, 0.0]", "park: over there"),
        ("twice.yaml", "  homing: firmware", "  baud: 9600"),
        ("misspelt.yaml", "  homing: firmware", "  homming: firmware"),
    ):
        assert before in cell
        (folder / name).write_text(cell.replace(before, after, 1), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("line", "words"), WRONG, ids=[f"{a} ({b})" for a, b in WRONG])
def test_invalid_input_is_refused_in_one_sentence(
    line, words, hardware_cell, files, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    line = line.replace("HARDWARE", str(hardware_cell)).replace("FILES", str(files))
    monkeypatch.setattr(subprocess, "Popen", lambda command, **_: pytest.fail(f"{command} began"))
    try:
        status = main(line.split())
    except SystemExit as ended:
        status = int(ended.code or 0)
    output = capsys.readouterr()
    lines = output.err.strip().splitlines()
    assert status == 2, output
    assert [text for text in lines if not text.startswith("what to do: ")] == lines[:1], output.err
    assert lines[0].startswith("error: ") and words in lines[0], output.err
    assert not output.out
    assert not list(tmp_path.iterdir()), "something was begun"
