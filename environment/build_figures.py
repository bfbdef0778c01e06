"""Draw the figures of docs/build from the configuration files and the firmware.

    python environment/build_figures.py        (or: make reference)

Dimensions come from config/cell.yaml, config/table.yaml, config/camera_info.yaml and the object's
file, pins from firmware/tapper/board_avr.c. Tests check that the figures are up to date.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from pathlib import Path

from tapping_cell.configuration.cell import Cell, load_cell

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "build"
_INK, _GREY, _BLUE, _RED = "#1c2733", "#66727f", "#2c6fbb", "#c8372d"
_STEEL, _PALE = "#b8c4d0", "#eef2f6"


class Drawing:
    """SVG drawing in its own units, with y downwards."""

    def __init__(self, width: float, height: float, title: str, heading: str) -> None:
        """``title``: name of the drawing for screen readers. ``heading``: its visible heading."""
        self._parts: list[str] = []
        self.width, self.height, self.title = width, height, title
        self.text(24, 30, heading, size=17, bold=True)

    def line(
        self,
        *points: tuple[float, float],
        color: str = _INK,
        width: float = 1.5,
        dash: str = "",
        arrow: bool = False,
    ) -> None:
        """Draw a polyline, with an arrowhead at its end if ``arrow`` is set."""
        path = " L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        extra += ' marker-end="url(#head)"' if arrow else ""
        self._parts.append(f'<path d="M{path}" stroke="{color}" stroke-width="{width}"{extra}/>')

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        fill: str = _PALE,
        color: str = _INK,
        dash: str = "",
        radius: float = 0.0,
    ) -> None:
        """Draw a rectangle."""
        extra = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'rx="{radius}" fill="{fill}" stroke="{color}" stroke-width="1.5"{extra}/>'
        )

    def circle(
        self, x: float, y: float, radius: float, fill: str = "#fff", color: str = _INK
    ) -> None:
        """Draw a circle."""
        self._parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{fill}" stroke="{color}" '
            'stroke-width="1.5"/>'
        )

    def text(
        self,
        x: float,
        y: float,
        words: str,
        anchor: str = "start",
        size: float = 13,
        color: str = _INK,
        bold: bool = False,
    ) -> None:
        """Draw a text."""
        weight = ' font-weight="bold"' if bold else ""
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}" '
            f'fill="{color}" stroke="none"{weight}>{escape(words)}</text>'
        )

    def remark(self, y: float, words: str) -> None:
        """Draw a remark at the left edge."""
        self.text(24, y, words, size=12, color=_GREY)

    def across(self, x0: float, x1: float, y: float, words: str, beside: bool = False) -> None:
        """Draw a horizontal dimension, with its text above or, if space is short, to the right."""
        for ends in (((x0, y - 6), (x0, y + 6)), ((x1, y - 6), (x1, y + 6)), ((x0, y), (x1, y))):
            self.line(*ends, color=_BLUE, width=1)
        if beside:
            self.text(max(x0, x1) + 8, y + 4, words, color=_BLUE)
        else:
            self.text((x0 + x1) / 2, y - 5, words, "middle", color=_BLUE)

    def upright(self, x: float, y0: float, y1: float, words: str, left: bool = False) -> None:
        """Draw a vertical dimension, with its text to the right or, if ``left`` is set, to the
        left."""
        for ends in (((x - 6, y0), (x + 6, y0)), ((x - 6, y1), (x + 6, y1)), ((x, y0), (x, y1))):
            self.line(*ends, color=_BLUE, width=1)
        side = -9 if left else 9
        self.text(x + side, (y0 + y1) / 2 + 4, words, "end" if left else "start", color=_BLUE)

    def note(self, x: float, y: float, to: tuple[float, float], words: str, anchor: str) -> None:
        """Draw a label with a thin line to the part that it names."""
        aside = {"start": -4, "middle": 0, "end": 4}[anchor]
        self.line((x + aside, y - 4 if aside else y + 4), to, color=_GREY, width=0.8)
        self.text(x, y, words, anchor, color=_INK)

    def svg(self) -> str:
        """Return the text of the SVG file."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            'font-family="sans-serif" fill="none" stroke-linejoin="round">\n'
            f"<title>{escape(self.title)}</title>\n"
            '<defs><marker id="head" markerWidth="9" markerHeight="8" refX="8" refY="4" '
            f'orient="auto"><path d="M0 0 L9 4 L0 8 Z" fill="{_INK}"/></marker></defs>\n'
            f'<rect width="{self.width:g}" height="{self.height:g}" fill="#fff"/>\n'
        )
        return head + "\n".join(self._parts) + "\n</svg>\n"


