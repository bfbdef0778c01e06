"""Report every error in configuration files, without starting any node.

For a cell file, the files that it names are checked too. The values in all these files must be
consistent: marker ids, heights, joint limits, the tapper's speeds, the arm's reach over the table,
the planner. The kind of a file is recognised from its keys.

    python -m tapping_cell check-config config/cell.yaml
    python -m tapping_cell check-config my/objects/*.yaml --kind object --json

With --devices, the settings of arm and tapper are compared with those of the cell. Nothing moves
and nothing is charged. Each difference is printed with its remedy. With --write, settings that are
safe to store (holding torque, report format) are stored in the controller after confirmation.

    python -m tapping_cell check-config my_cell.yaml --devices --write
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.graph import HARDWARE, RECORDER, SIMULATED
from tapping_cell.configuration.cell import CellFile, load_cell
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.hints import character_hint, did_you_mean
from tapping_cell.configuration.layout_file import LayoutFile
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.configuration.problems import problems_of
from tapping_cell.configuration.schema import ConfigurationError, read_yaml
from tapping_cell.configuration.table import (
    CAMERA_KEYS,
    TableFile,
    camera_warning,
    load_camera_model,
    load_reference_map,
)
from tapping_cell.nodes import MODULES
from tapping_cell.nodes.parameters import FOREIGN_PREFIXES
from tapping_cell.simulation.truth import TruthFile

SECTIONS: dict[str, type] = {
    "cell": CellFile,
    "table": TableFile,
    "object": ObjectFile,
    "truth": TruthFile,
    "layout": LayoutFile,
}
CAMERA_INFO, PARAMETERS = "camera_info", "parameters"
KINDS = (*SECTIONS, CAMERA_INFO, PARAMETERS)
EVERY_NODE = ("**", "*")
NODES = (*dict.fromkeys((*SIMULATED, *HARDWARE, RECORDER)), "operator_page")


@dataclass
class Findings:
    """Errors found in one file."""

    file: Path
    kind: str | None
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "files",
        nargs="+",
        type=argument_types.configuration_file,
        metavar="FILE",
        help="configuration file to check",
    )
    parser.add_argument(
        "--kind", choices=KINDS, help="kind of the files (default: inferred from the keys)"
    )
    parser.add_argument(
        "--drawing",
        type=Path,
        metavar="FILE",
        help="image file (png, svg or pdf) for a drawing of the cell's fixed tappers",
    )
    parser.add_argument(
        "--devices",
        action="store_true",
        help="also connect to arm and tapper of the cell, and check their settings",
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="store the settings that are safe to store, after confirmation (only with --devices)",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if no file and no device has an error, otherwise 1; 2 for options that
    do not fit together."""
    if arguments.write and not arguments.devices:
        print_error("--write stores settings of devices; give --devices too")
        return 2
    if arguments.devices and len(arguments.files) > 1:
        print_error("--devices checks one cell; give one cell file")
        return 2
    found: list[Findings] = []
    for path in arguments.files:
        found += check(path, arguments.kind)
    # A file that is named by several cells is reported only once.
    findings = list({entry.file.resolve(): entry for entry in reversed(found)}.values())[::-1]
    if arguments.drawing is not None:
        findings += _draw(arguments.files, arguments.drawing)
    good = not any(entry.errors for entry in findings)
    console = Console(soft_wrap=True)
    if not arguments.json:
        _print(findings, console)
    content: dict[str, Any] = {
        "files": [{**vars(entry), "file": str(entry.file)} for entry in findings]
    }
    if arguments.devices and good:
        from tapping_cell.cli import device_checks  # needs ROS

        try:
            cell = load_cell(arguments.files[0])
        except ConfigurationError as error:
            print_error(str(error))
            return 1
        rows = device_checks.check_devices(cell, arguments.write)
        good = all(row.ok for row in rows)
        content["devices"] = [dataclasses.asdict(row) for row in rows]
        if not arguments.json:
            console.print(device_checks.table_of(rows))
    if arguments.json:
        print(json.dumps({"ok": good, **content}, indent=2))
    return 0 if good else 1


