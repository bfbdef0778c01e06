"""Calibrate camera, table, arm, tapper and fixed mounts; print calibration targets.

Each calibration reads images, a CSV file or run folders, and writes a file that the nodes read. The
file contains residuals, standard deviations, date and inputs. An existing file is replaced only
with --force. If the existing file has smaller residuals or a smaller uncertainty than the new
result, --accept-worse is required as well.

  python -m tapping_cell calibrate print --paper a4 --output sheet.pdf
  python -m tapping_cell calibrate camera photos/*.png --target chessboard --squares 9x7 \\
      --square-size 25 --output camera_info.yaml
  python -m tapping_cell calibrate table views/*.png --camera camera_info.yaml --size 40 \\
      --output table.yaml
  python -m tapping_cell calibrate arm arm.csv --cell config/cell.yaml --output cell.yaml
  python -m tapping_cell calibrate tapper taps.csv --cell config/cell.yaml --output cell.yaml
  python -m tapping_cell calibrate mounts runs/* --cell config/positioning_cell/cell.yaml \\
      --output cell.yaml
"""

from __future__ import annotations

import argparse

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.keep import KeptFile
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.subverbs import add_subverbs, subverb
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.report.run_folder import RunError

SUBVERBS = {
    "camera": "focal lengths and lens distortion, from photographs of a target",
    "table": "poses of the reference markers, from images or a printed sheet",
    "arm": "pose of the arm and zero offset of its elbow, from a record of poses",
    "mounts": "line of travel and speed of each fixed tapper, from single taps",
    "tapper": "speed of the striker at each energy, from the distances that objects travel",
    "photographs": "rendered photographs of a target or table, for testing the other sub-verbs",
    "undo": "take back the last calibration that replaced a file",
    "print": "true-to-scale sheets: targets, reference markers, object markers",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the sub-verbs."""
    add_subverbs(parser, "calibration", SUBVERBS)


def run(arguments: argparse.Namespace) -> int:
    """Run a sub-verb. Return 0 on success, 1 for unsuitable measurements, 2 for an invalid file or
    option."""
    try:
        return subverb("calibration", arguments.subject).run(arguments)
    except CalibrationRefused as error:
        print_error(str(error))
        return 1
    except (RecordError, RunError, KeptFile, ConfigurationError, OSError) as error:
        print_error(str(error))
        return 2
