"""Command line with one module per verb. A module is imported only when its verb is called.

A verb's module has ``add_arguments(parser)`` and ``run(arguments) -> int`` (the exit code). The
module's docstring is the verb's help.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import select
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tapping_cell import __version__
from tapping_cell.nodes import security
from tapping_cell.report.recorded import NO_BAGS

Execute = Callable[[argparse.Namespace], int]

VERBS = {
    "demo": "run one goal in the simulated cell, from start to finish",
    "up": "start the nodes, simulated or on hardware, and keep them running",
    "commission": "set up a new cell step by step, up to its first goal",
    "goal": "send a goal, of one object or several, to a running graph",
    "status": "show the state of a running cell and what it is waiting for",
    "home": "home the arm of a running cell",
    "jog": "move the arm of a running cell step by step, in set-up mode",
    "stop": "stop a running cell immediately",
    "clear": "clear the stop and the faults of a running cell",
    "evaluate": "evaluate a planning method in many simulated trials",
    "paper": "repeat the experiments of the paper and compare the numbers",
    "single-tap": "measure an object with an experiment of single taps",
    "object": "create object files from images, and fit them to taps",
    "sensitivity": "compute how errors of the striker's pose change a tap's result",
    "locate": "measure the object's pose in image files",
    "calibrate": "calibrate camera, table, arm or tappers; print sheets",
    "report": "rewrite the reports of runs, compare runs, and write videos",
    "check-config": "check configuration files, and the settings of arm and tapper",
    "deploy": "make a cell start with this computer, as a service of systemd",
    "update": "make a deployed cell run this version, or take that back",
    "undeploy": "remove what deploy wrote",
    "backup": "archive the configuration and calibrations of a deployed cell",
    "restore": "restore an archive into a deployed cell",
    "bundle": "write a zip file for a support request, without secrets",
    "conformance": "check whether a node of your own fulfils its duties in the cell",
    "urdf": "write the URDF of the arm or the fixed tappers, for RViz",
    "completion": "print shell code that completes verbs and options",
}

GROUPS = {
    "try the cell": ["demo", "up"],
    "operate a cell": ["goal", "status", "home", "stop", "clear", "report"],
    "set up a cell": ["commission", "jog", "calibrate", "check-config", "urdf"],
    "describe an object": ["object", "single-tap", "locate"],
    "keep a cell running": ["deploy", "update", "undeploy", "backup", "restore", "bundle"],
    "plan and evaluate": ["evaluate", "sensitivity", "paper"],
    "develop": ["conformance", "completion"],
}
"""Verbs by what they are for, in the order in which help lists them."""
RENAMED = "this verb has a new name: python -m tapping_cell {}"
MOVED = {
    "bench": "the benchmarks are no longer part of the package; in the source tree, run  python -m "
    "benchmarks",
    "faults": "the cell under faults is tested by the laboratory, which is not installed; in the "
    "source tree, run  python -m lab faults  (whole cell), or  python -m lab drivers",
    "arrange": RENAMED.format("goal --layout FILE, or goal --preset NAME"),
    "doctor": RENAMED.format("check-config FILE --devices"),
    "fit": RENAMED.format("object fit"),
    "learn-object": RENAMED.format("object learn"),
    "new-object": RENAMED.format("object new"),
    "watch": RENAMED.format("status --watch"),
}
"""Error messages for verbs that were removed, by verb. Each message names the replacement."""

SET_UP = (
    "set this shell up first, with  . ./env.sh  in the source folder, or"
    "  source install/setup.bash  in a workspace"
)
OLDEST_PYTHON = (3, 10)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb. Return the exit code (see docs/commands.md)."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    if "_ARGCOMPLETE" in os.environ:
        complete(os.environ.get("COMP_LINE", ""))
    if sys.version_info < OLDEST_PYTHON:
        version = ".".join(map(str, sys.version_info[:3]))
        return _not_set_up(f"{sys.executable} is Python {version}; the cell needs 3.10 or later")
    try:
        parser, execute = _parser_of(argv)
        try:
            status = int(execute(parser.parse_args(argv[1:])))
        finally:
            sys.stdout.flush()
    except ImportError as error:
        if (error.name or "").split(".")[0] == "tapping_cell":
            raise
        if error.name == "rosbags":
            print(f"error: {NO_BAGS}", file=sys.stderr)
            return 2
        return _not_set_up(f"{sys.executable} cannot import '{error.name}' ({error})")
    except RuntimeError as error:
        # Catch the base class of rclpy's errors, because rclpy is imported only by the verbs that
        # need it.
        refused = security.explain(error)
        if refused is None:
            raise
        print(f"error: {refused}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:
        if not _reader_has_gone():
            raise
        # Python flushes stdout once more at exit. Redirect stdout to /dev/null, so that this flush
        # does not fail too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    return status


def _not_set_up(why: str) -> int:
    print(f"error: {why}: {SET_UP}", file=sys.stderr)
    return 2


def _parser_of(argv: list[str]) -> tuple[argparse.ArgumentParser, Execute]:
    """Return the parser and the run function of the verb. The verb is the first argument in
    ``argv``. If there is no such verb, print an error and exit."""
    from tapping_cell.cli.errors import Parser, suggestion

    verb = argv[0] if argv else ""
    if verb in VERBS:
        refuse_typo(argv)
        return verb_parser(verb)
    parser = Parser(
        prog="python -m tapping_cell",
        description="A robot cell that positions flat objects by tapping them.",
        usage="%(prog)s VERB ...",
        epilog="\n".join(_help_of(title, names) for title, names in GROUPS.items())
        + "\nVERB --help shows the options of a verb, and an example.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"tapping_cell {__version__}")
    if verb in ("-h", "--help", "--version"):
        parser.parse_args([verb])
    if verb in MOVED:
        parser.error(MOVED[verb])
    if not verb:
        parser.error(f"no verb was given; choose from {', '.join(VERBS)}")
    parser.error(f"there is no verb '{verb}'{suggestion(verb, VERBS)}")


def _help_of(title: str, names: Sequence[str]) -> str:
    return f"{title}:\n" + "".join(f"  {name:<12} {VERBS[name]}\n" for name in names)


def refuse_typo(argv: Sequence[str]) -> None:
    """Exit with an error for an unknown option, choice or sub-verb.

    The verb's own parser does the same, but loading the modules of a verb takes seconds.
    ``make reference`` writes the options of all verbs to ``options.json``.
    """
    from tapping_cell.cli.errors import Parser, unknown_option, wrong_choice

    verbs = json.loads((Path(__file__).parent / "options.json").read_text(encoding="utf-8"))
    name = argv[0]
    inner = [verb.split()[1] for verb in verbs if verb.startswith(f"{name} ")]
    parser = Parser(prog=f"python -m tapping_cell {name}")
    if inner and len(argv) > 1 and not argv[1].startswith("-"):
        if argv[1] not in inner:
            parser.error(wrong_choice("WHAT", argv[1], inner))
        name = f"{name} {argv[1]}"
        parser.prog = f"python -m tapping_cell {name}"
    known = verbs[name]
    for word, following in zip(argv[1:], [*argv[2:], ""], strict=False):
        if word == "--":
            return
        option, equals, value = word.partition("=")
        if option not in known and word.startswith("--") and " " not in word:
            parser.error(unknown_option(word, option, known))
        choices = known.get(option)
        value = value if equals else following
        if choices and value and value not in choices and not value.startswith("-"):
            parser.error(wrong_choice(option, value, choices))


def _reader_has_gone() -> bool:
    """Return whether the output pipe was closed by its reader, as `head` does after its last
    line."""
    output = select.poll()
    output.register(sys.stdout.fileno(), select.POLLERR)
    return bool(output.poll(0))


def verb_parser(verb: str) -> tuple[argparse.ArgumentParser, Execute]:
    """Return the parser of a verb and its run function."""
    from tapping_cell.cli.errors import Parser

    module = importlib.import_module(f"tapping_cell.cli.{verb.replace('-', '_')}")
    parser = Parser(
        prog=f"python -m tapping_cell {verb}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    return parser, module.run


def complete(line: str) -> None:
    """Print the shell completions of ``line``. Only the module of the verb in ``line`` is
    imported."""
    import argcomplete

    parser = argparse.ArgumentParser(prog="cell")
    verbs = parser.add_subparsers(metavar="VERB")
    for name, text in VERBS.items():
        own = verbs.add_parser(name, help=text)
        if name in line.split():
            importlib.import_module(f"tapping_cell.cli.{name.replace('-', '_')}").add_arguments(own)
    argcomplete.autocomplete(parser)
