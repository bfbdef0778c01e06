"""Ports of the cell file: one device named twice, names of Windows, and links that are gone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.port_names import port_problem


def findings(tmp_path: Path, arm: str, tapper: str) -> tuple[str, str]:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder, dirs_exist_ok=True)
    content = yaml.safe_load((folder / "cell.yaml").read_text())
    content["arm"]["port"], content["tapper"]["port"] = arm, tapper
    (folder / "cell.yaml").write_text(yaml.safe_dump(content))
    errors, warnings = conflicts(load_cell(folder / "cell.yaml"))
    return "\n".join(errors), "\n".join(warnings)


def test_one_device_for_arm_and_tapper_is_an_error_by_any_name(tmp_path: Path) -> None:
    device, link, second = (tmp_path / name for name in ("ttyUSB0", "by-id", "by-path"))
    device.touch()
    link.symlink_to(device)
    second.symlink_to(link)
    other = tmp_path / "ttyUSB1"
    other.touch()
    assert findings(tmp_path, str(device), str(other)) == ("", "")
    for names in ((device, device), (device, link), (second, link), (f"{tmp_path}/./by-id", link)):
        errors, _ = findings(tmp_path, *map(str, names))
        assert "give each its own" in errors and str(names[0]) in errors


def test_up_refuses_one_port_for_arm_and_tapper_before_it_starts_nodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ttyUSB0").touch()
    findings(tmp_path, *2 * (str(tmp_path / "ttyUSB0"),))
    assert main(["up", "--hardware", "--cell", str(tmp_path / "config" / "cell.yaml")]) == 2
    assert "arm and tapper have the same port" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["COM3", "com12", "COM1:", "\\\\.\\COM10"])
def test_a_windows_name_is_an_error_with_the_linux_name(tmp_path: Path, name: str) -> None:
    errors, warnings = findings(tmp_path, name, "/dev/nothing")
    assert f"port {name} of arm is a name of Windows" in errors
    assert "/dev/serial/by-id/" in errors and name not in warnings


def test_a_link_that_is_gone_names_the_connected_devices(tmp_path: Path) -> None:
    links = tmp_path / "by-id"
    assert "lists no device" in port_problem(str(links / "usb-old"), links)
    links.mkdir()
    (links / "usb-new").touch()
    problem = port_problem(str(links / "usb-old"), links)
    assert "is not connected" in problem and str(links / "usb-new") in problem
    (links / "usb-gone").symlink_to(tmp_path / "ttyUSB7")
    assert "is not connected" in port_problem(str(links / "usb-gone"), links)
    assert port_problem(str(links / "usb-new"), links) == ""
    assert "does not exist (yet)" in port_problem("/dev/nothing", links)