def _draw(files: list[Path], drawing: Path) -> list[Findings]:
    """Draw the first cell with fixed tappers. Return an error if there is no such cell or
    if the drawing fails."""
    from tapping_cell.report.layout_figure import draw_layout

    problems = []
    for path in files:
        try:
            draw_layout(load_cell(path), drawing)
        except (ConfigurationError, OSError, ValueError) as error:
            problems.append(f"no drawing: {error}")
        else:
            return []
    return [Findings(drawing, "drawing", problems)]


def _print(findings: list[Findings], console: Console) -> None:
    for entry in findings:
        text = f"{entry.file} ({entry.kind or 'unknown kind'})"
        console.print(f"{text}: {'wrong' if entry.errors else 'ok'}", highlight=False, markup=False)
        for title, colour, sentences in (
            ("error", "red", entry.errors),
            ("warning", "yellow", entry.warnings),
        ):
            for sentence in sentences:
                console.print(f"  {title}: {sentence}", style=colour, highlight=False, markup=False)


def check(path: Path, kind: str | None = None) -> list[Findings]:
    """Return the errors in a file and, for a cell file, in the files that it names."""
    try:
        document = read_yaml(path)
    except ConfigurationError as error:
        return [Findings(path, kind, [str(error)])]
    recognised = recognise(document)
    kind = kind or recognised
    found = Findings(path, kind)
    if kind is None:
        found.errors.append(
            f"{path}: the keys match no known kind of file; give --kind, one of {', '.join(KINDS)}"
        )
    elif recognised and kind != recognised and _is_instead(recognised, kind, document):
        found.errors.append(
            f"{path}: is a file of the kind {recognised}, but the kind {kind} is needed here; "
            "correct the path"
        )
    elif kind == PARAMETERS:
        found.errors += check_parameters(document, path)
    elif kind == CAMERA_INFO:
        try:
            warning = camera_warning(load_camera_model(path))
        except ConfigurationError as error:
            found.errors.append(str(error))
        else:
            found.warnings += [f"{path}: {warning}"] if warning else []
    else:
        found.errors += problems_of(SECTIONS[kind], document, str(path))
        load = {"table": load_reference_map, "object": load_object}.get(kind)
        if load is not None and not found.errors:
            found.errors += _refusal(load, path)
    if kind == "cell" and isinstance(document, Mapping):
        return [found, *_check_named(document, path, found)]
    return [found]


def _check_named(document: Mapping[Any, Any], path: Path, found: Findings) -> list[Findings]:
    """Return the files that a cell file names, with the errors in each file and the contradictions
    between files."""
    files = [
        (document.get("reference_markers"), "table"),
        (document.get("camera_info"), CAMERA_INFO),
        (document.get("object"), "object"),
    ]
    further = document.get("objects")
    if isinstance(further, list):
        # The nodes expand ~ in these paths only. Path.expanduser would fail for an unknown user.
        files += [(os.path.expanduser(e), "object") for e in further if isinstance(e, str)]
    named: list[Findings] = []
    for name, kind in files:
        if isinstance(name, str):
            named += check(path.parent / name, kind)
    if not found.errors and not any(entry.errors for entry in named):
        try:
            errors, warnings = conflicts(load_cell(path))
        except ConfigurationError as error:
            errors, warnings = [str(error)], []
        found.errors += errors
        found.warnings += warnings
    return named


def _refusal(load: Any, path: Path) -> list[str]:
    try:
        load(path)
    except ConfigurationError as error:
        return [str(error)]
    return []


