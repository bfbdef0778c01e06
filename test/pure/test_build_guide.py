"""The figures, netlist and dimensions of the build guide agree with firmware and configuration."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import build_figures
import pytest

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "docs" / "build" / "README.md").read_text(encoding="utf-8")
BOARD = (ROOT / "firmware" / "tapper" / "board_avr.c").read_text(encoding="utf-8")


def nano_name(port: str) -> str:
    """Return the pin's name on an Arduino Nano: port D has D0 to D7, and port B begins with D8."""
    return f"D{int(port[2]) + {'D': 0, 'B': 8}[port[1]]}"


@pytest.mark.parametrize("path", build_figures.FIGURES, ids=lambda path: path.name)
def test_the_figures_are_up_to_date(path: Path) -> None:
    """If this fails, run: make reference"""
    text = build_figures.FIGURES[path]()
    assert path.read_text(encoding="utf-8") == text
    ElementTree.fromstring(text)
    assert f"]({path.name})" in GUIDE


def test_the_netlist_matches_the_firmware() -> None:
    """The netlist contains exactly the pins that the firmware defines, each with its direction."""
    defined = dict(re.findall(r"^#define (\w+) (P[BD]\d)$", BOARD, re.MULTILINE))
    (driven,) = re.findall(r"DDRD = (.*);", BOARD)
    outputs = set(re.findall(r"_BV\((\w+)\)", driven))
    assert "DDRB" not in BOARD
    assert {pin.signal: pin.port for pin in build_figures.PINS} == defined
    assert {pin.signal for pin in build_figures.PINS if pin.output} == outputs
    for pin in build_figures.PINS:
        assert pin.name == nano_name(pin.port)


def test_every_input_has_its_pull_up() -> None:
    pulled = {
        name
        for line in re.findall(r"PORT[BD] = (.*);", BOARD)
        for name in re.findall(r"_BV\((\w+)\)", line)
    }
    assert {pin.signal for pin in build_figures.PINS if not pin.output} <= pulled


def test_the_guide_lists_the_netlist() -> None:
    rows = re.findall(
        r"^\| (D\d+) \| (P[BD]\d) \| `(\w+)` \| (\w+) \| (.*) \|$", GUIDE, re.MULTILINE
    )
    expected = [
        (
            pin.name,
            pin.port,
            pin.signal,
            "output" if pin.output else "input",
            pin.wiring + (" (spring build only)" if pin.spring_only else ""),
        )
        for pin in build_figures.PINS
    ]
    assert rows == expected


def test_the_guide_has_the_dimensions_of_the_cell_file() -> None:
    file = build_figures.shipped_cell().file
    rows = re.findall(r"^\| `(arm|tapper)\.(\w+)` \| ([\d.]+) (mm|g) \|", GUIDE, re.MULTILINE)
    assert len(rows) >= 9
    for part, key, value, _ in rows:
        assert float(value) / 1e3 == pytest.approx(getattr(getattr(file, part), key)), key


def test_the_spring_deflections_match_the_firmware() -> None:
    """The deflections follow from E = k x^2 / 2, and the largest is within the carriage's
    travel."""
    stiffness = build_figures.firmware_number("SPRING_N_PER_M")
    way = build_figures.firmware_number("LONGEST_DRAW_STEPS")
    way_mm = way * build_figures.firmware_number("NM_PER_STEP") / 1e6
    energies = build_figures.shipped_cell().file.tapper.energies
    least, most = ((2 * energy / stiffness) ** 0.5 * 1e3 for energy in (energies[0], energies[-1]))
    assert f"deflections of {least:.2f} to {most:.1f} mm" in " ".join(GUIDE.split())
    assert f"its maximum travel is {way_mm:g} mm" in " ".join(GUIDE.split())
    assert most < way_mm