@dataclass(frozen=True, slots=True)
class Pin:
    """Pin of the tapper board: its names on the board and the processor, and its connection."""

    name: str
    port: str
    signal: str
    output: bool
    wiring: str
    spring_only: bool = False


PINS: tuple[Pin, ...] = (
    Pin("D2", "PD2", "INTERLOCK", False, "interlock loop to ground: guard switch, permissive"),
    Pin("D3", "PD3", "STOP_LOOP", False, "stop loop to ground: closed contact of the stop relay"),
    Pin("D4", "PD4", "RELEASE", True, "gate of the release driver; 10 kohm to ground"),
    Pin("D5", "PD5", "STEP", True, "STEP of the motor driver", True),
    Pin("D6", "PD6", "DIRECTION", True, "DIR of the motor driver; high: charges the spring", True),
    Pin("D7", "PD7", "DISABLE", True, "EN of the motor driver; 10 kohm to 5 V", True),
    Pin("D8", "PB0", "CLEAR_BUTTON", False, "clear button to ground"),
    Pin("D9", "PB1", "FRONT", False, "front switch of the carriage to ground", True),
    Pin("D10", "PB2", "ENABLING", False, "enabling switch to ground"),
)
"""Netlist of the board; a test compares it with the firmware."""


def firmware_number(name: str) -> int:
    """Return an integer that the firmware defines, such as ``SPRING_N_PER_M``.

    Raises:
        LookupError: no file of the firmware defines it.
    """
    for file in ("board_avr.c", "drive.h", "tapper.h"):
        text = (ROOT / "firmware" / "tapper" / file).read_text(encoding="utf-8")
        found = re.search(rf"#define {name} (\d+)", text)
        if found:
            return int(found[1])
    raise LookupError(f"firmware/tapper defines no {name}")


def shipped_cell() -> Cell:
    """Load the cell of config/cell.yaml."""
    return load_cell(ROOT / "config" / "cell.yaml")


def _mm(metres: float) -> str:
    return f"{metres * 1e3:g}"


