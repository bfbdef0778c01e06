"""Take back the last calibration that replaced a file.

The last ten replaced contents of every calibrated file are kept, with the residual and date in
them. --list shows them and changes nothing. What is taken back is kept too, as NAME.TIME.undone in
the folder .history beside the file.

python -m tapping_cell calibrate undo cell.yaml --list
python -m tapping_cell calibrate undo cell.yaml
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tapping_cell.calibration.keep import earlier_files, undo, undone_files
from tapping_cell.cli.check_config import check
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.configuration.schema import ConfigurationError, read_yaml


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", type=Path, metavar="FILE", help="calibrated file")
    parser.add_argument("--list", action="store_true", help="list the kept contents only")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Run the sub-verb. Return the exit code."""
    path: Path = arguments.file.expanduser()
    contents = (path, *earlier_files(path), *undone_files(path))
    rows = [describe(one, path) for one in contents if one.exists()]
    if arguments.list:
        if arguments.json:
            print(json.dumps({"contents": rows}, indent=2))
        else:
            print(
                "\n".join(f"{row['content']}, by {row['owner']}: {row['records']}" for row in rows)
            )
        return ExitStatus.DONE
    restored = undo(path, _read)
    if arguments.json:
        print(json.dumps({"file": str(path), "restored": restored.name}))
    else:
        print(f"{path} has the content of {restored.name} again: {describe(path, path)['records']}")
    return ExitStatus.DONE


def describe(content: Path, path: Path) -> dict[str, str]:
    """Return what is known about a content: the owner of the file, and its calibration records."""
    try:
        owner = content.owner()
    except KeyError:
        owner = str(content.stat().st_uid)
    try:
        document = read_yaml(content)
    except ConfigurationError as error:
        document = {"": str(error)}
    records = "; ".join(
        f"{record['by']} of {record['made']}, {record['residual_of']} {record['residual']:g}"
        for record in _records(document)
    )
    when = content.name[len(path.name) + 1 :]
    state = f"taken back {when[:-7]}" if when.endswith(".undone") else f"replaced {when}"
    return {
        "content": state if when else "present",
        "owner": owner,
        "records": records or f"no calibration record, written by {owner}",
    }


def _records(document: Any) -> Iterator[dict[str, Any]]:
    """Return the calibration records in a document, in any section."""
    if isinstance(document, dict):
        found = document.get("calibration")
        if isinstance(found, dict) and {"by", "made", "residual", "residual_of"} <= set(found):
            yield found
        for key, value in document.items():
            if key != "calibration":
                yield from _records(value)
    elif isinstance(document, list):
        for value in document:
            yield from _records(value)


def _read(path: Path) -> None:
    errors = [sentence for found in check(path) for sentence in found.errors]
    if errors:
        raise ConfigurationError(f"the earlier content is not restored: {errors[0]}")