def recognise(document: Any) -> str | None:
    """Return the kind of a file, inferred from its keys; None if no kind or more than one kind
    matches."""
    if not isinstance(document, Mapping) or not document:
        return None
    keys = set(document)
    nodes = {str(key).rsplit("/", 1)[-1] for key in keys} <= {*NODES, *EVERY_NODE}
    if (
        nodes
        or "ros__parameters" in keys
        or all(_holds_parameters(value) for value in document.values())
    ):
        return PARAMETERS
    names = {kind: _keys_of(kind) for kind in (*SECTIONS, CAMERA_INFO)}
    shares = sorted(
        ((len(keys & own) / len(own), kind) for kind, own in names.items()), reverse=True
    )
    (best, kind), (second, _) = shares[:2]
    return kind if best > second else None


def _is_instead(kind: str, wanted: str, document: Iterable[Any]) -> bool:
    """Return whether most keys of a document are those of files of a kind, and none is one that
    only files of the wanted kind have."""
    own, keys = _keys_of(kind), set(document)
    most = kind == PARAMETERS or 2 * len(own & keys) > len(keys)
    return most and not (_keys_of(wanted) - own) & keys


def _keys_of(kind: str) -> set[str]:
    """Return the keys at the top of a kind of file; empty for parameter files, whose keys are names
    of nodes."""
    section = SECTIONS.get(kind)
    if section is None:
        return set(CAMERA_KEYS) if kind == CAMERA_INFO else set()
    return {field.name for field in dataclasses.fields(section)}


def _holds_parameters(value: Any) -> bool:
    """Return whether a value of a document contains ``ros__parameters`` at any depth, as in a ROS
    parameter file."""
    if not isinstance(value, Mapping):
        return False
    return "ros__parameters" in value or (
        bool(value) and all(_holds_parameters(inner) for inner in value.values())
    )


def check_parameters(document: Any, path: Path) -> list[str]:
    """Return the errors in a file of ROS parameters.

    Parameters under ``/**`` apply to every node, so every node must declare them.
    """
    if not isinstance(document, Mapping) or not all(map(_holds_parameters, document.values())):
        return [
            f"{path}: is not a ROS parameter file, which contains node names with "
            "'ros__parameters' (two underscores) under each"
        ]
    nodes, misplaced = _by_node(document)
    found = [
        f"{path}: {name}: key '{key}' must be under 'ros__parameters'; correct its indentation"
        for name, key in misplaced
    ]
    for name, values in nodes:
        node = name.rsplit("/", 1)[-1]
        source = f"{path}: {name}"
        if node not in (*NODES, *EVERY_NODE):
            meant = character_hint(node) or did_you_mean(node, NODES)
            found.append(
                f"{source}: no node has this name{meant}; the nodes are {', '.join(NODES)}"
            )
            continue
        if not isinstance(values, Mapping):
            found.append(f"{source}: 'ros__parameters' must be a mapping of names to values")
            continue
        own = {key: v for key, v in values.items() if not str(key).startswith(FOREIGN_PREFIXES)}
        for known in NODES if node in EVERY_NODE else (node,):
            module = importlib.import_module(MODULES[known])
            sentences = problems_of(module.Parameters, own, source)
            found += [f"{s} (the node {known})" if node in EVERY_NODE else s for s in sentences]
    return found


def _by_node(
    document: Mapping[Any, Any], above: str = ""
) -> tuple[list[tuple[str, Any]], list[tuple[str, str]]]:
    """Return (node name with its namespace, parameters) for each node in a document, and (name,
    key) for each key below a name that is neither ``ros__parameters`` nor another name."""
    nodes: list[tuple[str, Any]] = []
    misplaced: list[tuple[str, str]] = []
    for name, value in document.items():
        place = f"{above}/{str(name).strip('/')}" if above else str(name)
        if "ros__parameters" in value:
            nodes.append((place, value["ros__parameters"]))
        inner = {}
        for key, entry in value.items():
            if key == "ros__parameters":
                continue
            if isinstance(entry, Mapping):
                inner[key] = entry
            else:
                misplaced.append((place, str(key)))
        further_nodes, further_misplaced = _by_node(inner, place)
        nodes += further_nodes
        misplaced += further_misplaced
    return nodes, misplaced