def board_figure() -> str:
    """Draw the schematic of the tapper board."""
    heading = "Tapper board (ATmega328P, such as an Arduino Nano)"
    draw = Drawing(1000, 640, "Schematic of the tapper board", heading)
    draw.text(24, 50, "dashed: spring build only", color=_GREY)
    draw.box(420, 80, 160, 500, "#dfe9f5", radius=6)
    draw.text(500, 72, "Nano", "middle", 15, bold=True)
    inputs = [pin for pin in PINS if not pin.output]
    outputs = [pin for pin in PINS if pin.output]
    contacts = {
        "INTERLOCK": (("guard switch", False), ("arm's permissive", False)),
        "STOP_LOOP": (("stop relay K1, second contact", False),),
        "CLEAR_BUTTON": (("clear button", True),),
        "FRONT": (("front switch", True),),
        "ENABLING": (("enabling switch", True),),
    }
    for row, pin in enumerate(inputs):
        y = 120 + 92 * row
        dash = "7 4" if pin.spring_only else ""
        draw.text(430, y + 5, f"{pin.name}", bold=True)
        draw.text(430, y + 21, pin.signal, size=10, color=_GREY)
        names = contacts[pin.signal]
        x = 420.0
        for name, opens in names:
            end = x - 300.0 / len(names)
            middle = (x + end) / 2
            draw.line((x, y), (middle + 17, y), dash=dash)
            draw.line((middle - 17, y), (end, y), dash=dash)
            for contact in (middle + 17, middle - 17):
                draw.circle(contact, y, 3)
            draw.line((middle - 17, y - (14 if opens else 3)), (middle + 17, y - 3))
            draw.text(middle, y - 19, name, "middle", 12)
            x = end
        draw.text(270, y + 20, "pull-up in the processor, to 5 V", "middle", 11, _GREY)
        draw.line((x, y), (90, y), (90, y + 16))
        _ground(draw, 90, y + 16)
    for row, pin in enumerate(outputs):
        y = 120 + 68 * row
        dash = "7 4" if pin.spring_only else ""
        draw.text(570, y + 5, pin.name, "end", bold=True)
        draw.text(570, y + 21, pin.signal, "end", 10, _GREY)
        draw.line((580, y), (700, y), dash=dash, arrow=True)
    # The driver of the release output.
    draw.box(700, 90, 130, 62, "#fff")
    draw.text(765, 116, "release driver", "middle", 12)
    draw.text(765, 134, "logic-level MOSFET", "middle", 11, _GREY)
    draw.line((640, 120), (640, 132))
    draw.box(634, 132, 12, 24, "#fff")
    draw.line((640, 156), (640, 162))
    _ground(draw, 640, 162)
    draw.text(630, 148, "10 k", "end", 11)
    draw.line((830, 120), (880, 120))
    draw.box(880, 96, 96, 50, "#f6dedb", _RED)
    draw.text(928, 118, "latch magnet", "middle", 12)
    draw.text(928, 134, "or coil L1", "middle", 12)
    draw.line((928, 96), (928, 70), (780, 70))
    draw.text(776, 66, "24 V, through contact of K1", "end", 12, _RED)
    draw.line((880, 160), (976, 160), color=_RED, width=1)
    draw.line((880, 146), (880, 160), color=_RED, width=1)
    draw.line((976, 146), (976, 160), color=_RED, width=1)
    draw.text(928, 175, "D1 across L1", "middle", 11, _RED)
    # The motor driver.
    draw.box(700, 168, 130, 180, "#fff", dash="7 4")
    for row, name in enumerate(("STEP", "DIR", "EN")):
        draw.text(710, 193 + 68 * row, name, size=12)
    draw.text(818, 230, "step-and-", "end", 12)
    draw.text(818, 246, "direction", "end", 12)
    draw.text(818, 262, "driver", "end", 12)
    draw.text(818, 284, "1/8 steps", "end", 11, _GREY)
    draw.line((640, 324), (640, 348), dash="7 4")
    draw.box(634, 348, 12, 24, "#fff", dash="4 3")
    draw.line((640, 372), (640, 386), dash="7 4")
    draw.text(640, 402, "5 V", "middle", 12, _RED)
    draw.text(652, 365, "10 k", size=11)
    draw.line((830, 258), (890, 258), dash="7 4")
    draw.circle(924, 258, 34, "#f6dedb", _RED)
    draw.text(924, 263, "M1", "middle", 14, bold=True)
    draw.line((765, 348), (765, 376), dash="7 4")
    draw.text(765, 392, "motor supply, through contact of K1", "middle", 12, _RED)
    # Power supply and host.
    draw.line((580, 470), (700, 470))
    draw.box(700, 446, 276, 48, "#fff")
    draw.text(838, 475, "USB to the computer: 5 V, 115200 baud", "middle", 12)
    draw.line((580, 540), (640, 540), (640, 556))
    _ground(draw, 640, 556)
    draw.text(570, 545, "GND", "end", bold=True)
    draw.text(660, 545, "one star point with the grounds of", size=12)
    draw.text(660, 561, "the 24 V and the motor supply", size=12)
    draw.text(570, 475, "USB", "end", bold=True)
    draw.remark(
        620,
        "K1: the emergency stop's relay. It opens the supplies of coil and motor; its second"
        " contact opens the stop loop. Release is high, EN is low when active.",
    )
    return draw.svg()


