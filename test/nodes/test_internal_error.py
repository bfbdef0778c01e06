"""A device is stopped after an internal error, even if the state machine cannot handle it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from tapping_cell.logic.effects import Effect, Job, StopWire
from tapping_cell.nodes.logic_host import LogicHost


class Broken:
    """State machine with a defect in each handler."""

    tick_period = 0.1

    def __init__(self, handles_defects: bool) -> None:
        self._handles_defects = handles_defects

    def on_job(self, *_: Any) -> Sequence[Effect]:
        raise ZeroDivisionError("defect")

    def on_request(self, *_: Any) -> Sequence[Effect]:
        raise ZeroDivisionError("defect")

    def on_defect(self, *_: Any) -> Sequence[Effect]:
        if not self._handles_defects:
            raise KeyError("second defect")
        return (StopWire(),)


def wait_for_the_end_of_its_worker(host: LogicHost[Any]) -> None:
    worker = host._worker
    assert worker is not None
    worker._thread.join(60.0)
    assert isinstance(worker.error, KeyError)


@pytest.fixture
def node() -> Any:
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0))
    return Mock(role="scara_arm", get_clock=lambda: clock)


def test_the_device_is_stopped_if_the_state_machine_handles_the_error(
    node: Any, tmp_path: Path
) -> None:
    host = LogicHost[Any](node, Broken(True), tmp_path)
    host.driver = Mock()
    host.request("~/home", None, Mock())
    host.driver.stop.assert_called_once_with()


def test_the_device_is_stopped_before_the_node_ends_if_the_state_machine_cannot(
    node: Any, tmp_path: Path
) -> None:
    host = LogicHost[Any](node, Broken(False), tmp_path)
    host.driver = Mock()
    with pytest.raises(KeyError, match="second defect"):
        host.request("~/home", None, Mock())
    host.driver.stop.assert_called_once_with()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_node_ends_if_its_worker_cannot_handle_an_error(node: Any, tmp_path: Path) -> None:
    """Otherwise, jobs would be queued but never run."""
    host = LogicHost[Any](node, Broken(False), tmp_path)
    driver = Mock()
    host.start(driver)
    host._run(Job(1, "read", lambda _: None))
    wait_for_the_end_of_its_worker(host)
    driver.reset_mock()
    with pytest.raises(KeyError, match="second defect"):
        host._tick()
    driver.stop.assert_called_once_with()


def test_a_node_without_an_open_port_ends_with_the_second_error(node: Any, tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="second defect"):
        LogicHost[Any](node, Broken(False), tmp_path).request("~/home", None, Mock())
