"""Common base of the cell's nodes: life cycle with autostart, stop, diagnostics, shutdown.

In the life-cycle state "unconfigured", nothing is open. In the state "inactive", the node has read
its files and opened its port and can read its device, but moves nothing. In the state "active", the
node may move its device.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from copy import copy
from functools import wraps
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle import LifecycleState as Previous
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_msgs.msg import Bool

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes import frame_names, parameters, security
from tapping_cell.nodes.cell_identity import key_of
from tapping_cell.nodes.connection_check import ConnectionCheck
from tapping_cell.nodes.memory import keep_memory, release_memory
from tapping_cell.nodes.service_manager import ALIVE, notify


class NodeParameters(Protocol):
    """Parameters that every node has."""

    @property
    def autostart(self) -> bool:
        """Return whether the node configures and activates itself automatically."""

    @property
    def frame_prefix(self) -> str:
        """Return the prefix of the names of the cell's frames."""


Parameters = TypeVar("Parameters", bound=NodeParameters)

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""QoS of state topics: a subscriber that joins later also receives the last message."""
COMMAND = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE
)
"""QoS of commands: each command is delivered reliably to the present subscribers, but not to a
subscriber that joins later."""
BEST_EFFORT_COMMAND = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)
"""QoS of subscriptions to commands from best-effort publishers."""

SIMULATED_TIME = "use_sim_time"
CONNECTION_CHECK_S = 5.0
"""Period at which the topics are checked for endpoints that cannot connect."""
SIGNAL_S = 0.2
"""Maximum time for which a waiting node does not notice a signal, s."""
LAST_RESULTS_S = 1.0
"""Time for which a node that shuts down sends the results of its actions, s. A result is sent in
the third round of the executor, and each round handles all messages that have arrived."""
NO_CLOCK = (
    f"waits for a time on /clock, because {SIMULATED_TIME} is true; start what publishes it (a"
    f" simulator, or ros2 bag play --clock), or set {SIMULATED_TIME} to false"
)
CLOCK_STANDS_S = 2.0
"""Time without a change of /clock after which a node warns, s."""
ROLE = "role"
"""Key of a node's role in /diagnostics."""
FIXED_QUALITY = ("emergency_stop", "goal_pose", "joint_trajectory", "tap_command", "~/stop_state")
"""Commands and stops, whose quality of service no parameter overrides."""
PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILES = {True: "fastdds_profile.xml", False: "fastdds_messages.xml"}
"""Fast DDS profile for nodes that transport images (True) and for other nodes (False)."""


class NotReady(RuntimeError):
    """The node cannot be configured or activated yet, for the reason in the message. The transition
    is retried.

    ``expected``: the condition is part of every normal start, so it is not logged as a warning.
    """

    def __init__(self, sentence: str, expected: bool = False) -> None:
        super().__init__(sentence)
        self.expected = expected