def _ground(draw: Drawing, x: float, y: float) -> None:
    for half, drop in ((10, 0), (6, 4), (2, 8)):
        draw.line((x - half, y + drop), (x + half, y + drop), width=1.3)


def striker_figure(spring: bool) -> str:
    """Draw a side view of the striker at the strike pose, with the dimensions of the cell file."""
    cell = shipped_cell()
    arm, tapper = cell.arm, cell.file.tapper
    title = f"Striker, {'spring' if spring else 'solenoid'} build"
    draw = Drawing(1120, 640, title, f"{title}, at the strike pose; side view, mm")
    scale, tip, table = 4000.0, 640.0, 420.0
    axis = table - arm.strike_height * scale
    ball = tapper.tip_radius * scale
    start, back = tip - tapper.tool_start * scale, tip - tapper.tool_length * scale
    edge, end = tip + (tapper.standoff + tapper.tip_radius) * scale, tip + tapper.stroke * scale
    top = axis - 96
    # Table, object, quill, housing and striker.
    draw.line((40, table), (1000, table), width=2.5)
    draw.text(44, table + 18, "table", color=_GREY)
    height = cell.object.height * scale
    draw.box(edge, table - height, 1000 - edge, height, "#e3e7ec")
    draw.text((edge + 1000) / 2, table - height / 2 + 5, "object", "middle")
    quill = tip - arm.tip_forward * scale
    draw.box(quill - 26, 60, 52, top - 60, _STEEL)
    draw.line((quill, 52), (quill, axis + 40), color=_GREY, width=0.8, dash="10 3 2 3")
    draw.note(quill - 60, 84, (quill - 26, 100), "quill and tool flange", "end")
    draw.box(back, top, start - back, axis + 20 - top, "#f7f9fb")
    tail = 260 if spring else 340
    draw.box(tip - tail, axis - 12, tail, 24, _STEEL)
    draw.circle(tip, axis, ball, "#f6dedb", _RED)
    bushes = (tip - 240, tip - 200) if spring else (start - 34, start - 150)
    for x in bushes:
        draw.box(x, axis - 17, 32, 34, "#dfe9f5")
    draw.note(tip + 20, 254, (bushes[0 if not spring else 1] + 28, axis - 14), "bushes", "start")
    if spring:
        _spring_drive(draw, tip, axis, back, top)
    else:
        _solenoid_drive(draw, tip, axis, back, top)
    # Dimensions.
    draw.across(ball + tip, edge, axis - 40, f"standoff {_mm(tapper.standoff)}", beside=True)
    draw.across(tip, end, axis - 74, f"stroke {_mm(tapper.stroke)}", beside=True)
    for x, y0, y1 in (
        (tip, axis - 80, table + 124),
        (ball + tip, axis - 46, axis),
        (edge, axis - 46, axis),
        (end, axis - 80, axis),
        (start, axis, table + 46),
        (back, axis, table + 84),
        (quill, axis, table + 124),
    ):
        draw.line((x, y0), (x, y1), color=_BLUE, width=0.7, dash="3 3")
    draw.across(start, tip, table + 40, f"tool_start {_mm(tapper.tool_start)}", beside=True)
    draw.across(back, tip, table + 78, f"tool_length {_mm(tapper.tool_length)}", beside=True)
    draw.across(quill, tip, table + 118, f"tip_forward {_mm(arm.tip_forward)}", beside=True)
    draw.line((tip, axis), (1030, axis), color=_BLUE, width=0.7, dash="8 3 2 3")
    draw.upright(1030, axis, table, "")
    draw.text(1022, axis - 34, f"strike_height {_mm(arm.strike_height)}", "end", color=_BLUE)
    ball_text = f"hardened ball, tip_radius {_mm(tapper.tip_radius)}"
    draw.note(tip + 20, 214, (tip + 4, axis - ball), ball_text, "start")
    draw.remark(
        622,
        f"Moving mass {tapper.mass * 1e3:g} g. The housing stays within {_mm(tapper.tool_radius)} "
        "(tool_radius) either side of the axis, seen from above, at the height of the object.",
    )
    return draw.svg()


