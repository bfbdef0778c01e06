"""Argument types and options that several verbs use. Each type rejects an invalid value with a
readable message."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.hints import number_hint

_NAMESPACE = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*/?")
LONGEST_NAMESPACE = 200

MM_AND_DEGREES: dict[str, Any] = {"type": float, "nargs": 2, "metavar": ("MM", "DEG")}
POSE: dict[str, Any] = {"type": float, "nargs": 3, "metavar": ("X", "Y", "THETA")}
"""Settings of ``add_argument`` for a length and an angle, and for a pose, in mm and degrees."""


class Tolerance(argparse.Action):
    """Refuses a position tolerance, in mm, that is too small or too large; 0 is accepted. A pair in
    m and rad would ask for a thousandth of the accuracy that is meant."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store the pair."""
        # Imported late, because the planning package takes a second to import.
        from tapping_cell.planning import settings

        lowest = 1e3 * settings.SMALLEST_POSITION_TOLERANCE
        highest = 1e3 * settings.LARGEST_POSITION_TOLERANCE
        given = values[0]
        if given and not lowest <= given <= highest:
            in_metres = f"; if the value is in m, write {1e3 * given:g}" if 0 < given < 1 else ""
            raise argparse.ArgumentError(
                self,
                f"the position tolerance is {given:g} mm, but must be {lowest:g} to {highest:g} mm"
                f"{in_metres}",
            )
        setattr(namespace, self.dest, values)


def finite(text: str) -> float:
    """Parse a finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"'{text}' is not a finite number{_hint(text)}")
    return number


def _hint(text: str) -> str:
    """Return a hint at why an argument is no number; empty if nothing is recognised. The unit of an
    option, which may be a percentage, is in its help."""
    parts = text.split(",")
    several = len(parts) > 2 or parts[-1][:1] in ("-", "+")
    if several and all(re.fullmatch(r"[-+]?[0-9]*\.?[0-9]+", part) for part in parts):
        return f"; separate the numbers by spaces: {' '.join(parts)}"
    return number_hint(text, "the unit that --help states")


def within(lowest: float, highest: float, unit: str = "") -> Callable[[str], float]:
    """Return a parser of finite numbers between two limits, in a unit (mm, g or any other)."""

    def number(text: str) -> float:
        value = finite(text)
        if not lowest <= value <= highest:
            limits = f"{text} is outside its limits {lowest:g} to {highest:g} {unit}".strip()
            larger = {"mm": "m", "g": "kg"}.get(unit)
            if larger and lowest <= 1e3 * value <= highest:
                limits += f"; if the value is in {larger}, write {1e3 * value:g}"
            raise argparse.ArgumentTypeError(limits)
        return value

    return number


def configuration_file(text: str) -> Path:
    """Parse the path of a configuration file. A name in the package's folder ``config``, with or
    without this folder, is found from every directory."""
    given = Path(text).expanduser()
    if given.exists() or given.is_absolute():
        return given
    below = Path(*given.parts[1:]) if given.parts[:1] == ("config",) else given
    return shared_folder() / below if (shared_folder() / below).is_file() else given


def whole_number(text: str) -> int:
    """Parse an integer."""
    try:
        return int(text)
    except ValueError:
        number = float(text) if re.fullmatch(r"[0-9]+(\.[0-9]*)?([eE][0-9]+)?", text) else None
        hint = _hint(text) if number is None else ""
        if number is not None and number.is_integer():
            hint = f"; write {number:.0f}"
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number{hint}") from None


def whole(lowest: int, highest: int) -> Callable[[str], int]:
    """Return a parser of integers between two limits."""

    def number(text: str) -> int:
        value = whole_number(text)
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(f"{text} is outside its limits {lowest} to {highest}")
        return value

    return number


seed = whole(0, 2**31 - 1)
"""Parser of random seeds."""


def namespace(text: str) -> str:
    """Return a ROS namespace without slashes at its beginning and end. Without a namespace ("" or
    "/"), return an empty text."""
    if text in ("", "/"):
        return ""
    if not _NAMESPACE.fullmatch(text) or len(text) > LONGEST_NAMESPACE:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a ROS namespace: use letters, digits and _, with / between parts "
            "and no digit at the beginning of a part, such as left or hall/cell_2"
        )
    return text.strip("/")


def page_place(text: str) -> tuple[str, int]:
    """Parse address and port from ``PORT`` or ``ADDRESS:PORT``, with an IPv6 address in brackets.

    Raises:
        argparse.ArgumentTypeError: the text has neither form.
    """
    found = re.fullmatch(r"(?:(\[[0-9a-fA-F:.]+\]|[^:\[\]]+):)?(\d{1,5})", text)
    if found is None or not 0 < int(found[2]) <= 65535:
        raise argparse.ArgumentTypeError(
            f"'{text}' is neither PORT nor ADDRESS:PORT; give one such as 8010 or 0.0.0.0:8010"
        )
    return (found[1] or "localhost").strip("[]"), int(found[2])


def add_seed(parser: argparse.ArgumentParser, default: int | None, text: str) -> None:
    """Declare --seed with the help text ``text``."""
    parser.add_argument("--seed", type=seed, default=default, help=text)


def add_cell(parser: argparse.ArgumentParser) -> None:
    """Declare --cell."""
    parser.add_argument(
        "--cell",
        type=configuration_file,
        help="cell file (default: the package's cell.yaml)",
    )


def add_object(parser: argparse.ArgumentParser) -> None:
    """Declare --object of a verb that also reads a cell file."""
    parser.add_argument(
        "--object", type=configuration_file, help="object file (default: the cell's)"
    )


def add_page(parser: argparse.ArgumentParser) -> None:
    """Declare --page."""
    parser.add_argument(
        "--page",
        nargs="?",
        type=page_place,
        const=("localhost", 8010),
        metavar="[ADDRESS:]PORT",
        help="serve the operator's page (default address: localhost:8010); 0.0.0.0:PORT serves it"
        " to the whole network and requires a token",
    )


def add_namespace(
    parser: argparse.ArgumentParser, text: str = "namespace of the cell's nodes (default: none)"
) -> None:
    """Declare --namespace with the help text ``text``."""
    parser.add_argument("--namespace", type=namespace, default="", help=text)


def add_truth(parser: argparse.ArgumentParser) -> None:
    """Declare the options that set the simulation parameters."""
    parser.add_argument(
        "--truth",
        type=configuration_file,
        help="file with the simulation parameters (only in simulation; default: the package's "
        "truth/default.yaml)",
    )
    parser.add_argument(
        "--truth-object",
        type=configuration_file,
        metavar="FILE",
        help="object file with the true parameters; needed only if the planner uses another file, "
        "such as a fitted one (only in simulation; default: the planner's file)",
    )


def add_wait(parser: argparse.ArgumentParser) -> None:
    """Declare --wait of a verb that sends goals."""
    parser.add_argument(
        "--wait",
        type=within(0, 3600),
        help="longest wait for the cell, in seconds (default: 20, or 1 without any ROS node)",
    )
