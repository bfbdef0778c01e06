"""Benchmarks of the speed and accuracy of each package, compared with other software in the same
run.

The benchmarks need the source tree and are not installed. ``test/support`` contains the code shared
with the tests: random ground truth and simulated experiments.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "test" / "support"))