def _spring_drive(draw: Drawing, tip: float, axis: float, back: float, top: float) -> None:
    """Draw the spring mechanism: spring, latch, carriage on a screw, motor, front switch."""
    tail = tip - 260
    pitch = (tail - 20 - back) / 16
    teeth = [(back + (k + 0.5) * pitch, axis + (-14 if k % 2 else 14)) for k in range(16)]
    draw.line((back, axis), *teeth, (tail - 20, axis), color=_RED, width=2)
    draw.box(tail - 20, axis - 34, 20, 50, _STEEL)
    draw.line((back, top + 27), (tip - 110, top + 27), width=5, color=_STEEL)
    draw.box(back - 92, top + 3, 92, 48, "#dfe9f5")
    draw.text(back - 46, top + 32, "M1", "middle", bold=True)
    draw.box(tail - 40, top + 14, 60, 26, "#dfe9f5")
    draw.line((tail + 8, top + 40), (tail + 8, axis - 22), (tail, axis - 22), width=4, color=_RED)
    draw.box(tail + 24, top + 34, 22, 12, "#fff")
    lead = firmware_number("NM_PER_STEP") * 1600 / 1e6
    stiffness = firmware_number("SPRING_N_PER_M")
    strongest = (2 * shipped_cell().file.tapper.energies[-1] / stiffness) ** 0.5 * 1e3
    draw.note(back + 60, 150, (tail - 20, top + 14), "carriage on the screw", "end")
    draw.note(back + 60, 180, (tail + 4, top + 52), "latch with magnet L1", "end")
    draw.note(tip - 160, 120, (tail + 40, top + 36), "front switch (D9)", "start")
    draw.note(tip - 160, 150, (tip - 150, top + 24), f"screw, lead {lead:g}", "start")
    draw.note(back - 20, axis - 6, (back + 8, axis), f"spring, {stiffness} N/m", "end")
    draw.remark(
        602,
        "Shown at the front end, the spring just slack. The carriage draws the striker to the left,"
        f" by {strongest:.1f} at the cell file's greatest energy; the ball enters a bore.",
    )


def _solenoid_drive(draw: Drawing, tip: float, axis: float, back: float, top: float) -> None:
    """Draw the solenoid mechanism: coil, plunger, weak return spring and its stop."""
    for side in (axis - 62, axis + 13):
        draw.box(back + 60, side, 190, 6 if side > axis else 48, "#f6dedb", _RED)
    for k in range(11):
        draw.line((back + 70 + 17 * k, axis - 60), (back + 78 + 17 * k, axis - 15), color=_RED)
    draw.box(tip - 340, axis - 12, 120, 24, "#66727f")
    draw.box(back + 4, axis - 16, 14, 32, "#dfe9f5")
    teeth = [(back + 20 + 8.0 * k, axis + (-6 if k % 2 else 6)) for k in range(15)]
    draw.line((back + 18, axis), *teeth, (tip - 340, axis), color=_INK, width=1.2)
    draw.note(tip - 180, 150, (tip - 240, axis - 58), "coil L1", "start")
    draw.note(tip - 180, 180, (tip - 224, axis - 6), "iron plunger, screwed to the rod", "start")
    draw.note(back - 20, axis - 6, (back + 12, axis), "return spring, stop", "end")
    rows = re.search(
        r"#define SOLENOID_TABLE \{(\d+), (\d+)\}.*\{(\d+), (\d+)\}",
        (ROOT / "firmware" / "tapper" / "board_avr.c").read_text(encoding="utf-8"),
    )
    if rows is None:
        raise LookupError("firmware/tapper/board_avr.c defines no SOLENOID_TABLE")
    low, short, high, long = (int(number) for number in rows.groups())
    draw.remark(
        602,
        f"The energy is the width of the pulse: {low / 1e3:g} mJ at {short / 1e3:g} ms to"
        f" {high / 1e3:g} mJ at {long / 1e3:g} ms until you have measured your own.",
    )


