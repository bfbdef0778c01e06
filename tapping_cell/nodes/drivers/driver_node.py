"""What the nodes of the two serial devices share: a worker thread, a snapshot, stop and clear."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.nodes.cell_node import CellNode, NotReady, run
from tapping_cell.nodes.worker import Worker

CONNECT_PATIENCE_S = 1.0
"""First wait for a port, and for whoever is there to answer."""
LONGEST_PATIENCE_S = 6.0
"""Opening a port starts many boards anew, and some take seconds: each further try of a port that is
there but mute waits longer, up to this."""
URGENCY = 1
"""Priority among the processes of real-time scheduling: the lowest, above all ordinary ones."""
MUTE = (FaultReason.UNKNOWN_FIRMWARE, FaultReason.TIMEOUT, FaultReason.NEEDS_PERSON)


class DeviceDriver(Protocol):
    """What both drivers can do."""

    def connect(self, timeout: float) -> Any:
        """Open the line and identify who answers."""

    def stop(self) -> bool:
        """Stop on the wire, at once; from any thread."""

    def close(self) -> None:
        """Close the line."""


Parameters = TypeVar("Parameters")
Driver = TypeVar("Driver", bound=DeviceDriver)
Snapshot = TypeVar("Snapshot")


class DriverNode(CellNode[Parameters], Generic[Parameters, Driver, Snapshot]):
    """A node whose driver's blocking calls run in one worker thread.

    The worker writes a snapshot (a frozen dataclass with the fields ``state``, ``error_code`` and
    ``error_msg``), the executor reads and publishes it. A subclass gives ``stopped_state`` and
    ``code_of``, and overrides :meth:`idle`, :meth:`clear` and :meth:`give_up`.
    """

    actor = True
    carries_pictures = False
    stopped_state: int
    """The snapshot's state after a stop."""
    stopped_trouble: tuple[int, str]
    """Code and sentence after a stop."""
    fault_states: ClassVar[Mapping[FaultReason, int]]
    """The snapshot's state after a fault ..."""
    fault_state: int
    """... and after any other fault."""
    healthy_states: ClassVar[frozenset[int]]
    """States in which there is nothing to clear."""
    idle_period: float
    """Between two calls of :meth:`idle`, s."""
    told_at_once: tuple[str, ...] = ("state", "tap_id", "error_code")
    """Fields of the snapshot whose change is published without waiting for the timer."""

    def __init__(self, name: str, parameters: type[Parameters], unconnected: Snapshot) -> None:
        super().__init__(name, parameters)
        self.driver: Driver | None = None
        self.port = ""
        self.abandoned = threading.Event()
        """Set while what is under way must not go on."""
        self._unconnected = unconnected
        self._snapshot: Any = unconnected
        self._lock = threading.Lock()
        self._patience = CONNECT_PATIENCE_S
        self._worker: Worker | None = None
        # A guard condition brings a change from the worker's thread to the executor's.
        self._changed = self.create_guard_condition(self.publish_state)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_service(Trigger, "~/clear_fault", self._on_clear_fault)

    # What a subclass overrides

    def code_of(self, fault: HardwareFault) -> int:
        """The ErrorCode of a fault."""
        raise NotImplementedError

    def idle(self) -> None:
        """Between jobs, in the worker's thread."""

    def clear(self) -> None:
        """End a stop or a fault, in the worker's thread."""

    def give_up(self) -> None:
        """What a stop ends besides the driver's motion; in the executor's thread."""

    def publish_state(self) -> None:
        """Publish the snapshot, in the executor's thread."""

    # The driver and its worker

    def connect(self, driver: Driver, port: str) -> Any:
        """Connect, keep the driver and start the worker; returns what ``connect`` answers.

        ``port``: its path, for diagnostics.

        Raises:
            NotReady: the device is not there or not understood; tried again by the life cycle.
        """
        try:
            answer = self.reach(driver)
        except HardwareFault as fault:
            self.set(error_code=self.code_of(fault), error_msg=fault.sentence)
            raise NotReady(fault.sentence) from fault
        self.driver, self.port = driver, port
        if self.stopped:
            # A stop that was latched before there was a driver holds for it as well.
            self.stop_now()
        self._worker = Worker(self.get_name(), lambda: self._guarded(self.idle), self.idle_period)
        self._worker.start()
        return answer

    def reach(self, driver: Driver) -> Any:
        """``connect``, with a patience that grows while a port is there and mute."""
        try:
            answer = driver.connect(timeout=self._patience)
        except HardwareFault as fault:
            longer = min(2 * self._patience, LONGEST_PATIENCE_S)
            self._patience = longer if fault.reason in MUTE else CONNECT_PATIENCE_S
            raise
        self._patience = CONNECT_PATIENCE_S
        return answer

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job for the worker; nothing without one. Its HardwareFault becomes the state."""
        if self._worker is not None:
            self._worker.submit(lambda: self._guarded(job))

    def _guarded(self, job: Callable[[], None]) -> None:
        try:
            job()
        except HardwareFault as fault:
            self.fail(fault)
        except Exception as defect:
            self.set(
                state=self.fault_state,
                error_code=ErrorCode.INTERNAL,
                error_msg=f"a defect of this program ({defect!r}): please report it with the log,"
                " then start the node again",
            )
            raise

    def fail(self, fault: HardwareFault, **changes: object) -> None:
        """Say a fault once, in the log, and keep it in the state; ``changes`` come on top."""
        own_stop = fault.reason is FaultReason.STOPPED
        if own_stop and (self.stopped or fault.reason not in self.fault_states):
            # The fault that stopped the device was said before, and says more.
            self.set(**changes)
            return
        if self._snapshot.error_msg != fault.sentence:
            self.get_logger().error(fault.sentence)
        told: dict[str, object] = {
            "state": self.fault_states.get(fault.reason, self.fault_state),
            "error_code": self.code_of(fault),
            "error_msg": fault.sentence,
        }
        self.set(**{**told, **changes})

    def require(self) -> Driver:
        """The driver, where there surely is one."""
        assert self.driver is not None
        return self.driver

    @property
    def defect(self) -> BaseException | None:
        """What ended the worker, if anything did."""
        return self._worker.error if self._worker is not None else None

    def cleanup(self) -> None:
        """Close the port."""
        self.abandoned.set()
        if self._worker is not None:
            self._worker.close()
        if self.driver is not None:
            self.driver.close()
            with self._lock:
                self._snapshot = self._unconnected
        self._worker = self.driver = None

    # The snapshot

    @property
    def snapshot(self) -> Snapshot:
        """What was last known."""
        with self._lock:
            known: Snapshot = self._snapshot
        return known

    def set(self, **changes: object) -> None:
        """Change fields of the snapshot; a latched stop keeps its state and words."""
        with self._lock:
            if self._snapshot.state == self.stopped_state and self.stopped:
                for name in ("state", "error_code", "error_msg"):
                    changes.pop(name, None)
            before = self._snapshot
            self._snapshot = replace(before, **changes)
            news = any(getattr(before, n) != getattr(self._snapshot, n) for n in self.told_at_once)
        if news:
            self._changed.trigger()

    # Stop and clear

    def stop_now(self) -> None:
        """Stop on the wire, at once."""
        self.abandoned.set()
        if self.driver is not None:
            self.driver.stop()
        self.give_up()
        code, sentence = self.stopped_trouble
        self.set(state=self.stopped_state, error_code=code, error_msg=sentence)

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.stopped = True
        self.stop_now()
        return answer(response, True, "stopped; clear_fault ends the stop")

    def _on_clear_fault(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.driver is None:
            return answer(response, False, self._snapshot.error_msg)
        if self._snapshot.state in self.healthy_states and not self.stopped:
            return answer(response, True, "there is no fault to clear")
        self.stopped = False
        self.submit(self.clear)
        return answer(response, True, "clearing; the node's state tells the result")


def run_driver(
    make_node: Callable[[], CellNode[Any]], arguments: Sequence[str] | None = None
) -> int:
    """Run a driver's node; where the system allows it, ahead of ordinary processes.

    An emergency stop must not wait for a processor that others keep busy. Every thread that is
    made from here on inherits the scheduling. Who may not choose it runs as before.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(URGENCY))
    return run(make_node, arguments)


def answer(response: Trigger.Response, success: bool, sentence: str) -> Trigger.Response:
    """Fill the response of a Trigger service."""
    response.success, response.message = success, sentence
    return response
