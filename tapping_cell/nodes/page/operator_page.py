"""Operator's web page, which shows the cell, accepts goals and stops the cell.

The page is reachable only from this machine, unless the parameter `address` is set. If `address` is
set, the page requires a token. A separate process serves STOP and publishes it. While no page is
open, this node subscribes to little more than the planner's states.
"""

from __future__ import annotations

import contextlib
import math
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from sensor_msgs.msg import Image
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from tapping_cell_msgs.action import PositionObject, SingleTap
from tapping_cell_msgs.msg import ErrorCode, GoalReport, PlanState, StopState
from tapping_cell_msgs.srv import ConfirmTap

from tapping_cell import messages
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.schema import quantity, text
from tapping_cell.logic import enabling, jogging
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.cell_identity import key_of, state_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED, CellNode, NotReady, run
from tapping_cell.nodes.cell_parameters import ObjectParameters
from tapping_cell.nodes.conversions import position_goal, seconds
from tapping_cell.nodes.kept_content import KeptContent
from tapping_cell.nodes.message_conversion import to_ros
from tapping_cell.nodes.page import guard, server
from tapping_cell.nodes.page.arrangements import Arrangements
from tapping_cell.nodes.page.calls import answer_to, call_service, send_goal, shot_words
from tapping_cell.nodes.page.cell_view import CellView, error_pair, triple, with_code
from tapping_cell.nodes.page.goal_preview import GoalPreview
from tapping_cell.nodes.page.goal_queue import GoalQueue, NamedGoals, QueueFull
from tapping_cell.nodes.page.metrics import make_metrics
from tapping_cell.nodes.page.node_watch import ACTORS, ARM, NodeWatch
from tapping_cell.nodes.page.planner_parameters import PlannerParameters
from tapping_cell.nodes.page.requests import (
    Arrange,
    Command,
    Confirm,
    Drafts,
    ForgetGoal,
    Jog,
    KeepRun,
    Move,
    NameGoal,
    Place,
    Preset,
    QueueGoal,
    Request,
    RequestedGoal,
    SendGoal,
    SetAsk,
    SetPlanner,
    Turn,
    Unqueue,
)
from tapping_cell.nodes.page.runs import Runs
from tapping_cell.nodes.page.stop_link import StopLink
from tapping_cell.nodes.private_names import PrivateNames
from tapping_cell.planning import planner_names
from tapping_cell.vision.images import ImageRefused

STATE_PERIOD_S = 0.2
ANSWER_S = 5.0
"""Timeout for the planner's response to a goal, after which the queue counts the goal as lost."""
LONGEST_PATH = 4096
STOP_NOT_SENT = (
    "the stop was NOT sent, because the page's stop process is still starting: press again, or use "
    "the wired emergency stop"
)
STOP_NOT_RELEASED = (
    "the page's own stop cannot be released yet, because the page's stop process is still "
    "starting; try again"
)
LATEST = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)


@dataclass(frozen=True, slots=True)
class Parameters(ObjectParameters):
    """Parameters of operator_page."""

    address: str = text(
        "address on which the page is served; 0.0.0.0: the whole network, and the page requires a "
        "token",
        default="localhost",
    )
    port: int = quantity("TCP port of the page; 0 for any free port", "", 0, 65535, default=8010)
    stop_port: int = quantity(
        "TCP port of the page's STOP; 0 for any free port", "", 0, 65535, default=9010
    )
    token: str = text(
        "token that a browser must present; if empty, the node generates one once, provided that "
        "`address` makes the page reachable from the network",
        default="",
    )
    host_names: str = text(
        "additional host names under which browsers may open the page, separated by commas",
        default="",
    )
    runs: str = text(
        "folder of the recorded runs; must have the same value as the parameter folder of "
        "run_recorder",
        default="runs",
    )
    picture_rate: float = quantity("maximum rate of images", "Hz", 0.1, 60.0, default=10.0)
    picture_quality: int = quantity("JPEG quality of the images", "", 10, 100, default=80)


