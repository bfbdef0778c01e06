"""The paper's disk, a striker, a table, and solved policies stored in a folder of the test run."""

from __future__ import annotations

import os

import pytest

from tapping_cell.mechanics import Disk, Impact, Sliding, Striker, Tap
from tapping_cell.planning import (
    CameraNoise,
    FreeSpace,
    Gains,
    PlannerSettings,
    StrikeSpace,
    Workspace,
)
from tapping_cell.planning.gains import NAMES


@pytest.fixture(scope="session", autouse=True)
def own_folders(tmp_path_factory):
    kept = {name: os.environ.get(name) for name in ("XDG_CACHE_HOME", "XDG_STATE_HOME")}
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
    # The workers of pytest-xdist share the solved policies in the common parent of their folders.
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    os.environ["XDG_CACHE_HOME"] = str(base / "plans")
    yield
    for name, value in kept.items():
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value


@pytest.fixture(scope="session")
def tap():
    disk = Disk(radius=0.048, mass=0.2455, height=0.012)
    striker = Striker(mass=0.1, tip_radius=0.0054)
    return Tap(
        sliding=Sliding(disk, friction=0.17, torque_factor=3.64, gravity=9.81),
        impact=Impact(disk, striker, restitution=0.86, friction=0.20),
    )


@pytest.fixture(scope="session")
def settings(tap):
    return PlannerSettings.for_tap(tap, CameraNoise())


@pytest.fixture(scope="session")
def space(tap):
    return StrikeSpace(tap, Workspace())


@pytest.fixture(scope="session")
def free(space):
    return FreeSpace(space)


def known_gains(**values):
    """Return gains (learnt corrections of the model) that are known exactly, as after many taps.
    They are those of an object that behaves as its file says, except for ``values``."""
    numbers = {"distance": 1.0, "rotation": 1.0, **values}
    kept = {name: numbers.get(name, 0.0) for name in NAMES}
    gains = Gains.from_numbers({**kept, **{f"{name}_deviation": 1e-9 for name in NAMES}})
    for belief in (gains.distance, gains.rotation, gains.direction):
        belief.mean[:] = belief.mean[0]
        belief.covariance[:] = belief.covariance[0]
    return gains


@pytest.fixture(scope="session")
def known():
    return known_gains
