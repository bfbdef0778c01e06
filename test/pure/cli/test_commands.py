"""The page of commands agrees with the code, the example of each verb parses, and completion
works."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import reference_pages

from benchmarks.__main__ import make_parser
from tapping_cell.cli import VERBS, verb_parser


@pytest.mark.parametrize("verb", VERBS)
def test_every_example_in_a_verbs_help_parses(verb: str) -> None:
    parser, _ = verb_parser(verb)
    lines = reference_pages.examples(parser)
    assert lines, f"the help of {verb} has no example"
    for line in lines:
        words = shlex.split(line.rstrip("\\").split(" > ")[0], comments=True)[3:]
        assert words[0] == verb, line
        assert line.count("python -m") == 1, f"examples merged into one line: {line}"
        if not line.endswith("\\"):
            parser.parse_args(words[1:])


ROOT = Path(__file__).resolve().parents[3]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_in_the_documents_parses(page: Path) -> None:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    for line in re.findall(r"^ +python -m tapping_cell (\w.+)$", text, re.MULTILINE):
        words = shlex.split(re.split(r" [>|] ", line)[0], comments=True)
        # A word in capital letters is a placeholder for a number or a file.
        verb_parser(words[0])[0].parse_args(["1" if word.isupper() else word for word in words[1:]])
    for line in re.findall(r"python -m benchmarks( --[^`\n]+)", text):
        make_parser().parse_args(shlex.split(line, comments=True))


TYPOS = """
import contextlib, io, json, sys
from tapping_cell.cli import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main(words)
    print(said.getvalue().strip().replace(chr(10), " "))
print(sorted({"numpy", "cv2", "scipy", "rclpy", "matplotlib", "yaml"} & set(sys.modules)))
"""


def test_a_typo_is_refused_with_a_suggestion_before_a_verb_is_loaded() -> None:
    known = json.loads(reference_pages.options_file())
    lines, expected = [], []
    for name, options in known.items():
        for option, choices in options.items():
            if not option.startswith("--"):
                continue
            lines += [[*name.split(), f"{option}x"], [*name.split(), f"{option}x=1"]]
            expected += [f"there is no argument {option}x", f"did you mean '{option}'"]
            abbreviated = option[: max(3, len(option) - 2)]
            if abbreviated not in options:
                lines.append([*name.split(), abbreviated, "1"])
                expected.append(f"there is no argument {abbreviated}")
            if choices:
                lines.append([*name.split(), option, f"{choices[0]}x"])
                expected.append(f"{option} cannot be '{choices[0]}x'")
    lines.append(["calibrate", "camra"])
    expected.append("did you mean 'camera'")
    ended = subprocess.run(
        [sys.executable, "-c", TYPOS, json.dumps(lines)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    *said, loaded = ended.stdout.splitlines()
    assert len(said) == len(expected) > 300
    for words, text, sentence in zip(lines, expected, said, strict=True):
        assert text in sentence, words
    assert loaded == "[]"


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_has_a_description(verb: str) -> None:
    parsers = [verb_parser(verb)[0]]
    while parsers:
        parser = parsers.pop()
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
            else:
                assert action.help, f"{parser.prog} {action.option_strings or action.dest}"


def completions(line: str) -> set[str]:
    """Return the completions that a shell would offer after a line."""
    read, write = os.pipe()
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SHELL": "bash",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "COMP_TYPE": "9",
        "_ARGCOMPLETE_STDOUT_FILENAME": f"/dev/fd/{write}",
    }
    with os.fdopen(read) as stream:
        command = [sys.executable, "-m", "tapping_cell"]
        try:
            subprocess.run(command, env=environment, pass_fds=(write,), timeout=60, check=True)
        finally:
            os.close(write)
        return {word.strip() for word in stream.read().split("\n") if word.strip()}


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("cell che", {"check-config"}),
        ("cell check-config --k", {"--kind"}),
        ("cell check-config --kind tr", {"truth"}),
        ("cell completion --shell ", {"bash", "zsh", "fish"}),
    ],
)
def test_the_tab_key_completes_commands(line: str, offered: set[str]) -> None:
    assert completions(line) == offered


def test_a_shell_loads_the_completion_code_and_completes(tmp_path: Path) -> None:
    script = tmp_path / "try.sh"
    script.write_text(
        f'eval "$({shlex.quote(sys.executable)} -m tapping_cell completion)"\n'
        "type cell | head -1; complete -p cell\n"
    )
    ended = subprocess.run(
        ["bash", str(script)], capture_output=True, text=True, timeout=60, check=True
    )
    assert "cell is a function" in ended.stdout and "_python_argcomplete cell" in ended.stdout
