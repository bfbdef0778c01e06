"""Cell files whose tapper is fired by a digital output: valid and invalid values."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tapping_cell.configuration.cell import load_cell, refuse_own_drivers, refuse_simulated_ports
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError

SECTION = {
    "interface": "service",
    "name": "/robot/set_output",
    "guard": "/robot/guard_closed",
    "pulses": [0.004, 0.012, 0.030],
}


def cell_file(folder: Path, **changes: Any) -> Path:
    """Write the package's cell file with such a tapper; a value of None removes a key."""
    shutil.copytree(shared_folder(), folder / "config")
    path = folder / "config" / "cell.yaml"
    content = yaml.safe_load(path.read_text())
    tapper = content["tapper"]
    del tapper["port"], tapper["baud"]
    tapper |= {
        "dialect": "io",
        "output": SECTION,
        "energies": [1e-4, 2e-2, 0.35],
        "speeds": [0.02, 0.6, 2.5],
    }
    tapper |= changes
    for key in [key for key, value in changes.items() if value is None]:
        del tapper[key]
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_cell_is_accepted_but_not_simulated(tmp_path: Path) -> None:
    cell = load_cell(cell_file(tmp_path))
    settings = cell.file.tapper.output_settings()
    assert settings.pulse_for(2e-2) == pytest.approx(0.012)
    errors, _ = conflicts(cell)
    assert not errors
    with pytest.raises(ConfigurationError, match="would switch the output /robot/set_output"):
        refuse_own_drivers(cell)
    with pytest.raises(ConfigurationError, match="'arm.port'"):
        refuse_simulated_ports(cell)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"output": None}, "'tapper.output' is missing"),
        ({"port": "/dev/ttyUSB0"}, "tapper.port is not used"),
        ({"dialect": "board", "port": "/dev/a"}, "not used by the dialect board"),
        ({"dialect": "board", "output": None}, "'tapper.port' is missing"),
        ({"output": SECTION | {"pulses": [0.01, 0.02]}}, "2 values, tapper.energies has 3"),
        ({"output": SECTION | {"pulses": [0.01, 0.01, 0.02]}}, "must increase"),
        ({"output": SECTION | {"pulses": [0.01, 0.05, 0.08]}}, "limit 0.1 s"),
        ({"output": SECTION | {"name": "set_output"}}, "must be a full name"),
        ({"output": SECTION | {"guard": ""}}, "must be a full name"),
        ({"output": SECTION | {"interface": "gpio"}}, "service, topic, commands, pulse"),
        ({"output": SECTION | {"latency": 0.2}}, "0.001 to 0.045 s"),
    ],
)
def test_contradictions_are_refused_with_a_message(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        load_cell(cell_file(tmp_path, **changes))