class OperatorPage(CellNode[Parameters]):
    """See the module's docstring. Implements :class:`server.Backend`."""

    def __init__(self) -> None:
        super().__init__("operator_page", Parameters)
        self._cell: Cell | None = None
        self._server: server.PageServer | None = None
        self.urls: list[str] = []
        self._view = CellView()
        self._watched: list[Subscription] = []
        self._watch: NodeWatch | None = None
        self._timer: Timer | None = None
        self._pages = 0
        self._picture_at = -np.inf
        self._stop: StopLink | None = None
        self.runs = Runs(Path(self.settings.runs))
        self.metrics = make_metrics(self)
        self._arrangements = Arrangements(self, self._view.note)
        self._preview = GoalPreview(self, self._arrangements)
        self._action = ActionClient(self, PositionObject, "position_object")
        self._single_tap = ActionClient(self, SingleTap, "single_tap")
        self._private = PrivateNames(self)
        # The clients exist from the start, because the discovery of a server takes time.
        self._private.client("tap_planner", "cancel")
        self._private.client(ARM, "home")
        self._private.client(ARM, "jog")
        self._private.client("sim_world", "press_clear_button")
        for actor in ACTORS:
            self._private.client(actor, "clear_fault")
            process = partial(self._view.on_stop, actor)
            self._private.subscribe(StopState, actor, "stop_state", process, LATCHED)
        self._enabling = self.create_publisher(Bool, enabling.TOPIC, COMMAND)
        self._confirm_client = self.create_client(ConfirmTap, "confirm_tap")
        self._planner = PlannerParameters(self)
        self._queue = GoalQueue()
        self._named_file = KeptContent(state_folder(key_of(self)) / "named_goals.json")
        self._named = NamedGoals(self._named_file.recall())
        self._answer_due = -math.inf
        """Monotonic time until which the planner may still respond to the last goal."""
        self._last_run = ""
        self._clearing: list[server.Answer] = []
        self._commands: dict[str, Callable[[str, server.Answer], None]] = {
            "clear": self._clear,
            "cancel": self._cancel,
            "home": self._home,
            "park": self._park,
            "fire_at_nothing": self._fire_at_nothing,
            "press_button": self._press_button,
            "run_queue": self._run_queue,
            "hold_queue": self._hold_queue,
        }
        self.create_subscription(PlanState, "plan_state", self._on_plan, LATCHED)
        self.create_subscription(GoalReport, "goal_report", self._on_report, LATCHED)
        self.create_subscription(String, "last_run", self._on_last_run, LATCHED)
        self.create_timer(STATE_PERIOD_S, self._advance_queue)

    # Life cycle

    def configure(self) -> None:
        """Read the cell file, and create the check for goals that the planner would refuse."""
        cell = self.settings.load_cell()
        self._arrangements.use_cell(cell)
        self._view.names = self._arrangements.names
        self._cell = cell

    def activate(self) -> None:
        """Open the ports and log the address of the page."""
        address = self.settings.address
        token = self.settings.token
        if not token and not guard.is_loopback(address):
            # Without a disk, the token is that of this start.
            with contextlib.suppress(OSError):
                token = guard.kept_token(state_folder(key_of(self)) / "page_token")
        rules = guard.Guard.make(address, self.settings.host_names.split(","), token)
        sockets = self._bind("port", self.settings.port)
        page_port = sockets[0].getsockname()[1]
        try:
            stop_sockets = self._bind("stop_port", self.settings.stop_port)
        except NotReady:
            for each in sockets:
                each.close()
            raise
        self._stop = StopLink(
            rules,
            stop_sockets,
            page_port,
            self.get_namespace(),
            self.resolve_topic_name("emergency_stop"),
            lambda held, who: self._do(self._note_stop, held, who),
        )
        self._preview.start()
        stop_port = stop_sockets[0].getsockname()[1]
        self._server = server.PageServer(rules, self, sockets, stop_port)
        self._server.start()
        self._list_runs()
        self.urls = guard.urls(address, page_port, rules.token)
        for url in self.urls:
            self.get_logger().info(f"operator page: {url}")

    def _bind(self, parameter: str, port: int) -> list[socket.socket]:
        """Listen on a port of the page. Raises NotReady."""
        try:
            return server.bind(self.settings.address, port)
        except OSError as error:
            raise NotReady(
                f"the page cannot be served at {self.settings.address}, port {port} "
                f"({error.strerror or error}); end the program that uses the port, or set "
                f"the parameters address and {parameter}"
            ) from error

    def deactivate(self) -> None:
        """Close the ports."""
        for each in (self._server, self._preview, self._stop):
            if each is not None:
                each.close()
        self._server = self._stop = None
        self._watch_cell(0)

    def cleanup(self) -> None:
        """Close the ports."""
        self.deactivate()

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report the address of the page, without its token, and the number of open pages."""
        places = ", ".join(url.partition("#")[0] for url in self.urls)
        values: dict[str, object] = {"url": places, "pages": self._pages}
        if self._server is None:
            return DiagnosticStatus.WARN, self._last_complaint or "the page is not served", values
        if self._stop is None or not self._stop.ready.is_set():
            return DiagnosticStatus.WARN, "the process that serves STOP is starting", values
        return DiagnosticStatus.OK, "ok", values

    def on_emergency_stop(self, message: Bool) -> None:
        """Process an emergency stop message, show it on the page and pause the queue."""
        super().on_emergency_stop(message)
        self._view.emergency_stop = message.data
        if message.data:
            self._queue.hold("The queue is paused: the cell was stopped.")

    def _on_plan(self, message: PlanState) -> None:
        """Pause the queue if the planner has lost its goal: it reports the end of every goal."""
        if self._view.loses_goal(message):
            self._queue.hold("The queue is paused: the planner was restarted during a goal.")
        self._view.on_plan(message)

    def _on_report(self, message: GoalReport) -> None:
        """Continue or pause the queue when a goal has ended, regardless of its client."""
        self._view.on_report(message)
        if self.metrics is not None:
            self.metrics.on_report(message)
        sentence = with_code(message.error_msg, message.error_code)
        self._queue.ended(message.error_code == ErrorCode.NONE, sentence)

    def _advance_queue(self) -> None:
        """Send the next goal if the queue is running."""
        if not self._queue.running or not self._action.server_is_ready():
            return
        busy = self._view.busy or time.monotonic() < self._answer_due
        goal = self._queue.next(busy, self._view.blocked)
        if goal is not None:
            self._send_goal(goal, "queue", lambda _: None)

    def _on_last_run(self, message: String) -> None:
        """Update the list of runs. The received path is only displayed; nothing is read from it."""
        self._last_run = message.data[:LONGEST_PATH]
        self._list_runs()

    def _list_runs(self) -> None:
        if self._server is not None:
            self._server.show_runs(self.runs.rows())

    # While a page is open

    def on_pages(self, count: int) -> None:
        """Monitor the cell while at least one page is open. Called in the server's thread."""
        self._do(self._watch_cell, count)

    def _watch_cell(self, count: int) -> None:
        self._pages = count
        if count and not self._watched:
            self._subscribe()
        elif not count and self._watched:
            self._unsubscribe()

    def _subscribe(self) -> None:
        subscribe = self.create_subscription
        self._watched = [
            *(subscribe(*topic, LATCHED) for topic in self._view.device_topics()),
            subscribe(Image, "camera/image_annotated", self._on_picture, LATEST),
            *self._preview.subscribe(),
            *self._arrangements.subscribe(),
        ]
        self._watch = NodeWatch(self)
        self._watch.check()
        self._timer = self.create_timer(STATE_PERIOD_S, self._show)

    def _unsubscribe(self) -> None:
        assert self._watch is not None and self._timer is not None
        self.destroy_timer(self._timer)
        self._watch.close()
        for subscription in self._watched:
            self.destroy_subscription(subscription)
        self._watched.clear()
        self._watch = self._timer = None
        for each in (self._preview, self._view, self._arrangements, self._planner):
            each.forget()

    def _on_picture(self, message: Image) -> None:
        page = self._server
        now = self.get_clock().now().nanoseconds * 1e-9
        due = abs(now - self._picture_at) >= 0.9 / self.settings.picture_rate
        if page is None or not due or not page.wants_picture:
            return
        try:
            jpeg = images.to_jpeg(message, self.settings.picture_quality)
        except ImageRefused as error:
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        self._picture_at = now
        stamp = seconds(message.header.stamp)
        page.show_picture(jpeg, stamp, self.get_clock().now().nanoseconds * 1e-9 - stamp)

    def _show(self) -> None:
        if self._server is None or self._watch is None:
            return
        self._view.held_by_page = self._stop is not None and self._stop.held
        self._view.simulated = self._watch.runs("sim_world")
        self._watch.has_arm = self._view.has_arm
        self._planner.follow(self._watch.name_of("tap_planner"))
        self._planner.refresh()
        state = self._view.state()
        state["planner"] = self._planning_method()
        state["nodes"] = self._watch.rows()
        state["placeable"] = self._preview.is_possible
        state["arrangement"] = self._arrangements.state(self._preview.at)
        drafts = self._arrangements.drafts
        state["drafts"] = drafts and [[name, *triple(pose)] for name, pose in drafts.items()]
        state["runs_hint"] = self._runs_hint()
        state["planned_drawing"] = self._preview.planned(
            self._view.planned, self._view.planned_object
        )
        state["queue"] = {
            "rows": [
                [number, *triple(goal.pose), goal.object] for number, goal in self._queue.rows()
            ],
            "running": self._queue.running,
            "held": self._queue.held,
        }
        state["named"] = [[name, *triple(pose)] for name, pose in self._named.rows()]
        self._server.show(state)

    def _planning_method(self) -> str | None:
        """Return the planning method of the next goal; None if it is unknown."""
        assert self._cell is not None
        method = self._planner.method
        return self._cell.file.goal.planner if method == "" else method

    def _runs_hint(self) -> str:
        """Return the reason why the list of runs may be incomplete, or an empty text."""
        if self._last_run and Path(self._last_run).parent != self.runs.folder:
            return (
                f"The last run was recorded to {self._last_run}; the page serves only runs in "
                f"{self.runs.folder}. Set the page's parameter 'runs' to the recorder's folder."
            )
        if self._watch is not None and not self._watch.runs("run_recorder"):
            return "Runs are not recorded: run_recorder is not running."
        return ""

    # Requests of pages: the server calls greet and on_request

    def greet(self) -> dict[str, object]:
        """Return the constant information on the cell that a page needs."""
        assert self._cell is not None
        return {
            "cell": self._cell.file.name,
            "namespace": self.get_namespace(),
            "object": self._cell.object.name,
            "objects": self._arrangements.names,
            "planners": planner_names(),
            "planner": self._cell.file.goal.planner,
            "tolerance": error_pair(*self._cell.tolerance),
        }

    def on_request(self, page: object, request: Request, who: str, answer: server.Answer) -> None:
        """Process a page's request. Called in the server's thread."""
        if isinstance(request, (Move, Turn, Place)):
            self._preview.ask(page, request, answer)
        elif request == Command("stop"):
            # Sent from this thread, because the executor may be busy.
            sent = self._stop is not None and self._stop.stop(who)
            text = "stop sent to all devices and the planner" if sent else STOP_NOT_SENT
            answer(answer_to("stop", sent, text))
        else:
            self._do(self._serve, request, who, answer)

    def _serve(self, request: Request, who: str, answer: server.Answer) -> None:
        """Process a request in the executor's thread."""
        match request:
            case SendGoal():
                self._send_goal(request, who, answer)
            case Arrange():
                self._arrangements.send(request, who, answer)
            case Drafts(goals):
                self._arrangements.drafts = dict(goals)
            case Preset():
                self._arrangements.preset(request, answer)
            case Confirm():
                self._confirm(request, who, answer)
            case SetAsk(ask):
                text = f"'Ask before every tap' is {'on' if ask else 'off'}"
                self._set_parameter("ask", ask, text, who, answer)
            case SetPlanner(planner):
                text = f"planning method {planner} from the next goal on"
                self._set_parameter("planner", planner, text, who, answer)
            case KeepRun():
                self._keep_run(request, answer)
            case QueueGoal() | Unqueue() | NameGoal() | ForgetGoal():
                self._change_lists(request, answer)
            case Jog(axis, step):
                self._jog(jogging.request(axis, step), answer)
            case Command("enable" | "disable" as name):
                # The node relays each heartbeat of a held key. If the next heartbeat is missing,
                # the key counts as released.
                self._enabling.publish(Bool(data=name == "enable"))
            case Command(name):
                self._commands[name](who, answer)

    def _note_stop(self, held: bool, who: str) -> None:
        if held and who:
            self._view.note_halt(f"STOP pressed on the page ({who})", pressed=True)
        if not held:
            answers, self._clearing = self._clearing, []
            for answer in answers:
                self._clear_actors(answer)

    def _do(self, function: Callable[..., None], *arguments: object) -> None:
        """Call a function in the executor's thread, from any other thread."""
        if self.executor is not None:
            self.executor.create_task(function, *arguments)

    def _confirm(self, request: Confirm, who: str, answer: server.Answer) -> None:
        def on_reply(response: ConfirmTap.Response) -> None:
            text = "tap confirmed" if request.confirm else "tap skipped; another tap is planned"
            sentence = with_code(response.error_msg, response.error_code)
            answer(answer_to("confirm", response.accepted, text if response.accepted else sentence))
            if response.accepted:
                self._view.note(f"{text} (answered on the page, {who})")

        question = ConfirmTap.Request(tap_id=request.tap_id, confirm=request.confirm)
        client = self._confirm_client
        call_service(client, question, "confirm", "the planner", answer, on_reply)

    def _set_parameter(
        self, name: str, value: bool | str, text: str, who: str, answer: server.Answer
    ) -> None:
        """Change a run-time parameter of the planner."""

        def note() -> None:
            self._view.note(f"{text}: set on the page ({who})")

        self._planner.set(name, value, text, answer, note)

    def _change_lists(
        self, request: QueueGoal | Unqueue | NameGoal | ForgetGoal, answer: server.Answer
    ) -> None:
        """Change the queue or the named goals."""
        try:
            match request:
                case QueueGoal(pose):
                    assert self._cell is not None
                    check = self._arrangements.checks.get(request.object or self._cell.object.name)
                    if check is None:
                        raise QueueFull(f"the cell has no object '{request.object}'")
                    refusal = check.refusal(pose)
                    if refusal:
                        raise QueueFull(f"the planner would refuse this goal: {refusal}")
                    self._queue.add(request)
                    text = "goal added to the queue"
                case Unqueue(number):
                    found = self._queue.remove(number)
                    text = "goal removed" if found else "this goal is no longer in the queue"
                case NameGoal(name, pose):
                    self._named.keep(name, pose)
                    self._named_file.keep(self._named.as_content())
                    text = f"goal saved as '{name}'"
                case ForgetGoal(name):
                    found = self._named.forget(name)
                    self._named_file.keep(self._named.as_content())
                    text = f"'{name}' removed" if found else "there is no goal of this name"
        except (QueueFull, OSError) as error:
            answer(answer_to("queue", False, str(error)))
            return
        answer(answer_to("queue", True, text))

    def _keep_run(self, request: KeepRun, answer: server.Answer) -> None:
        """Keep a run from deletion, or no longer."""
        try:
            found = self.runs.keep(request.run, request.keep)
        except OSError as error:
            text = f"the run cannot be marked: {error.strerror}"
            answer(answer_to("keep_run", False, text))
            return
        kept = "is never deleted" if request.keep else "may be deleted"
        text = f"{request.run} {kept}" if found else f"there is no run '{request.run}'"
        answer(answer_to("keep_run", found, text))
        self._list_runs()

    def _run_queue(self, who: str, answer: server.Answer) -> None:
        self._queue.run()
        running = self._queue.running
        text = "the queue is running" if running else "no goal is waiting"
        answer(answer_to("queue", running, text))
        self._view.note(f"queue of goals started on the page ({who})")

    def _hold_queue(self, who: str, answer: server.Answer) -> None:
        self._queue.hold()
        answer(answer_to("queue", True, "the queue is paused; the current goal continues"))
        self._view.note(f"queue of goals paused on the page ({who})")

    def _send_goal(self, wanted: RequestedGoal, who: str, answer: server.Answer) -> None:
        now = self.get_clock().now().to_msg()
        goal = position_goal(wanted.pose, wanted.tolerance, now, wanted.object)

        def on_response() -> None:
            self._answer_due = time.monotonic() + STATE_PERIOD_S  # until plan_state contains it

        if send_goal(self._action, goal, "goal", "goal", answer, on_response):
            self._answer_due = time.monotonic() + ANSWER_S
            self._view.note_own_goal(wanted.pose, who, wanted.object)

    def _cancel(self, who: str, answer: server.Answer) -> None:
        def on_reply(response: Trigger.Response) -> None:
            withdraws = response.success and self._view.has_arm
            text = f"{response.message}{'; the arm withdraws' if withdraws else ''}"
            answer(answer_to("cancel", response.success, text))

        client, content = self._private.client("tap_planner", "cancel"), Trigger.Request()
        call_service(client, content, "cancel", "the planner", answer, on_reply)
        self._view.note(f"cancel pressed on the page ({who})")

    def _clear(self, who: str, answer: server.Answer) -> None:
        self._view.note(f"clearing of the stop and faults requested on the page ({who})")
        # The arm and the tapper refuse ``clear_fault`` while a publisher still holds a stop, so the
        # page's own stop is released first.
        if self._stop is None or not self._stop.held:
            self._clear_actors(answer)
        elif self._stop.release():
            self._clearing.append(answer)
        else:
            answer(answer_to("clear", False, STOP_NOT_RELEASED))

    def _clear_actors(self, answer: server.Answer) -> None:
        for name in ACTORS:
            if name == ARM and not self._view.has_arm:
                continue
            client = self._private.client(name, "clear_fault")
            call_service(client, Trigger.Request(), "clear", name, answer)

    def _home(self, who: str, answer: server.Answer) -> None:
        self._view.note(f"homing requested on the page ({who})")
        call_service(self._private.client(ARM, "home"), Trigger.Request(), "home", ARM, answer)

    def _jog(self, wanted: messages.Jog.Request, answer: server.Answer) -> None:
        def on_reply(response: messages.Jog.Response) -> None:
            sentence = with_code(response.error_msg, response.error_code)
            answer(answer_to("jog", response.accepted, "" if response.accepted else sentence))

        client, content = self._private.client(ARM, "jog"), to_ros(wanted)
        call_service(client, content, "jog", ARM, answer, on_reply)

    def _park(self, who: str, answer: server.Answer) -> None:
        self._view.note(f"parking of the arm requested on the page ({who})")
        self._jog(messages.Jog.Request(kind=messages.Jog.Request.PARK), answer)

    def _fire_at_nothing(self, who: str, answer: server.Answer) -> None:
        goal = SingleTap.Goal(at_nothing=True)
        if send_goal(self._single_tap, goal, "jog", "shot at nothing", answer, done=shot_words):
            self._view.note(f"shot at nothing requested on the page ({who})")

    def _press_button(self, _: str, answer: server.Answer) -> None:
        def on_reply(response: Trigger.Response) -> None:
            if response.success:
                self._view.recovery.press(time.monotonic())
            answer(answer_to("press_button", response.success, response.message))

        client = self._private.client("sim_world", "press_clear_button")
        name = "the clear button"
        call_service(client, Trigger.Request(), "press_button", name, answer, on_reply)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run(OperatorPage, arguments)


if __name__ == "__main__":
    sys.exit(main())