def table_figure() -> str:
    """Draw the table from above: markers, working area, arm and guard."""
    cell = shipped_cell()
    area, arm = cell.file.table, cell.arm
    scale, middle, origin = 900.0, 440.0, 560.0

    def at(x: float, y: float) -> tuple[float, float]:
        return middle + scale * x, origin - scale * y

    heading = "The table from above, mm in the frame table"
    draw = Drawing(900, 880, "Reference markers on the table", heading)
    left, upper = at(-area.length / 2, area.width / 2)
    draw.box(left, upper, area.length * scale, area.width * scale, "#f7f9fb", dash="6 4")
    draw.text(
        left + 8, upper + 20, f"usable area {_mm(area.length)} x {_mm(area.width)}", color=_GREY
    )
    for marker in cell.references.markers:
        x, y = at(marker.x, marker.y)
        half = marker.size * scale / 2
        draw.box(x - half, y - half, 2 * half, 2 * half, _INK)
        draw.text(x, y + 5, str(marker.id), "middle", 13, "#fff", bold=True)
        above = marker.y >= 0
        label = f"{marker.x * 1e3:g}, {marker.y * 1e3:g}"
        draw.text(x, y - half - 7 if above else y + half + 17, label, "middle", 12, _BLUE)
    x, y = at(0, 0)
    draw.line((x, y), (x + 70, y), arrow=True)
    draw.line((x, y), (x, y - 70), arrow=True)
    draw.text(x + 76, y + 5, "x")
    draw.text(x - 4, y - 78, "y")
    x, y = at(arm.base[0], arm.base[1])
    draw.circle(x, y, 24, "#dfe9f5")
    draw.circle(x, y, 3, _INK)
    draw.text(x + 34, y - 4, "shoulder axis of the arm (arm.base)")
    draw.text(x + 34, y + 14, f"{_mm(arm.base[0])}, {_mm(arm.base[1])}", color=_BLUE)
    size = _mm(cell.references.markers[0].size)
    draw.remark(
        862,
        f"Black squares of {size}, {cell.references.dictionary}, upright as printed,"
        " with a white rim of 5 at least.",
    )
    return draw.svg()


def camera_height() -> tuple[float, float, float, float]:
    """Return the minimum camera height for all markers, the drawn height and its field of view."""
    cell = shipped_cell()
    camera = cell.camera
    rim = 0.03
    wide = 2 * max(abs(m.x) + m.size / 2 + rim for m in cell.references.markers)
    deep = 2 * max(abs(m.y) + m.size / 2 + rim for m in cell.references.markers)
    least = max(wide * camera.fx / camera.width, deep * camera.fy / camera.height)
    height = math.ceil(least * 20 - 1e-9) / 20
    return least, height, height * camera.width / camera.fx, height * camera.height / camera.fy


