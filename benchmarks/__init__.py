"""Benchmarks: how fast and how accurate each room is, beside a peer measured in the same run.

They need the source tree and are not installed. ``test/support`` holds what they share with the
tests: random truths and simulated experiments.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "test" / "support"))
