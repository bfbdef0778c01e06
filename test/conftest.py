"""Every test process is isolated: it has its own ROS domain and communicates only on this
computer."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tapping_cell.cli.graph import own_domain

# The duration of an example depends mainly on the load of the machine, so it is not limited. A push
# tries a few examples of each property, a campaign many. A test with slow examples tries a fixed
# share of `settings.default.max_examples`.
for profile, examples in (("default", 15), ("campaign", 1000)):
    settings.register_profile(
        profile,
        max_examples=examples,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
    )
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "default")
settings.load_profile(PROFILE)

# ROS_DOMAIN_ID of the caller's shell may be that of a real cell, so it is ignored. Each process
# (also each worker of pytest-xdist) reserves a domain of its own until it ends.
os.environ.pop("ROS_DOMAIN_ID", None)
_DOMAIN = own_domain()
os.environ["ROS_DOMAIN_ID"] = str(_DOMAIN.number)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_STATIC_PEERS", None)
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(__file__).resolve().parent.parent / "config" / "fastdds_profile.xml"
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests that only a campaign runs."""
    if PROFILE != "campaign":
        for item in items:
            if item.get_closest_marker("campaign"):
                item.add_marker(pytest.mark.skip(reason="takes long: make campaign"))


@pytest.fixture
def own_signals() -> Iterator[None]:
    """Restore the signal handlers, because a verb or node that runs in this process replaces
    them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