def camera_figure() -> str:
    """Draw a front view of the camera's mount and the light."""
    cell = shipped_cell()
    least, height, wide, deep = camera_height()
    scale, middle, table = 620.0, 420.0, 580.0
    title = "Camera mount and light"
    draw = Drawing(900, 680, title, f"{title}, front view, mm")
    lens = table - height * scale
    half = wide * scale / 2
    draw.line((60, table), (780, table), width=3)
    draw.text(64, table + 18, "table", color=_GREY)
    for x in (middle - half - 60, middle + half + 60):
        draw.box(x - 8, 70, 16, table - 70, _STEEL)
    draw.box(middle - half - 68, 62, 2 * half + 136, 16, _STEEL)
    draw.text(middle, 56, "profile 40 x 40, braced, bolted to the table's frame", "middle")
    draw.box(middle - 16, 78, 32, lens - 78 - 12, "#dfe9f5")
    draw.box(middle - 24, lens - 44, 48, 36, _STEEL)
    draw.box(middle - 12, lens - 8, 24, 12, _INK)
    draw.text(middle + 32, lens - 24, "camera")
    draw.line((middle, lens), (middle - half, table), color=_BLUE, width=0.8, dash="6 4")
    draw.line((middle, lens), (middle + half, table), color=_BLUE, width=0.8, dash="6 4")
    for side in (-1, 1):
        x = middle + side * (half + 20)
        draw.line((x - side * 26, 214), (x + side * 14, 254), width=9, color="#e0a93c")
        for k in (0.25, 0.6, 0.95):
            draw.line(
                (x - side * 10, 240),
                (middle + side * half * (1 - 1.5 * k), table - 6),
                color="#e0a93c",
                width=0.9,
                dash="2 4",
            )
    draw.text(middle - half + 16, 206, "LED panel with diffuser", "start", 12)
    draw.text(middle - half + 16, 222, "one on each side, about 45 deg", "start", 12, _GREY)
    rim = max(abs(m.x) for m in cell.references.markers) * scale
    size = cell.references.markers[0].size * scale
    for x in (middle - rim, middle, middle + rim):
        draw.line((x - size / 2, table - 3), (x + size / 2, table - 3), width=6)
    draw.across(
        middle - half, middle + half, table + 42, f"seen: {wide * 1e3:.0f} x {deep * 1e3:.0f}"
    )
    draw.upright(middle + half + 110, lens, table, f"{_mm(height)}")
    draw.remark(
        656,
        f"For config/camera_info.yaml: {cell.camera.width} x {cell.camera.height} pixels, focal"
        f" length {cell.camera.fx:g} pixels. Least height for all markers {least * 1e3:.0f}.",
    )
    return draw.svg()


def guard_figure() -> str:
    """Draw the emergency stop, the guard and the parts on which they act."""
    title = "Emergency stop and guard"
    draw = Drawing(1000, 420, title, f"{title}: what opens what")
    boxes = (
        (30, 90, 170, "emergency-stop button", "two positive-opening contacts", _RED),
        (30, 210, 170, "guard switch", "positive opening or coded", _RED),
        (30, 320, 170, "arm's permissive", "standstill or drives off", _GREY),
        (330, 90, 190, "safety relay K1", "two channels, manual reset", _RED),
    )
    for x, y, width, name, detail, color in boxes:
        draw.box(x, y, width, 60, "#fff", color, radius=4)
        draw.text(x + width / 2, y + 27, name, "middle", bold=True)
        draw.text(x + width / 2, y + 46, detail, "middle", 11, _GREY)
    draw.line((200, 112), (330, 112), arrow=True)
    draw.line((200, 130), (330, 130), arrow=True)
    draw.text(265, 105, "2 channels", "middle", 11)
    actions = (
        (60, "supply of the arm's motors; the quill's brake falls in"),
        (110, "supply of M1 and of L1 at the tapper"),
        (160, "D3 of the tapper board: the stop latches"),
        (210, "second input of the arm's controller: alarm"),
    )
    for y, words in actions:
        draw.box(640, y, 336, 36, "#f7f9fb")
        draw.text(652, y + 23, words, size=12)
        draw.line((520, 120), (580, 120), (580, y + 18), (640, y + 18), arrow=True)
    draw.line((200, 240), (420, 240))
    draw.line((420, 240), (420, 296), (640, 296), arrow=True)
    draw.line((200, 350), (420, 350), (420, 296))
    draw.text(432, 288, "in series", size=11)
    draw.box(640, 270, 336, 52, "#f7f9fb")
    draw.text(652, 291, "D2 of the tapper board: no charge, no release,", size=12)
    draw.text(652, 309, "what is charged is discharged (firmware)", size=12)
    draw.line((115, 210), (115, 182), (290, 182), (290, 142), (330, 142), color=_RED, arrow=True)
    draw.text(122, 198, "stops arm and release", size=11, color=_RED)
    draw.remark(
        408,
        "Everything to the left of the arrows is hardware. Software and both boards only add to"
        " it.",
    )
    return draw.svg()


