"""Write the reference pages of docs/ and the list of options that are made from the code.

    python environment/reference_pages.py        (or: make reference)

Tests check that the pages are up to date.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import json
import re
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.cli import VERBS, verb_parser
from tapping_cell.cli.errors import MEANINGS, ExitStatus
from tapping_cell.configuration.cell import CellFile
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.table import TableFile
from tapping_cell.conformance import arm, camera, planner, tapper
from tapping_cell.logic import arm_states, planner_states, tapper_states
from tapping_cell.logic.transitions import diagram
from tapping_cell.report import error_codes
from tapping_cell.report.columns import declared
from tapping_cell.report.run import TapRow
from tapping_cell.report.sweep import COLUMNS, SWEEP
from tapping_cell.report.tables import (
    METHOD,
    RUN_COLUMNS,
    RUNS,
    SCENE_COLUMNS,
    SCENES,
    TRIAL_COLUMNS,
    TRIALS,
)
from tapping_cell.simulation.truth import TruthFile

SHARED_BY = 3
"""Number of verbs with the same option from which the page lists it once."""
DOCS = Path(__file__).resolve().parent.parent / "docs"
_HEAD = """# Commands

`python -m tapping_cell VERB`, or `ros2 run tapping_cell cell VERB`. Every verb has `--help` with an
example. On the command line, lengths are in mm and angles in degrees. With `--json`, a verb prints
its results as JSON on standard output and its messages on standard error. A command that
takes long shows its progress there.

The Tab key completes verbs and options after the command

    eval "$(python -m tapping_cell completion)"

in `~/.bashrc`. The command also makes `cell` an abbreviation: `cell goal 20 10 0`.

Errors are printed on standard error in the form `error: what is wrong, the value and the limit;
what to do`, with the number of the [error code](error_codes.md) if there is one. Errors on the
command line or in a file are reported before anything starts. Every verb ends with one of these
exit codes:

| exit code | meaning |
| --- | --- |
"""
_AFTER_STATUSES = """
To operate a running cell, the command `ros2` is not needed: [status](#status), [home](#home),
[stop](#stop), [clear](#clear) and [goal](#goal) show and control the cell as the operator page
does, in the ROS domain of `ROS_DOMAIN_ID`.

`make reference` writes this page.

## Shared options

Several verbs have these options:

"""
_ERROR_CODES = """# Error codes

Every refusal and failure of the cell has a number, declared in `tapping_cell_msgs/msg/ErrorCode`,
and a message with the value and the limit. The command line, the report of a run and the operator
page also show the remedy.

`make reference` writes this page from `msg_defs/msg/ErrorCode.msg`.
"""
_BLOCK = re.compile(r"(?<=<!-- make reference: )([\w.]+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)
"""Part of a page that is written here, between two comments, the first with the part's name."""
_HUNDREDS = {
    1: "goals and commands",
    2: "configuration",
    3: "camera and object",
    4: "planning",
    5: "the arm",
    6: "the tapper",
    9: "the cell",
}


def commands_page() -> str:
    """Return the page on all verbs and options, generated from the parsers."""
    statuses = (f"| {status.value} | {MEANINGS[status]} |\n" for status in ExitStatus)
    parsers = {verb: verb_parser(verb)[0] for verb in VERBS}
    counts = Counter(row for parser in parsers.values() for row in _all_rows(parser))
    shared = _shared(counts)
    parts = [_HEAD, *statuses, _AFTER_STATUSES, *_option_rows(shared)]
    for verb, text in VERBS.items():
        parts.append(f"\n## `{verb}`\n\n{text[0].upper()}{text[1:]}.\n")
        parts += [f"\n    {line}\n" for line in examples(parsers[verb])[:1]]
        parts += _tables(parsers[verb], shared)
    return "".join(parts)


def examples(parser: argparse.ArgumentParser) -> list[str]:
    """Return the command lines in a parser's description."""
    text = re.sub(r"\\\n *", "", inspect.cleandoc(parser.description or ""))
    lines = text.splitlines()
    return [line.strip() for line in lines if line.strip().startswith("python -m tapping_cell ")]


def _shared(counts: Counter[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the options that several verbs share; if one has several texts, the most frequent."""
    frequent: dict[str, tuple[str, str]] = {}
    for row, count in counts.most_common():
        if count >= SHARED_BY:
            frequent.setdefault(row[0].split(" ")[0], row)
    return sorted(frequent.values())


def _option_rows(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    yield from (f"- {name}: {text}\n" for name, text in rows)


def _all_rows(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Yield name and text of each option of a verb and of its subcommands."""
    yield from _rows(parser)
    for _, own in _subcommands(parser):
        yield from _all_rows(own)


def _rows(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    for action in parser._actions:
        if not isinstance(action, (argparse._SubParsersAction, argparse._HelpAction)):
            yield _name(action), _text(action.help) + _default(action)


def _subcommands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


def _tables(parser: argparse.ArgumentParser, shared: list[tuple[str, str]]) -> Iterator[str]:
    rows = list(_rows(parser))
    own = [row for row in rows if row not in shared]
    if own:
        yield "\n"
        yield from _option_rows(own)
    if len(own) < len(rows):
        names = ", ".join(name.split(" ")[0] for name, text in rows if (name, text) in shared)
        yield f"\n[Shared options](#shared-options): {names}\n"
    for name, inner in _subcommands(parser):
        yield f"\n### `{parser.prog.rsplit(' ', 1)[-1]} {name}`\n"
        yield from _tables(inner, shared)


def _name(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings)
    metavar = action.metavar or ("" if action.nargs == 0 else action.dest.upper().replace("_", "-"))
    if action.choices is not None and action.metavar is None:
        metavar = ", ".join(str(choice) for choice in action.choices)
    values = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    return f"{names} {values}".strip() if names else f"`{values}`"


def _default(action: argparse.Action) -> str:
    """Return the default in brackets, unless the option's text gives it."""
    value = action.default
    if value in (None, False, "", [], argparse.SUPPRESS) or not action.option_strings:
        return ""
    if "default: " in (action.help or ""):
        return ""
    shown = " ".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)
    return f" (default: {shown})"


def _text(words: str | None) -> str:
    return (words or "").replace("%%", "%")


def options_file() -> str:
    """Return the file with the options of each verb and the choices of each option, in which
    ``python -m tapping_cell`` finds a typo without loading the verb."""
    known: dict[str, dict[str, list[str] | None]] = {}
    for verb in VERBS:
        parsers = [(verb, verb_parser(verb)[0])]
        for name, parser in parsers:
            own = known.setdefault(name, {})
            for action in parser._actions:
                if isinstance(action, argparse._SubParsersAction):
                    parsers += [(f"{verb} {sub}", one) for sub, one in action.choices.items()]
                    continue
                single = action.nargs is None and action.type is None
                choices = [str(each) for each in action.choices or ()] if single else None
                own |= {option: choices or None for option in action.option_strings}
    lines = (f" {json.dumps(verb)}: {json.dumps(own)}" for verb, own in known.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def error_codes_page() -> str:
    """Return the page on all error codes, with symptom, cause and remedy."""
    parts = [_ERROR_CODES]
    hundred = 0
    for number, code in error_codes.codes().items():
        if number // 100 != hundred:
            hundred = number // 100
            parts.append(f"\n## {hundred}xx: {_HUNDREDS[hundred]}\n")
        if number:
            parts.append(
                f"\n### {number} {code.name}\n\n{_sentence(code.symptom)}\n\n"
                f"- Cause: {code.cause}\n- Remedy: {code.remedy}\n"
            )
    return "".join(parts)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


_CONFIGURATION = """# Configuration files

This page lists every key of every YAML file that the cell reads. Values are in SI units and
radians. A key that has no default and is not optional is required. Unknown keys, missing keys,
wrong types and values out of range are refused with a message that names file, key, value and
range. `python -m tapping_cell check-config` checks all files, and the consistency between them,
without starting any node. The files in [config/](../config) are complete examples.
[nodes.md](nodes.md) lists the ROS parameters of the nodes.

Plain values follow YAML 1.2: numbers are decimal, and `yes` or `on` is a text. Notations that some
programs read as another number (`011`, `0x1F`, `1_000`, `1:30`) are refused with their line, as are
values that contradict each other or physics.

![Dimensions of the arm and the striker](images/arm_dimensions.svg)

`make reference` writes this page from the declarations in the code.
"""
_CONTRACTS = """# Contracts and state machines of the nodes

Any node of the cell can be replaced by one of your own: a pose estimator, the driver of another
arm, a planner in another language. The substitute has the topics, services and QoS of
[nodes.md](nodes.md#topics) and fulfils the duties below, on which the other nodes rely
([safety.md](safety.md)).

    python -m tapping_cell conformance scara_arm

plays all other nodes, checks each duty of the running node, and ends with 0 if all are fulfilled.
Run only the node under test in this ROS domain, with `sim_world` if its device is simulated.
`camera_pose` is checked beside the running cell, with the object at rest in view. The checks of
`scara_arm` move the arm over the table, and those of `tapper_trigger` fire the striker: clear the
table, and keep away. After the last duty, the stop, a person presses the clear button.

Examples: [pose_estimator.py](../examples/own_nodes/pose_estimator.py) takes the poses of a
motion-capture system; [pick_list.py](../examples/own_nodes/pick_list.py) sends goals to the
planner; [planning_scene.py](../examples/own_nodes/planning_scene.py) gives table and objects to
MoveIt.

Three rules hold for every node:

- Times are compared by stamps in ROS time, so that a message that waited in a queue counts as old.
- Only one node publishes a state or command of a cell; while two do, nothing is charged, fired or
  moved (error 205).
- A `tap_id` is used once, and ids increase, even after a restart.

`make reference` writes this page.
"""
FILES: tuple[tuple[str, str, type], ...] = (
    (
        "Cell file",
        "`cell.yaml`: table, arm, tapper, camera and goals.",
        CellFile,
    ),
    ("Object file", "`objects/*.yaml`: one object.", ObjectFile),
    ("Table file", "`table.yaml`: the reference markers.", TableFile),
    ("Header of an experiment", "`experiment.yaml` of a folder of single taps.", ExperimentFile),
    (
        "Simulation parameters",
        "`truth/*.yaml`: how the simulated world differs from the configuration files.",
        TruthFile,
    ),
)
_STATE_MACHINES = """
## State machines

The diagrams come from the tables in `tapping_cell/logic`, without the transitions that most states
have in common. A transition that is not shown is not permitted: if it occurred, the node would
enter a safe state and report code 904.
"""
_Rules = Mapping[tuple[Any, Any], frozenset[Any]]
_MACHINES: dict[str, tuple[str, _Rules, Enum]] = {
    "Arm": (
        """In `Leaving` the arm waits until its promise to stand still has ended; `arm_state`
reports this state as WITHDRAWING. `Inactive` is reported as FAULT with code 903.""",
        arm_states.TABLE,
        arm_states.State.DISCONNECTED,
    ),
    "Tapper": (
        """In `Waiting` the tapper has a tap and waits for the arm; `tapper_state` reports this
state as SAFE. In `Charged` the tapper requests the arm's promise to stand still.""",
        tapper_states.TABLE,
        tapper_states.State.DISCONNECTED,
    ),
    "Planner": (
        """The planner does not latch a stop. A stop ends the goal, and further goals are refused
while arm or tapper reports a stop or a fault.""",
        planner_states.TABLE,
        planner_states.State.IDLE,
    ),
}
_PARTS = {
    camera: "measures the pose of the object",
    planner: "chooses the taps",
    arm: "moves the striker",
    tapper: "charges and fires the striker",
}
_TITLES = {kind: title.lower() for title, _, kind in FILES}


def configuration_page() -> str:
    """Return the page on all keys of all files, generated from the declarations."""
    parts = [_CONFIGURATION]
    written: dict[type, str] = {}
    for title, text, kind in FILES:
        parts.append(f"\n## {title}\n\n{text}\n")
        parts += _section_tables(kind, "", title, written)
    parts.append(
        "\n## Camera calibration\n\n`camera_info.yaml` has the format of ROS's "
        "`camera_calibration`; "
        "`calibrate camera` writes it.\n"
    )
    return "".join(parts)


def _section_tables(kind: type, prefix: str, title: str, written: dict[type, str]) -> Iterator[str]:
    """Yield the table of a section and those of its subsections; each kind of section is listed
    once."""
    hints = typing.get_type_hints(kind)
    inner: list[tuple[str, type]] = []
    yield "\n"
    for entry in dataclasses.fields(kind):
        limits = entry.metadata["limits"]
        held = _sections_in(hints[entry.name])
        name = f"{prefix}{entry.name}"
        meaning = limits.description
        if held in _TITLES:
            meaning += f"; keys as in the {_TITLES[held]}"
        elif held is not None:
            known = written.setdefault(held, name)
            if known == name:
                inner.append((name, held))
            else:
                meaning += f"; keys as in `{known}`"
        yield f"- `{name}` ({_values(entry, _type_text(hints[entry.name]))}): {meaning}\n"
    for name, held in inner:
        first = (inspect.getdoc(held) or "").split("\n\n")[0].replace("\n", " ")
        yield f"\n### `{name}` ({title.lower()})\n\n{first}\n"
        yield from _section_tables(held, f"{name}.", title, written)


def _values(entry: dataclasses.Field[Any], kind: str) -> str:
    """Return range, unit and default of a key or parameter of the given kind."""
    allowed = str(entry.metadata["limits"].range_text()).replace("one of , ", "one of ")
    values = allowed if kind in ("number", "text") else f"{kind}, {allowed}"
    values = values.strip(", ") or kind
    return values if entry.default is dataclasses.MISSING else values + _default_text(entry.default)


def _sections_in(hint: Any) -> type | None:
    """Return the section that a type contains (alone, optional or in a list), or None."""
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return hint
    return next(filter(None, map(_sections_in, typing.get_args(hint))), None)


def _type_text(hint: Any) -> str:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _type_text(next(each for each in inner if each is not type(None)))
    if dataclasses.is_dataclass(hint):
        return "section"
    if origin is tuple:
        kind = _type_text(inner[0])
        plural = kind.replace("list", "lists", 1) if kind.startswith("list") else f"{kind}s"
        return f"list of {'' if inner[-1] is Ellipsis else f'{len(inner)} '}{plural}"
    if origin is Mapping:
        return "mapping of names to numbers"
    names = {float: "number", int: "whole number", bool: "true or false"}
    return names.get(hint, "text")


def _default_text(value: Any) -> str:
    empty = value in (None, "", ()) or dataclasses.is_dataclass(value)
    return "; optional" if empty else f"; default {_value_text(value)}"


def _value_text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value_text, value))}]"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _escaped(words: str) -> str:
    return words.replace("|", "\\|")


def _columns_of(kind: type) -> Iterator[str]:
    for each, columns in declared(kind):
        if dataclasses.is_dataclass(each.default_factory):
            yield from _columns_of(typing.cast(type, each.default_factory))
        else:
            headers = ", ".join(f"`{column.header}`" for column in columns.columns)
            yield f"- {headers}: {columns.meaning}\n"


def contracts_page() -> str:
    """Return the page on the duties of the nodes, generated from their checks, and on their
    state machines."""
    parts = [_CONTRACTS]
    for part, title in _PARTS.items():
        parts.append(f"\n## `{part.NODE}`: {title}\n\n| duty | text |\n| --- | --- |\n")
        parts += [f"| {duty.number} | {_escaped(duty.text)} |\n" for duty in part.DUTIES]
    parts.append(_STATE_MACHINES)
    for title, (text, rules, initial) in _MACHINES.items():
        parts.append(f"\n### {title}\n\n{text}\n\n{_state_machine(rules, initial)}")
    return "".join(parts)


def _state_machine(rules: _Rules, initial: Enum) -> str:
    """Return the transitions that most states have in common as a list, and the others as a
    diagram."""
    states: set[Enum] = set(type(initial))
    starts: dict[tuple[Any, Any], set[Any]] = {}
    for (state, event), targets in rules.items():
        for target in targets:
            starts.setdefault((event, target), set()).add(state)
    common = {each for each, begins in starts.items() if 2 * len(begins) > len(states)}
    lines: dict[str, list[str]] = {}
    for event, target in sorted(common, key=lambda each: (each[0].value, each[1].value)):
        others = sorted(state.value for state in states - starts[event, target])
        begin = f"every state except {', '.join(others)}" if others else "every state"
        lines.setdefault(begin, []).append(f"{event.value} → {target.value}")
    rest = {
        (state, event): frozenset(each for each in targets if (event, each) not in common)
        for (state, event), targets in rules.items()
    }
    shared = "".join(f"- From {begin}: {'; '.join(lines[begin])}\n" for begin in sorted(lines))
    return f"{shared}\n```mermaid\n{diagram(rest, initial)}\n```\n"


def runs_page() -> str:
    """Return the page on run folders, in which the columns of the tables are generated."""
    tables = {
        TRIALS: METHOD | TRIAL_COLUMNS,
        SCENES: SCENE_COLUMNS,
        SWEEP: COLUMNS,
        RUNS: RUN_COLUMNS,
    }
    rows = {
        name: [f"- `{column}`: {meaning}\n" for column, meaning in columns.items()]
        for name, columns in tables.items()
    }
    rows["taps.csv"] = list(_columns_of(TapRow))

    return _filled(DOCS / "runs.md", rows)


def nodes_page() -> str:
    """Return the page on the nodes, in which their parameters are generated. Needs ROS."""
    from tapping_cell.nodes import MODULES

    rows = {
        node: list(_parameter_rows(importlib.import_module(module).Parameters))
        for node, module in MODULES.items()
    }
    first, *others = rows.values()
    shared = [row for row in first if all(row in other for other in others)]
    own = {node: [row for row in lines if row not in shared] for node, lines in rows.items()}
    return _filled(NODES, {"every_node": shared} | own)


def _parameter_rows(kind: type) -> Iterator[str]:
    hints = typing.get_type_hints(kind)
    for each in dataclasses.fields(kind):
        values = _values(each, _type_text(hints[each.name]))
        yield f"- `{each.name}` ({values}): {each.metadata['limits'].description}\n"


def _filled(page: Path, parts: Mapping[str, list[str]]) -> str:
    """Return the text of a page with its generated parts."""

    def part(block: re.Match[str]) -> str:
        name, end = block.groups()
        return "".join([name, end, "\n", *parts[name], "\n"])

    return _BLOCK.sub(part, page.read_text(encoding="utf-8"))


NODES = DOCS / "nodes.md"
PAGES: dict[Path, Callable[[], str]] = {
    DOCS / "commands.md": commands_page,
    DOCS / "configuration.md": configuration_page,
    DOCS / "error_codes.md": error_codes_page,
    DOCS / "contracts.md": contracts_page,
    DOCS / "runs.md": runs_page,
    DOCS.parent / "tapping_cell" / "cli" / "options.json": options_file,
}


if __name__ == "__main__":
    for file, text in (PAGES | {NODES: nodes_page}).items():
        file.write_text(text(), encoding="utf-8")