class CellNode(LifecycleNode, Generic[Parameters]):
    """Life-cycle node with parameters from one dataclass with a field ``autostart``.

    A subclass creates its publishers and subscriptions in its constructor, so that they appear in
    the graph immediately. It overrides :meth:`configure`, :meth:`activate`, :meth:`deactivate`,
    :meth:`cleanup`, :meth:`stop_now` and :meth:`health`.
    """

    carries_pictures = True
    """False for a node that neither sends nor receives images: see :func:`choose_transport`."""
    changeable: tuple[str, ...] = ()
    """Parameters that may be set at run time. :meth:`check` checks all that are set at once, then
    :meth:`change` applies them in this order; only the first one may still be refused then."""

    def __init__(self, name: str, parameter_class: type[Parameters]) -> None:
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._qualities: set[str] = set()
        """Names of the parameters that override the quality of service of a topic."""
        self._frame_prefix = ""  # rclpy creates publishers before the parameters are known
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._parameter_class = parameter_class
        try:
            parameters.declare(self, parameter_class, self.changeable)
            self.settings = parameters.read(self, parameter_class)
            self._frame_prefix = self.settings.frame_prefix
        except ConfigurationError:
            # Otherwise the garbage collector destroys the node at any later time. If another node
            # of the process is just being discovered then, Fast DDS can wait forever. What a
            # subclass destroys does not exist yet.
            LifecycleNode.destroy_node(self)
            raise
        self._simulated_time = self.get_parameter(SIMULATED_TIME).value
        self._clock_seen = 0, time.monotonic()
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.role = name
        """Default name of the node. The default name does not change if ``__node:=`` renames the
        node."""
        self.active = False
        """True while the node may act."""
        self.configured = False
        """True while the node is inactive or active."""
        self.stop_profile = LATCHED
        self.fatal = ""
        self._last_complaint = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Several subscriptions are needed. A transient local subscription does not match volatile
        # publishers. A volatile subscription misses a stop that was published before this node
        # started. A reliable subscription does not match best-effort publishers.
        for profile in (LATCHED, COMMAND, BEST_EFFORT_COMMAND):
            self.create_subscription(Bool, "emergency_stop", self.on_emergency_stop, profile)
        self.create_timer(1.0, self._publish_diagnostics)
        self._connections = ConnectionCheck(self)
        self.create_timer(CONNECTION_CHECK_S, self._check_connections)
        self._autostart = self.create_timer(0.05, self._start) if self.settings.autostart else None

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """Create a publisher without event callbacks. :class:`ConnectionCheck` replaces them."""
        options.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        profile = self._overridable(topic, qos_profile, "publisher", options)
        made = super().create_publisher(msg_type, topic, profile, **options)
        if prefix := self._frame_prefix:
            publish = made.publish

            def publish_prefixed(message: Any) -> None:
                if not isinstance(message, bytes):
                    frame_names.add_prefix(message, prefix)
                publish(message)

            made.publish = publish_prefixed  # type: ignore[method-assign, assignment]
        return made

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., None],
        qos_profile: QoSProfile | int,
        **options: Any,
    ) -> Subscription:
        """Create a subscription without event callbacks. :class:`ConnectionCheck` replaces them."""
        events = SubscriptionEventCallbacks(use_default_callbacks=False)
        options.setdefault("event_callbacks", events)
        profile = self._overridable(topic, qos_profile, "subscription", options)
        process = callback
        prefix = self._frame_prefix
        if prefix and not topic.startswith("/") and not options.get("raw"):

            @wraps(callback)  # rclpy reads from the signature whether information is passed too
            def process(message: Any, *information: Any) -> None:
                frame_names.remove_table_prefix(message, prefix)
                callback(message, *information)

        return super().create_subscription(msg_type, topic, process, profile, **options)

    def _overridable(
        self, topic: str, profile: QoSProfile | int, entity: str, options: dict[str, Any]
    ) -> QoSProfile | int:
        """Let parameters of rclpy override the quality of service of a topic that carries states or
        images. Return the profile, a copy because rclpy changes it."""
        if topic.startswith("/") or topic in FIXED_QUALITY:
            return profile
        policies = QoSOverridingOptions.with_default_policies()
        options.setdefault("qos_overriding_options", policies)
        stem = f"{parameters.QOS_OVERRIDES}{self.resolve_topic_name(topic)}.{entity}."
        self._qualities.update(stem + policy.name.lower() for policy in policies.policy_kinds)
        return QoSProfile(depth=profile) if isinstance(profile, int) else copy(profile)

    def create_timer(self, *arguments: Any, **options: Any) -> Timer:
        """Create a timer on the steady clock. A timer on ROS time would not expire for an hour
        after the computer's clock is set back by an hour."""
        options.setdefault("clock", self._steady_clock)
        return super().create_timer(*arguments, **options)

    # Methods that a subclass overrides

    def configure(self) -> None:
        """Read files and open ports. Raises NotReady or ConfigurationError."""

    def activate(self) -> None:
        """Start acting. Raises NotReady."""

    def deactivate(self) -> None:
        """Stop acting."""

    def cleanup(self) -> None:
        """Close the resources that :meth:`configure` opened. Called at every shutdown, even after a
        failure."""

    def has_unsent_results(self) -> bool:
        """Return whether results of actions wait for the executor."""
        return False

    def stop_now(self) -> None:
        """Stop all motion immediately. Called from the executor's thread."""

    def check(self, name: str, value: object) -> None:
        """Check a parameter that is set at run time. Raises ValueError with a message."""

    def change(self, name: str, value: object) -> None:
        """Apply a parameter that was set at run time. Raises ValueError with a message."""

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Return the level, message and values for /diagnostics."""
        return DiagnosticStatus.OK, "ok", {}

    def port_path(self, port: str) -> Path:
        """Return the path of a port. ``~`` is replaced by the home folder, ``{namespace}`` by the
        node's namespace, and ``{cell}`` by the result of :func:`key_of`. The latter contains the
        ROS domain and the namespace."""
        port = port.replace("{namespace}", self.get_namespace().strip("/"))
        return Path(port.replace("{cell}", key_of(self))).expanduser()

    # Life cycle

    @property
    def stopped(self) -> bool:
        """Whether this node has a latched stop."""
        return False

    def on_configure(self, state: Previous) -> TransitionCallbackReturn:
        """Handle the life-cycle transition "configure"."""
        try:
            self.settings = parameters.read(self, self._parameter_class)
            if self._simulated_time and self.get_clock().now().nanoseconds == 0:
                raise NotReady(NO_CLOCK)
            self.configure()
            fixed = {self.resolve_topic_name(topic) for topic in FIXED_QUALITY}
            parameters.check_qualities(self, self._qualities, fixed)
        except (ConfigurationError, NotReady) as error:
            if isinstance(error, NotReady):
                self._complain(str(error), error.expected)
            else:
                self.fatal = str(error)
                self.get_logger().error(str(error))
            self.cleanup()
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self._give_up(error)
            return TransitionCallbackReturn.FAILURE
        self.configured = True
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: Previous) -> TransitionCallbackReturn:
        """Handle the life-cycle transition "activate"."""
        self.active = True
        try:
            self.activate()
        except NotReady as error:
            self.active = False
            self._complain(str(error), error.expected)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.active = False
            self._give_up(error)
            return TransitionCallbackReturn.FAILURE
        self._last_complaint = ""
        release_memory()
        return super().on_activate(state)

    def on_deactivate(self, state: Previous) -> TransitionCallbackReturn:
        """Handle the life-cycle transition "deactivate"."""
        self.active = False
        self.deactivate()
        return super().on_deactivate(state)

    def on_cleanup(self, state: Previous) -> TransitionCallbackReturn:
        """Handle the life-cycle transition "cleanup"."""
        self.configured = False
        self.cleanup()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Previous) -> TransitionCallbackReturn:
        """Handle the life-cycle transition "shutdown"."""
        self.active = self.configured = False
        self.cleanup()
        return TransitionCallbackReturn.SUCCESS

    def _give_up(self, error: Exception) -> None:
        """Report an unexpected exception of a transition, because rclpy reports none. Without
        ``autostart``, the transition may be triggered again."""
        self.get_logger().error(traceback.format_exc())
        self.fatal = f"internal error ({error!r}): report it with the log"
        self._last_complaint = self.fatal
        self.cleanup()

    def _start(self) -> None:
        """Configure and activate the node automatically, and retry every second while it is not
        ready."""
        timer = self._autostart
        assert timer is not None
        timer.timer_period_ns = 1_000_000_000
        if not self.configured:
            self.trigger_configure()
        if self.configured and not self.active:
            self.trigger_activate()
        if self.fatal:
            raise ConfigurationError(self.fatal)
        if self.active:
            self.get_logger().info("active")
            timer.cancel()

    def _complain(self, sentence: str, expected: bool = False) -> None:
        """Log the reason why the node is not ready, unless it is the reason that was logged
        last."""
        if sentence != self._last_complaint and expected:
            self.get_logger().info(sentence)
        elif sentence != self._last_complaint:
            self.get_logger().warning(sentence)
        self._last_complaint = sentence

    # Emergency stop

    def on_emergency_stop(self, message: Bool) -> None:
        """Process a message on ``emergency_stop``."""
        if message.data:
            self.stop_now()

    # Parameters at run time

    def _on_set_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in changed:
                if parameter.name == SIMULATED_TIME and parameter.value != self._simulated_time:
                    raise ValueError(
                        f"{SIMULATED_TIME} cannot change while the node runs, because the ages of"
                        " all messages would be wrong; restart the node with the new value"
                    )
                self.check(parameter.name, parameter.value)
            # Nothing must be applied if one of the values is refused.
            values = {parameter.name: parameter.value for parameter in changed}
            for name in self.changeable:
                if name in values:
                    self.change(name, values[name])
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # Diagnostics

    def _check_connections(self) -> None:
        for sentence in self._connections.new_mismatches():
            self.get_logger().warning(sentence)

    def _clock_defect(self) -> str:
        """Return that /clock stands still; otherwise an empty string. Log that it went back."""
        now, steady = self.get_clock().now().nanoseconds, time.monotonic()
        last, since = self._clock_seen
        if now != last:
            self._clock_seen = now, steady
        if now < last:
            self.get_logger().warning(
                f"/clock went back by {(last - now) / 1e9:.3f} s, for example because a bag began"
                " again; messages with later stamps are not used any more"
            )
        stood = steady - since if now == last else 0.0
        return "" if stood < CLOCK_STANDS_S else f"/clock has stood still for {stood:.0f} s"

    def _publish_diagnostics(self) -> None:
        notify(ALIVE)
        level, sentence, values = self.health()
        if self._simulated_time and (defect := self._clock_defect()):
            level, sentence = max(level, DiagnosticStatus.WARN), defect
        if not self.configured:
            level, sentence = DiagnosticStatus.WARN, self._last_complaint or "not configured"
        elif self.stopped:
            level, sentence = DiagnosticStatus.ERROR, "emergency stop latched"
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message=sentence,
            hardware_id=str(values.pop("hardware_id", "")),
            values=[
                KeyValue(key=ROLE, value=self.role),
                *(KeyValue(key=key, value=str(value)) for key, value in values.items()),
            ],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def choose_transport(pictures: bool) -> None:
    """Select the Fast DDS profile, unless the environment already names a custom profile.

    Images need a shared-memory segment that holds several frames: without it, nearly every image is
    lost. However, the shared-memory files of a killed process remain and disturb the process that
    replaces it. Therefore only nodes that transport images use shared memory. Fast DDS reads the
    environment variable when the first node is created.
    """
    chosen = os.environ.get(PROFILE_VARIABLE, "")
    if not chosen or Path(chosen).name in PROFILES.values():
        os.environ[PROFILE_VARIABLE] = str(shared_folder() / PROFILES[pictures])


def run(make_node: Callable[[], CellNode[Any]], arguments: Sequence[str] | None = None) -> int:
    """Run one node until Ctrl-C, a termination signal or a fatal error. Return the exit code."""
    pictures = getattr(make_node, "carries_pictures", True)
    choose_transport(pictures)
    # The default discovery range of ROS is the local network, but a goal from another machine must
    # not move the arm of this cell.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if pictures:
        keep_memory()
    node: CellNode[Any] | None = None
    executor: SingleThreadedExecutor | None = None
    signals: list[int] = []

    def interrupt(number: int, _: object) -> None:
        # After Ctrl-C, the terminal and the launcher both send a signal. The second one must not
        # interrupt the orderly shutdown.
        first = not signals
        signals.append(number)
        if first:
            raise KeyboardInterrupt

    try:
        # A handler of rclpy would invalidate the context at once, so that the node could neither
        # publish its last state nor switch off an output of a robot while it is cleaned up.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, interrupt)
        rclpy.init(
            args=list(arguments) if arguments is not None else None,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        executor = SingleThreadedExecutor()
        node = make_node()
        executor.add_node(node)
        while not signals:  # the exception may be lost if the handler runs during a call of C code
            executor.spin_once(timeout_sec=SIGNAL_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Exception as error:
        if refused := security.explain(error):
            print(f"error: {refused}", file=sys.stderr)
            return 1
        # A signal that arrives during a call of C code raises KeyboardInterrupt there, and the
        # called library reports it as an error of its own.
        if not signals:
            raise
        return 0
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            node.cleanup()
            assert executor is not None
            if node.active and node.has_unsent_results():
                # rclpy does not tell when it has sent a result.
                deadline = time.monotonic() + LAST_RESULTS_S
                while (left := deadline - time.monotonic()) > 0:
                    executor.spin_once(timeout_sec=left)
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