def ring_figure() -> str:
    """Draw the fixed tappers of the positioning cell from above, with the table of their mounts."""
    cell = load_cell(ROOT / "config" / "positioning_cell" / "cell.yaml")
    fixed, tapper = cell.file.fixed_tappers, cell.file.tapper
    assert fixed is not None
    scale, middle = 1350.0, (400.0, 440.0)

    def at(x: float, y: float) -> tuple[float, float]:
        return middle[0] + scale * x, middle[1] - scale * y

    heading = f"{len(fixed.tappers)} fixed tappers from above, mm and degrees in the frame table"
    draw = Drawing(1180, 850, "Mounts of the fixed tappers", heading)
    x, y, radius = fixed.working_area
    draw.circle(*at(x, y), radius * scale, "#f7f9fb", _BLUE)
    draw.text(middle[0], middle[1] + 0.055 * scale, "working disc,", "middle", 12, _BLUE)
    draw.text(middle[0], middle[1] + 0.066 * scale, f"radius {_mm(radius)}", "middle", 12, _BLUE)
    draw.line(at(0, 0), at(0.03, 0), arrow=True)
    draw.line(at(0, 0), at(0, 0.03), arrow=True)
    draw.text(at(0.034, 0)[0], at(0, 0)[1] + 4, "x")
    draw.text(at(0, 0)[0] - 4, at(0, 0.034)[1], "y")
    for one in fixed.tappers:
        px, py = one.position
        cos, sin = math.cos(one.direction), math.sin(one.direction)
        end = at(px + tapper.stroke * cos, py + tapper.stroke * sin)
        draw.line(at(px, py), end, color=_GREY, width=0.8, dash="5 4", arrow=True)
        back, front = (-tapper.tool_length, -tapper.tool_start)
        bar = [at(px + s * cos, py + s * sin) for s in (back, front)]
        draw.line(*bar, color="#b9c7d6", width=2.0 * tapper.tool_radius * scale)
        draw.circle(*at(px, py), tapper.tip_radius * scale, _INK)
        label = at(px - 0.065 * cos, py - 0.065 * sin)
        draw.text(label[0], label[1] + 4, one.name, "middle", 12, _INK, bold=True)
    left, top = 810.0, 90.0
    names = ("tapper", "x", "y", "direction", "channel")
    columns = tuple(zip((0.0, 110.0, 170.0, 245.0, 325.0), names, strict=True))
    for offset, words in columns:
        draw.text(left + offset, top, words, "start" if offset == 0.0 else "end", 13, bold=True)
    for row, one in enumerate(fixed.tappers, 1):
        values = (
            one.name,
            f"{1e3 * one.position[0]:.1f}",
            f"{1e3 * one.position[1]:.1f}",
            f"{math.degrees(one.direction):.1f}",
            str(one.channel),
        )
        for (offset, _), value in zip(columns, values, strict=True):
            anchor = "start" if offset == 0.0 else "end"
            draw.text(left + offset, top + 26 * row, value, anchor, 13)
    notes = (
        "x, y: centre of the ball at rest",
        "direction: of its travel, counter-clockwise from x",
        f"stroke: {_mm(tapper.stroke)} (dashed)",
        f"height of the ball's centre: {_mm(fixed.strike_height)}",
        f"ball: radius {1e3 * tapper.tip_radius:.1f}; striker: {1e3 * tapper.mass:.0f} g",
        "a line must be known to 0.3 at the contact: measure it",
    )
    for row, words in enumerate(notes):
        draw.text(left, top + 26 * (len(fixed.tappers) + 2) + 24 * row, words, size=13, color=_GREY)
    return draw.svg()


FIGURES: dict[Path, Callable[[], str]] = {
    FOLDER / "tapper_board.svg": board_figure,
    FOLDER / "striker_spring.svg": lambda: striker_figure(spring=True),
    FOLDER / "striker_solenoid.svg": lambda: striker_figure(spring=False),
    FOLDER / "table.svg": table_figure,
    FOLDER / "camera.svg": camera_figure,
    FOLDER / "guard.svg": guard_figure,
    FOLDER / "ring.svg": ring_figure,
}


if __name__ == "__main__":
    for file, figure in FIGURES.items():
        file.write_text(figure(), encoding="utf-8")
