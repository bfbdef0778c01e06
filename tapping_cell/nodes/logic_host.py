"""Run a state machine of ``tapping_cell.logic`` in a node: topics, services, jobs, timers.

Handlers run one at a time under one lock, in the executor's thread or in the worker's. Actions that
only the executor may perform (calls, new subscriptions) are passed to the executor.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.task import Future
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import Bool

from tapping_cell import messages
from tapping_cell.logic import effects as fx
from tapping_cell.logic import stops
from tapping_cell.logic.clock import Now
from tapping_cell.logic.host import (
    ONE_PUBLISHER,
    ONE_SERVER,
    Activated,
    Deactivated,
    LifecycleEvent,
    Logic,
    LostEvent,
    ShutDown,
    UnansweredRequest,
)
from tapping_cell.nodes import service_manager
from tapping_cell.nodes.authority import contest, impostor
from tapping_cell.nodes.cell_node import CellNode, Parameters
from tapping_cell.nodes.kept_content import KeptContent
from tapping_cell.nodes.message_conversion import Mirrored, from_ros, ros_class, to_ros
from tapping_cell.nodes.worker import Worker

LEVELS_WAIT_S = 0.5
"""Time within which the publishers of ``emergency_stop`` must resend their current value to a new
subscription."""


Machine = TypeVar("Machine", bound=Logic)


class LogicHost(Generic[Machine]):
    """Host of one state machine. ``driver`` is the device driver for the jobs of this machine; it
    is None until ``start``."""

    def __init__(self, node: CellNode[Any], logic: Machine, folder: Path) -> None:
        """``folder``: folder for the cell's files that must survive a crash."""
        self.driver: Any = None
        self._node = node
        self._logic = logic
        self._lock = threading.RLock()
        self._worker: Worker | None = None
        self._abandoned: set[int] = set()
        self._publishers: dict[str, Any] = {}
        self._observers: dict[str, Callable[[Any], None]] = {}
        self._codes: dict[str, int] = {}
        """Error code of the last message on each topic."""
        self._clients: dict[str, Any] = {}
        self._calls: dict[Any, tuple[Any, Any, float]] = {}
        self._tokens = itertools.count(1)
        self._requests: dict[int, Callable[[Any], None]] = {}
        self._feedback: dict[int, Callable[[Any], None]] = {}
        self._conflicts: dict[str, str] = {}
        """Sentence about each topic or service that several nodes provide."""
        self._stop_publishers: dict[bytes, TopicEndpointInfo] = {}
        self._later: deque[Callable[[], None]] = deque()
        self._wake = node.create_guard_condition(self._do_later)
        self.stop_file = KeptContent(folder / f"stop-{node.role}.json")
        self.goal_file = KeptContent(folder / "goal.json")
        node.create_timer(logic.tick_period, self._tick)

    # Wiring

    def publishes(self, kind: type[Mirrored], topic: str, profile: Any) -> None:
        """Create a publisher under the topic name that the state machine uses."""
        name = ros_class(kind.ROS_TYPE)
        self._publishers[topic] = self._node.create_publisher(name, topic, profile)

    def offers(self, kind: Any, topic: str, profile: Any) -> None:
        """Create a publisher for a ROS type that has no dataclass in :mod:`tapping_cell.messages`.
        A subclass publishes on it."""
        self._publishers[topic] = self._node.create_publisher(kind, topic, profile)

    def observes(self, topic: str, observe: Callable[[Any], None]) -> None:
        """Call ``observe`` for each message that the state machine publishes on ``topic``, with
        the dataclass of :mod:`tapping_cell.messages` rather than the ROS message."""
        self._observers[topic] = observe

    def subscribes(self, kind: type[Mirrored], topic: str, profile: Any) -> None:
        """Pass the messages of a topic to the state machine."""
        self._node.create_subscription(
            ros_class(kind.ROS_TYPE),
            topic,
            lambda message: self.receive(topic, from_ros(message, kind)),
            profile,
        )

    def serves(self, kind: Any, name: str) -> None:
        """Pass the requests of a service to the state machine."""

        def serve(request: Any, respond: Respond) -> None:
            mirror = from_ros(request, kind.Request)
            self.request(name, mirror, lambda response: respond(to_ros(response)))

        create_deferred_service(self._node, ros_class(kind.ROS_TYPE), name, serve)

    def calls(self, kind: Any, name: str) -> None:
        """Create a client for a service that the state machine calls."""
        self._clients[name] = self._node.create_client(ros_class(kind.ROS_TYPE), name)

    # Events

    def now(self) -> Now:
        """Return the current time."""
        return Now(time.monotonic(), self._node.get_clock().now().nanoseconds)

    def lifecycle(self, event: LifecycleEvent) -> None:
        """Notify the state machine of a life-cycle event of its node."""
        self._dispatch(lambda now: self._logic.on_lifecycle(event, now), event)

    def receive(self, topic: str, message: Any) -> None:
        """Pass a message to the state machine."""
        if topic in ONE_PUBLISHER:
            # The publisher of a message is known before its message arrives, so a message of a
            # second publisher is never handled as that of the first.
            self._note_conflicts({topic: contest(self._node, topic)})
        stop = message if topic == stops.TOPIC else None
        self._dispatch(lambda now: self._logic.on_message(topic, message, now), stop)
        if topic == stops.TOPIC and message.data:
            # Querying the graph takes time, so the stop is dispatched first.
            self._stop_publishers |= self._present_publishers()

    def request(
        self,
        service: str,
        request: Any,
        answer: Callable[[Any], None],
        feedback: Callable[[Any], None] | None = None,
    ) -> int:
        """Pass a request to the state machine; the state machine responds now or later. Return the
        request's token."""
        token = next(self._tokens)
        self._requests[token] = answer
        if feedback is not None:
            self._feedback[token] = feedback
        self._dispatch(
            lambda now: self._logic.on_request(service, request, token, now),
            UnansweredRequest(service, request, token),
        )
        return token

    def cancel(self, token: int) -> None:
        """Notify the state machine that a goal was cancelled."""
        self._dispatch(lambda now: self._logic.on_request("cancel", None, token, now))

    def ask(self, query: Callable[[Now], Any]) -> Any:
        """Evaluate a query on the state machine, never at the same time as one of its handlers. The
        query must have no side effects."""
        with self._lock:
            return query(self.now())

    def _tick(self) -> None:
        if self._worker is not None and self._worker.error is not None:
            self._stop_device()  # because the node ends
            raise self._worker.error
        for token, (future, client, until) in list(self._calls.items()):
            if time.monotonic() > until and self._calls.pop(token, None) is not None:
                client.remove_pending_request(future)
                self._answered(token, None)
        names = (*ONE_PUBLISHER, *ONE_SERVER)
        self._note_conflicts({name: contest(self._node, name) for name in names})
        self._dispatch(self._logic.on_tick)

    def _note_conflicts(self, found: Mapping[str, str]) -> None:
        """Notify the state machine of a change. ``found``: sentence about each of these topics and
        services that a wrong or a second node provides; empty for the others."""
        conflicts = {name: text for name, text in {**self._conflicts, **found}.items() if text}
        if conflicts != self._conflicts:
            self._conflicts = conflicts
            sentence = "; ".join(conflicts.values())
            self._dispatch(lambda now: self._logic.on_conflict(sentence, now))

    def _answered(self, token: Any, response: Any) -> None:
        self._dispatch(lambda now: self._logic.on_answer(token, response, now))

    def _dispatch(
        self,
        handler: Callable[[Now], Sequence[fx.Effect]],
        received: LostEvent | None = None,
    ) -> None:
        with self._lock:
            try:
                made = handler(self.now())
            except Exception as error:
                self._node.get_logger().error(traceback.format_exc())
                try:
                    made = self._logic.on_defect(error, self.now(), received)
                except Exception:
                    self._stop_device()  # because the node ends
                    raise
            # The stack also performs the effects after one that raises, so that no stop and no
            # stored file is lost; it then raises the error. The error may be KeyboardInterrupt.
            with contextlib.ExitStack() as stack:
                for effect in reversed(made):
                    stack.callback(self._perform, effect)

    def _stop_device(self) -> None:
        if self.driver is not None:
            self.driver.stop()

    # Effects

    def _perform(self, effect: fx.Effect) -> None:
        if isinstance(effect, (fx.Publish, fx.Answer, fx.Feedback)):
            try:
                self._send(effect)
            except RuntimeError:
                # At shutdown the state machine still ends its current action, but the context may
                # be invalid already. Nothing can be sent then.
                if self._node.context.ok():
                    raise
        elif isinstance(effect, fx.StopWire):
            self._stop_device()
        elif isinstance(effect, fx.RunJob):
            self._run(effect.job)
        elif isinstance(effect, fx.AbandonJob):
            self._abandoned.add(effect.job)
        elif isinstance(effect, fx.Call):
            self.later(lambda: self._call(effect))
        elif isinstance(effect, fx.AskStops):
            self.later(lambda: self._ask_stops(effect.token))
        elif isinstance(effect, fx.Log):
            log = self._node.get_logger()
            # Each level needs a logging call of its own, because rclpy raises an exception if the
            # same call is executed with another level.
            if effect.level is fx.LogLevel.ERROR:
                log.error(effect.sentence)
            elif effect.level is fx.LogLevel.WARNING:
                log.warning(effect.sentence)
            else:
                log.info(effect.sentence)
        else:
            self._keep(effect)

    def _send(self, effect: fx.Publish | fx.Answer | fx.Feedback) -> None:
        if isinstance(effect, fx.Publish):
            self._publish(effect)
        elif isinstance(effect, fx.Answer):
            self._feedback.pop(effect.token, None)
            self._requests.pop(effect.token)(effect.response)
        else:
            self._feedback[effect.token](effect.message)

    def _publish(self, effect: fx.Publish) -> None:
        code = getattr(effect.message, "error_code", 0)
        if code and code != self._codes.get(effect.topic):
            sentence = getattr(effect.message, "error_msg", "")
            service_manager.journal(self._node.get_name(), code, sentence)
        self._codes[effect.topic] = code
        self._publishers[effect.topic].publish(to_ros(effect.message))
        if effect.topic in self._observers:
            self._observers[effect.topic](effect.message)

    def _keep(self, effect: fx.KeepStop | fx.KeepGoal | fx.TouchGoal) -> None:
        try:
            if isinstance(effect, fx.TouchGoal):
                self.goal_file.touch()
            elif isinstance(effect, fx.KeepGoal):
                self.goal_file.keep(effect.content)
            else:
                if effect.content is None:
                    self._stop_publishers.clear()
                self.stop_file.keep(effect.content)
        except OSError as error:
            what = "stop" if isinstance(effect, fx.KeepStop) else "goal"
            if isinstance(effect, fx.TouchGoal):
                sentence = "the time of the stored goal could not be updated"
            elif effect.content is None:
                sentence = (
                    f"the stored {what} could not be deleted, so a restart of the node would "
                    "restore it"
                )
            else:
                sentence = f"the {what} could not be stored, so a restart of the node would lose it"
            self._node.get_logger().error(f"{sentence}: {error}")
            if isinstance(effect, fx.KeepGoal) and effect.content is not None:
                # A restart must not resume the goal with an old number of taps.
                self._keep(fx.KeepGoal(None))

    def later(self, action: Callable[[], None]) -> None:
        """Run an action in the executor's thread after its current callback."""
        self._later.append(action)
        self._wake.trigger()

    def _do_later(self) -> None:
        while self._later:
            self._later.popleft()()

    def _call(self, call: fx.Call) -> None:
        client = self._clients[call.service]
        if not client.service_is_ready() or self._is_contested(call.service):
            self._answered(call.token, None)
            return
        future = client.call_async(to_ros(call.request))
        self._calls[call.token] = (future, client, time.monotonic() + call.timeout)
        kind = getattr(messages, type(call.request).__qualname__.split(".")[0]).Response

        def done(answered: Future) -> None:
            if self._calls.pop(call.token, None):
                # The server may have been replaced since the request was sent.
                trusted = not self._is_contested(call.service)
                self._answered(call.token, from_ros(answered.result(), kind) if trusted else None)

        future.add_done_callback(done)

    def _is_contested(self, service: str) -> bool:
        """Return whether a wrong or a second node works in the cell or offers the service."""
        wrong = contest(self._node, service) or impostor(self._node, service)
        self._note_conflicts({service: wrong})
        return bool(self._conflicts)

    def _ask_stops(self, token: Any) -> None:
        """Subscribe again, so that every transient-local publisher of the stop topic resends its
        current value (True: stopped)."""
        levels: list[bool] = []

        def receive(message: Bool) -> None:
            levels.append(message.data)

        subscription = self._node.create_subscription(
            Bool, stops.TOPIC, receive, self._node.stop_profile
        )

        def settle() -> None:
            timer.cancel()
            self._node.destroy_timer(timer)
            self._node.destroy_subscription(subscription)
            present, stopped = self._present_publishers(), self._stop_publishers
            gone = [info for gid, info in stopped.items() if gid not in present]
            # The last message of a single publisher is its current value. If there are several
            # publishers, each must be transient local, so that it resends its own value.
            several = len(present.keys() | stopped.keys()) > 1
            silent = [info for info in present.values() if several and _is_volatile(info)]
            names = map(_node_names, (present.values(), gone, silent))
            self._answered(token, fx.StopLevels(any(levels), *names))

        timer = self._node.create_timer(LEVELS_WAIT_S, settle)

    def _present_publishers(self) -> dict[bytes, TopicEndpointInfo]:
        """Return the publishers of ``emergency_stop`` by endpoint identifier."""
        found = self._node.get_publishers_info_by_topic(stops.TOPIC)
        return {bytes(info.endpoint_gid): info for info in found}

    # Jobs

    def start(self, driver: Any) -> None:
        """Start the worker, whose jobs use this driver."""
        self.driver = driver
        self._worker = Worker(self._node.get_name())
        self._worker.start()

    def close(self) -> None:
        """Stop the worker after the current job."""
        if self._worker is not None:
            self._worker.close()
        self._worker = None
        self.driver = None

    def _run(self, job: fx.Job) -> None:
        if self._worker is not None:
            self._worker.submit(lambda: self._work(job))

    def _work(self, job: fx.Job) -> None:
        try:
            ended = fx.JobEnded(job.number, job.run(_Context(self, job.number)))
        except Exception as error:
            ended = fx.JobEnded(job.number, fault=error)
        self._abandoned.discard(job.number)
        self._dispatch(lambda now: self._logic.on_job(ended, now), ended)

    def abandoned(self, job: int) -> bool:
        """Return whether a job was abandoned."""
        return job in self._abandoned

    def progress(self, event: fx.JobProgress) -> None:
        """Pass the progress of a job to the state machine."""
        self._dispatch(lambda now: self._logic.on_job(event, now))


