"""The command line has help texts and refuses unknown arguments."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell import __version__
from tapping_cell.cli import GROUPS, VERBS, main
from tapping_cell.cli.argument_types import configuration_file
from tapping_cell.cli.graph import parameter_text


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert f"python -m tapping_cell {verb}" in capsys.readouterr().out


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert (ended.value.code, capsys.readouterr().out) == (0, f"tapping_cell {__version__}\n")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_closed_output_pipe_ends_a_verb_silently(unbuffered: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "tapping_cell", "evaluate", "--trials", "5"],
            stdout=writing,
            stderr=subprocess.PIPE,
            env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            timeout=120,
        )
    finally:
        os.close(writing)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGPIPE, b"")


def at_work(process: str) -> bool:
    """Return whether a process has used some processor time, so that its start is over."""
    *_, user, system = Path(f"/proc/{process}/stat").read_text().split()[:15]
    return int(user) + int(system) > 0.1 * os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize(
    ("command", "option", "number"),
    [("faults", "--goals", signal.SIGINT), ("drivers", "--taps", signal.SIGTERM)],
)
def test_a_signal_ends_a_campaign_and_its_processes(
    command: str, option: str, number: signal.Signals
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "lab", command, option, "10000000", "--jobs", "2"],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        until = time.monotonic() + 60
        while sum(map(at_work, children.read_text().split())) < 2 and time.monotonic() < until:
            time.sleep(0.05)
        started = children.read_text().split()
        # Ctrl-C is sent to every process of the terminal, a termination signal to one process.
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        _, printed = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 130
    assert "interrupted" in printed and "Traceback" not in printed
    assert len(started) == 2
    until = time.monotonic() + 60
    while left := [child for child in started if Path(f"/proc/{child}").exists()]:
        assert time.monotonic() < until, f"processes {left} still exist"
        time.sleep(0.05)


@given(st.text(st.characters(exclude_categories=("Cs", "Cc"))) | st.booleans() | st.integers())
def test_a_parameter_reaches_a_node_unchanged(value: object) -> None:
    assert yaml.safe_load(parameter_text(value)) == value


@pytest.mark.parametrize("name", ["101", "no", "1e3", "", "null", "with a space", "a: b", '"'])
def test_a_folder_may_be_named_like_a_number(name: str) -> None:
    assert yaml.safe_load(parameter_text(Path(name))) == str(Path(name))


def test_help_lists_every_verb_in_a_group_within_80_columns(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(VERBS)
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert all(len(line) < 80 for line in text.splitlines())
    assert all(f"  {verb} " in text for verb in VERBS)


def test_a_configuration_file_of_the_package_is_found_from_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = configuration_file("config/positioning_cell/cell.yaml")
    assert found.is_file() and configuration_file("positioning_cell/cell.yaml") == found
    assert configuration_file("other.yaml") == Path("other.yaml")
    (tmp_path / "cell.yaml").touch()
    assert configuration_file("cell.yaml") == Path("cell.yaml")
