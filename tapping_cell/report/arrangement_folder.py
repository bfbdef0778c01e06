"""Files of the run folder of an arrangement of several objects: ``arrangement.json`` and
``report.html``."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

from tapping_cell.durable_file import replace_text
from tapping_cell.report.arrangement_page import write_page
from tapping_cell.report.arrangement_reader import read_arranged_run
from tapping_cell.report.arrangement_run import (
    SUMMARY,
    ArrangementRun,
    read_arrangement,
    to_content,
)
from tapping_cell.report.run_folder import BAG, RunError


def write_arrangement_folder(
    folder: Path, page: bool = True, source: Path | None = None
) -> ArrangementRun:
    """Write the files of an arrangement from its bag, replacing existing files. A summary of a
    complete bag is not replaced by that of an incomplete one.

    ``page``: also write the report. ``source``: path of the bag; None means the bag in the folder.

    Raises:
        tapping_cell.report.bag.BagError: the bag is unreadable or contains no arrangement.
        OSError: the folder cannot be written.
    """
    bag = source or folder / BAG
    run, pictures = read_arranged_run(bag, folder.name)
    with contextlib.suppress(RunError):
        kept = read_arrangement(folder)
        if run.note and not kept.note and kept.began == run.began:
            run = replace(kept, note=f"{SUMMARY} is kept, because {run.note}")
            if page:
                write_page(run, folder, pictures)
            return run
    content = {
        **({"note": run.note} if run.note else {}),
        "reached": not run.error_code,
        "taps": len(run.taps),
        "error_code": run.error_code,
        "error_msg": run.error_msg,
        "contacts": run.contacts,
        "seconds": round(run.seconds, 1),
        "run": to_content(run),
    }
    replace_text(folder / SUMMARY, json.dumps(content, indent=2, allow_nan=False) + "\n")
    if page:
        write_page(run, folder, pictures)
    return run
