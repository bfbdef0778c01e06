"""Write the arm, or the fixed tappers, of a cell file as URDF for RViz, Foxglove and planners.

python -m tapping_cell urdf --cell my_cell.yaml > arm.urdf
"""

from __future__ import annotations

import argparse
import sys

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.hardware.fixed_urdf import mounted_tappers_urdf
from tapping_cell.hardware.urdf import urdf


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    argument_types.add_cell(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 on success, 2 for invalid input."""
    try:
        cell = load_cell(arguments.cell)
    except ConfigurationError as error:
        print_error(str(error))
        return 2
    if cell.file.arm is None:
        sys.stdout.write(mounted_tappers_urdf(cell.mounted_tappers()))
        return 0
    own = cell.arm.ros2_control
    if own is not None and own.chain is not None:
        print_error(f"the arm of this cell has its own URDF file; use {own.chain.urdf}")
        return 2
    sys.stdout.write(urdf(cell.arm.geometry()))
    return 0