class LogicNode(CellNode[Parameters], Generic[Parameters]):
    """Node that hosts a state machine; the state machine makes all decisions. A subclass creates
    ``host`` in its constructor, and passes ``Configured`` to ``host`` when the node is
    configured."""

    carries_pictures = False
    host: LogicHost[Any]

    def activate(self) -> None:
        """Allow the state machine to act."""
        self.host.lifecycle(Activated())

    def deactivate(self) -> None:
        """Make the state machine end its current action."""
        self.host.lifecycle(Deactivated())

    def cleanup(self) -> None:
        """Deactivate the state machine, because an orderly shutdown also ends the machine's current
        action."""
        try:
            self.host.lifecycle(ShutDown())
        finally:
            self.host.close()

    def on_emergency_stop(self, message: Bool) -> None:
        """Pass a stop message to the state machine; the state machine stops immediately."""
        self.host.receive(stops.TOPIC, messages.Bool(data=message.data))


class _Context:
    """Interface of the host for a job."""

    def __init__(self, host: LogicHost[Any], number: int) -> None:
        self._host = host
        self._number = number
        self.driver = host.driver

    def now(self) -> Now:
        return self._host.now()

    def sleep(self, duration: float) -> None:
        time.sleep(duration)

    def abandoned(self) -> bool:
        return self._host.abandoned(self._number)

    def post(self, content: object) -> None:
        self._host.progress(fx.JobProgress(self._number, content))

    def ask(self, query: Callable[[Now], Any]) -> Any:
        return self._host.ask(query)


