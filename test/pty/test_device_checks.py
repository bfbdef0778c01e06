"""`check-config --devices` with emulated devices on pseudo-terminals: its findings, what it stores,
and what it must not change."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.marlin_emulator import MarlinEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator
from tapping_cell.simulation.truth import ArmTruth

Plug = Callable[..., PseudoTerminal]


def a_cell(folder: Path, plug: Plug, dialect: str) -> tuple[Path, GrblEmulator | MarlinEmulator]:
    """Write a cell file whose two devices are connected; return its path and the arm's emulator."""
    shutil.copytree(shared_folder(), folder / "config")
    path = folder / "config" / "cell.yaml"
    document = yaml.safe_load(path.read_text())
    document["arm"]["dialect"] = dialect
    now = time.monotonic()
    tapper = plug(TapperEmulator(on_fire=lambda *_: None, now=now), "tapper")
    document["tapper"]["port"] = str(tapper.path)
    document["arm"]["port"] = str(folder / "arm")
    path.write_text(yaml.safe_dump(document))
    emulator = arm_emulator(load_cell(path).file.arm, ArmTruth(), 1, now)
    plug(emulator, "arm")
    return path, emulator


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_configured_cell_passes_every_check(
    tmp_path: Path, plug: Plug, dialect: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = a_cell(tmp_path, plug, dialect)
    assert main(["check-config", str(path), "--devices", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"]
    assert {row["device"] for row in report["devices"]} == {"arm", "tapper"}


@pytest.mark.parametrize("boards", [1, 2])
def test_a_cell_without_an_arm_has_its_boards_checked(
    tmp_path: Path, plug: Plug, boards: int, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(shared_folder(), tmp_path / "config")
    path = tmp_path / "config" / "positioning_cell" / "cell.yaml"
    document = yaml.safe_load(path.read_text())
    for number in range(boards):
        device = TapperEmulator(on_fire=lambda *_: None, now=time.monotonic())
        port = str(plug(device, f"tapper{number}").path)
        for entry in document["fixed_tappers"]["tappers"][number::boards]:
            entry["port"] = port
    path.write_text(yaml.safe_dump(document))
    assert main(["check-config", str(path), "--devices", "--json"]) == 0
    found = {row["device"] for row in json.loads(capsys.readouterr().out)["devices"]}
    assert found == ({"tapper"} if boards == 1 else {"tapper board 1", "tapper board 2"})


def test_a_difference_is_reported_with_its_command_and_stored_after_confirmation(
    tmp_path: Path,
    plug: Plug,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, emulator = a_cell(tmp_path, plug, "grbl")
    emulator.receive(b"$1=25\n$110=100\n", time.monotonic())
    before = emulator.joints(time.monotonic())
    assert main(["check-config", str(path), "--devices", "--json"]) == 1
    rows = {row["setting"]: row for row in json.loads(capsys.readouterr().out)["devices"]}
    assert not rows["$1"]["ok"] and rows["$1"]["remedy"].endswith("send $1=255")
    assert "send $110=" in rows["$110"]["remedy"]

    monkeypatch.setattr("sys.stdin", io.StringIO("n\ny\n"))
    assert main(["check-config", str(path), "--devices", "--json", "--write"]) == 1
    refused = capsys.readouterr()
    rows = {row["setting"]: row for row in json.loads(refused.out)["devices"]}
    assert not rows["$1"]["ok"], "nothing is stored after a no"
    assert main(["check-config", str(path), "--devices", "--json", "--write"]) == 1
    stored = capsys.readouterr()
    rows = {row["setting"]: row for row in json.loads(stored.out)["devices"]}
    assert rows["$1"]["ok"] and not rows["$110"]["ok"]
    for output in (refused, stored):
        assert output.err.count("Store it now? [y/N]") == 1, "the prompt is not part of the JSON"
        assert "$110" not in output.err, "speeds are left to a person"
    assert emulator.joints(time.monotonic()) == before


def test_missing_devices_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tapping_cell.cli.device_checks.TIMEOUT", 0.2)
    shutil.copytree(shared_folder(), tmp_path / "config")
    path = tmp_path / "config" / "cell.yaml"
    document = yaml.safe_load(path.read_text())
    document["arm"]["port"] = str(tmp_path / "nothing")
    document["tapper"]["port"] = "~/{cell}/tapper"
    path.write_text(yaml.safe_dump(document))
    assert main(["check-config", str(path), "--devices", "--json"]) == 1
    arm, tapper = json.loads(capsys.readouterr().out)["devices"]
    assert str(tmp_path / "nothing") in arm["remedy"]
    assert "belongs to a simulated cell" in tapper["remedy"]
    assert main(["check-config", str(path), "--devices"]) == 1
    assert "wrong" in capsys.readouterr().out
