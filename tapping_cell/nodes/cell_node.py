"""What every node of the cell shares: life cycle with autostart, stop, diagnostics, shut-down.

Meanings of the life cycle: unconfigured = nothing is open; inactive = files read, port open, state
readable, nothing moves; active = may move.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle import LifecycleState as Previous
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes import parameters, security
from tapping_cell.nodes.cell_identity import key_of
from tapping_cell.nodes.memory import keep_memory


class NodeParameters(Protocol):
    """What the parameter class of every node has."""

    @property
    def autostart(self) -> bool:
        """Whether the node configures and activates itself."""


Parameters = TypeVar("Parameters", bound=NodeParameters)

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""For state that somebody who joins late must know."""
COMMAND = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE
)
"""For commands: all arrive, and none is delivered to somebody who was not there."""


PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILES = {True: "fastdds_profile.xml", False: "fastdds_messages.xml"}
"""The middleware's profile for what carries pictures, and for what does not."""


class NotReady(RuntimeError):
    """The node cannot be configured or activated yet; the sentence says why. Tried again.

    ``expected``: every healthy start comes by here, so that it is no warning.
    """

    def __init__(self, sentence: str, expected: bool = False) -> None:
        super().__init__(sentence)
        self.expected = expected


class CellNode(LifecycleNode, Generic[Parameters]):
    """A life-cycle node with parameters from one dataclass, which has a field ``autostart``.

    A subclass creates its publishers and subscriptions in its constructor, so that the graph shows
    them at once, and overrides :meth:`configure`, :meth:`activate`, :meth:`deactivate`,
    :meth:`cleanup`, :meth:`stop_now` and :meth:`health`.
    """

    actor = False
    """True for a node that moves something: its ``stopped`` tells of a latched stop."""
    carries_pictures = True
    """False for a node that sends and takes no pictures: see :func:`choose_transport`."""
    changeable: tuple[str, ...] = ()
    """Parameters that may be set at run time; :meth:`change` takes them in."""

    def __init__(self, name: str, parameter_class: type[Parameters]) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        parameters.declare(self, parameter_class, self.changeable)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._parameter_class = parameter_class
        self.settings = parameters.read(self, parameter_class)
        self.active = False
        """True while the node may act."""
        self.configured = False
        """True from configured on (inactive or active)."""
        self.stop_profile = LATCHED
        self.fatal = ""
        self._last_complaint = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Two subscriptions, because one with transient local durability misses volatile publishers
        # and a volatile one misses a stop that was published before this node came up.
        for profile in (LATCHED, COMMAND):
            self.create_subscription(Bool, "emergency_stop", self.hear_stop, profile)
        self.create_timer(1.0, self._publish_diagnostics)
        self._autostart = self.create_timer(0.05, self._start) if self.settings.autostart else None

    # What a subclass overrides

    def configure(self) -> None:
        """Read files, open ports. Raises NotReady or ConfigurationError."""

    def activate(self) -> None:
        """Begin to act. Raises NotReady."""

    def deactivate(self) -> None:
        """Cease to act."""

    def cleanup(self) -> None:
        """Close what configure opened; called at every end, also after a failure."""

    def stop_now(self) -> None:
        """Stop everything that moves, at once; called from the executor's thread."""

    def change(self, name: str, value: object) -> None:
        """Take in a parameter that was set at run time. Raises ValueError with a sentence."""

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Level, sentence and values for /diagnostics."""
        return DiagnosticStatus.OK, "ok", {}

    def port_path(self, port: str) -> Path:
        """Where a port is: ``~`` is the home folder, ``{namespace}`` that of the node, ``{cell}`` a
        name of this namespace in this ROS domain."""
        port = port.replace("{namespace}", self.get_namespace().strip("/"))
        return Path(port.replace("{cell}", key_of(self))).expanduser()

    # Life cycle

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched here."""
        return False

    def on_configure(self, state: Previous) -> TransitionCallbackReturn:
        """Life cycle: configure."""
        try:
            self.settings = parameters.read(self, self._parameter_class)
            self.configure()
        except ConfigurationError as error:
            self.fatal = str(error)
            self.get_logger().error(str(error))
            self.cleanup()
            return TransitionCallbackReturn.FAILURE
        except NotReady as error:
            self._complain(str(error), error.expected)
            self.cleanup()
            return TransitionCallbackReturn.FAILURE
        self.configured = True
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: Previous) -> TransitionCallbackReturn:
        """Life cycle: activate."""
        self.active = True
        try:
            self.activate()
        except NotReady as error:
            self.active = False
            self._complain(str(error), error.expected)
            return TransitionCallbackReturn.FAILURE
        self._last_complaint = ""
        return super().on_activate(state)

    def on_deactivate(self, state: Previous) -> TransitionCallbackReturn:
        """Life cycle: deactivate."""
        self.active = False
        self.deactivate()
        return super().on_deactivate(state)

    def on_cleanup(self, state: Previous) -> TransitionCallbackReturn:
        """Life cycle: clean up."""
        self.configured = False
        self.cleanup()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Previous) -> TransitionCallbackReturn:
        """Life cycle: shut down."""
        self.active = self.configured = False
        self.cleanup()
        return TransitionCallbackReturn.SUCCESS

    def _start(self) -> None:
        """Bring the node up by itself; a node that is not ready is tried again every second."""
        timer = self._autostart
        assert timer is not None
        timer.timer_period_ns = 1_000_000_000
        if not self.configured:
            self.trigger_configure()
        if self.fatal:
            raise ConfigurationError(self.fatal)
        if self.configured and not self.active:
            self.trigger_activate()
        if self.active:
            self.get_logger().info("active")
            timer.cancel()

    def _complain(self, sentence: str, expected: bool = False) -> None:
        """Say why the node is not ready, once for each reason."""
        if sentence != self._last_complaint and expected:
            self.get_logger().info(sentence)
        elif sentence != self._last_complaint:
            self.get_logger().warning(sentence)
        self._last_complaint = sentence

    # Emergency stop

    def hear_stop(self, message: Bool) -> None:
        """Hear a level of ``emergency_stop``."""
        if message.data:
            self.stop_now()

    # Parameters at run time

    def _on_set_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in changed:
                if parameter.name in self.changeable:
                    self.change(parameter.name, parameter.value)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # Diagnostics

    def _publish_diagnostics(self) -> None:
        level, sentence, values = self.health()
        if not self.configured:
            level, sentence = DiagnosticStatus.WARN, self._last_complaint or "not configured"
        elif self.stopped:
            level, sentence = DiagnosticStatus.ERROR, "emergency stop latched"
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message=sentence,
            hardware_id=str(values.pop("hardware_id", "")),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def choose_transport(pictures: bool) -> None:
    """Choose the middleware's profile, unless somebody else's stands in the environment.

    Without a shared-memory segment of several frames nearly every picture is lost; but the files of
    shared memory outlive a process that is killed, and its successor meets them again. So only what
    carries pictures uses it. The middleware reads the variable when the first node is made.
    """
    chosen = os.environ.get(PROFILE_VARIABLE, "")
    if not chosen or Path(chosen).name in PROFILES.values():
        os.environ[PROFILE_VARIABLE] = str(shared_folder() / PROFILES[pictures])


def run(make_node: Callable[[], CellNode[Any]], arguments: Sequence[str] | None = None) -> int:
    """Run one node until Ctrl-C, a termination signal or a fatal error; returns the exit status."""
    pictures = getattr(make_node, "carries_pictures", True)
    choose_transport(pictures)
    # The middleware's own default is the local network: a goal of another machine must not move
    # this arm.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if pictures:
        keep_memory()
    node: CellNode[Any] | None = None
    executor: SingleThreadedExecutor | None = None
    try:
        rclpy.init(
            args=list(arguments) if arguments is not None else None,
            signal_handler_options=SignalHandlerOptions.ALL,
        )
        executor = SingleThreadedExecutor()
        node = make_node()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except (RuntimeError, SystemError) as error:
        if refused := security.explain(error):
            print(f"error: {refused}", file=sys.stderr)
            return 1
        # A signal that arrives in mid-call leaves the call without its context, or, where the
        # middleware was just warning, with an exception that it does not expect.
        if rclpy.ok():
            raise
        return 0
    finally:
        # A launcher sends its own signal after the terminal's: one is enough to end in order.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        if node is not None:
            node.cleanup()
            assert executor is not None
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()
    return 0