def _node_names(publishers: Iterable[TopicEndpointInfo]) -> tuple[str, ...]:
    names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in publishers}
    return tuple(sorted(names))


def _is_volatile(publisher: TopicEndpointInfo) -> bool:
    """Return whether a publisher is volatile: it does not resend its last value to a new
    subscription."""
    return publisher.qos_profile.durability is DurabilityPolicy.VOLATILE


Respond = Callable[[Any], None]


class _Sends(Protocol):
    """Service for which rclpy's executor calls ``send_response`` with the value that the callback
    has returned."""

    send_response: Callable[[Any, Any], None]


class _Later:
    """Placeholder that the callback returns until the response is available."""

    def __init__(self, send: Callable[[Any, Any], None]) -> None:
        self._send = send
        self._header: Any = None
        self._response: Any = None

    def respond(self, response: Any) -> None:
        self._response = response
        self._finish()

    def set_header(self, header: Any) -> None:
        self._header = header
        self._finish()

    def _finish(self) -> None:
        if self._header is not None and self._response is not None:
            self._send(self._response, self._header)


def create_deferred_service(
    node: Node, kind: Any, name: str, serve: Callable[[Any, Respond], None]
) -> None:
    """Create a service. ``serve`` receives each request together with a function that must be
    called once, immediately or later, with the response.

    rclpy has no such service: a coroutine that waits would block a single-threaded executor.
    """

    def callback(request: Any, _: Any) -> _Later:
        later = _Later(send)
        serve(request, later.respond)
        return later

    service = cast(_Sends, node.create_service(kind, name, callback))
    send = service.send_response
    # The executor passes what the callback has returned, and the header of the request.
    service.send_response = lambda later, header: later.set_header(header)
