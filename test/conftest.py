"""Every test process talks to itself alone: a ROS domain of its own, this machine only."""

import os
from pathlib import Path

from hypothesis import settings

from tapping_cell.cli.graph import own_domain

# How long an example takes says more of what else the machine does than of the code.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

# A domain that the caller's shell has may be that of a real cell, so it does not count here. Each
# process takes its own (the workers of pytest-xdist too) and holds it until it ends.
os.environ.pop("ROS_DOMAIN_ID", None)
_DOMAIN = own_domain()
os.environ["ROS_DOMAIN_ID"] = str(_DOMAIN.number)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_STATIC_PEERS", None)
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(__file__).resolve().parent.parent / "config" / "fastdds_profile.xml"
)
