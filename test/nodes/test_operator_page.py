"""The operator's page over real DDS, with made-up messages, a real planner, and a WebSocket
client."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
import time
import urllib.request
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from harness import Bench, bench
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    StopState,
    TapperState,
    TapRecord,
)
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import (
    WebSocketClientConnection,
    WebSocketClosedError,
    websocket_connect,
)

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.pose_messages import camera_to_message
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.page.operator_page import OperatorPage
from tapping_cell.nodes.page.requests import RequestedGoal
from tapping_cell.nodes.page.server import MAX_PAGES, PICTURE_HEADER
from tapping_cell.nodes.planner.tap_planner import TapPlanner
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.se2 import Pose
from tapping_cell.vision import CameraPose, View

TIMEOUT_S = 60.0
PARAMETERS: dict[str, dict[str, object]] = {"operator_page": {"port": 0, "stop_port": 0}}


@dataclass
class Cell:
    """The node under test, and publishers that replace the rest of the cell."""

    bench: Bench
    page: OperatorPage
    publishers: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.bench.wait(lambda: self.page.urls, "the page is served")
        self.address = self.page.urls[0].removeprefix("http://").partition("/")[0]

    def publish(self, topic: str, message: Any, profile: Any = LATCHED) -> None:
        assert self.bench.probe is not None
        if topic not in self.publishers:
            self.publishers[topic] = self.bench.probe.create_publisher(
                type(message), topic, profile
            )
        self.publishers[topic].publish(message)

    def plant(self) -> None:
        """Publish the states of an arm, a tapper and an object without faults."""
        self.publish("arm_state", ArmState(state=ArmState.IDLE, homed=True, clear_of_camera=True))
        self.publish("tapper_state", TapperState(state=TapperState.SAFE, interlock_closed=True))
        seen = ObjectState(visible=True, at_rest=True, frames_fused=30)
        seen.pose.pose = to_message(Pose(0.01, -0.02, 0.5))
        self.publish("object_states", ObjectStates(objects=[seen]))
        self.publish("plan_state", PlanState(state=PlanState.IDLE))

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator[Browser]:
        """Connect a page with the right token."""
        asked = HTTPRequest(
            f"ws://{self.address}/live", headers={"Origin": f"http://{self.address}"}
        )
        browser = Browser(await websocket_connect(asked))
        await browser.send({"do": "hello"})
        try:
            yield browser
        finally:
            browser.connection.close()


@dataclass
class Browser:
    """The browser's end of the WebSocket."""

    connection: WebSocketClientConnection
    answers: list[Any] = field(default_factory=list)
    """Answers that were received before they were requested; their order is not guaranteed."""

    async def send(self, content: dict[str, object]) -> None:
        await self.connection.write_message(json.dumps(content))

    async def receive(self, wanted: Callable[[Any], bool]) -> Any:
        """Return the next message that ``wanted`` accepts. Text messages are returned as parsed
        JSON, images as bytes."""

        for content in self.answers:
            if wanted(content):
                self.answers.remove(content)
                return content

        async def search() -> Any:
            while True:
                message = await self.connection.read_message()
                assert message is not None, "the page was closed"
                content = json.loads(message) if isinstance(message, str) else message
                if wanted(content):
                    return content
                if isinstance(content, dict) and content["type"] == "answer":
                    self.answers.append(content)

        return await asyncio.wait_for(search(), TIMEOUT_S)

    async def state(self, wanted: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Return the next state for which the condition holds."""
        found: dict[str, Any] = await self.receive(
            lambda m: isinstance(m, dict) and m["type"] == "state" and bool(wanted(m))
        )
        return found

    async def answer(self, to: str) -> dict[str, Any]:
        """Return the next answer to a request."""
        found: dict[str, Any] = await self.receive(
            lambda m: isinstance(m, dict) and m["type"] == "answer" and m.get("to") == to
        )
        return found


def play(scenario: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await asyncio.wait_for(scenario(), 240.0)

    asyncio.run(run())


@pytest.fixture
def cell() -> Iterator[Cell]:
    made: list[OperatorPage] = []

    def make() -> list[Any]:
        made.append(OperatorPage())
        return list(made)

    with bench(make, PARAMETERS) as b:
        yield Cell(b, made[0])


def tap(number: int, measured: Pose) -> TapRecord:
    record = TapRecord(tap_id=100 + number, number=number, planner="optimal", dx=0.02, dy=-0.01)
    record.dtheta, record.striker_speed, record.outcome = 0.1, 0.8, TapperState.FIRED
    record.object_pose = to_message(Pose(0.0, 0.0, 0.0))
    record.predicted_pose = to_message(Pose(0.019, -0.01, 0.1))
    record.measured_pose.pose = to_message(measured)
    return record


def plan(state: int, goal: Pose, *, taps: int = 0, last: TapRecord | None = None) -> PlanState:
    message = PlanState(state=state, taps=taps, position_tolerance=0.001, angle_tolerance=0.0175)
    message.goal.header.frame_id = "table"
    message.goal.pose = to_message(goal)
    message.residual_distance = message.residual_rotation = math.nan
    message.last_tap = last or TapRecord()
    return message


def test_the_queue_is_paused_if_the_planner_was_restarted_during_a_goal(cell: Cell) -> None:
    goal = Pose(0.03, -0.01, 0.2)
    requested = RequestedGoal(goal)

    def restart(method: str) -> str:
        cell.publish("plan_state", plan(PlanState.IDLE, goal))
        cell.page._queue.add(requested)
        cell.page._queue.run()
        working = plan(PlanState.PLACING, goal)
        working.planner = method
        cell.publish("plan_state", working)
        cell.bench.wait(lambda: cell.page._view.busy, "the goal")
        cell.publish("plan_state", plan(PlanState.IDLE, goal))
        cell.bench.wait(lambda: not cell.page._view.busy, "the next planner")
        return cell.page._queue.held

    assert restart(PRESCRIBED) == ""  # a single tap ends like this
    assert "restarted during a goal" in restart("optimal")


def test_every_page_shows_the_taps_including_late_joiners(cell: Cell) -> None:
    goal = Pose(0.03, -0.01, 0.2)

    async def scenario() -> None:
        async with cell.open() as first:
            cell.plant()
            await first.state(lambda s: s["mode"] == "ready")
            cell.publish("plan_state", plan(PlanState.PLACING, goal))
            moving = await first.state(lambda s: s["mode"] == "moving")
            assert moving["sentence"] == "tap 1: placing the striker"
            assert moving["plan"]["goal"] == [30.0, -10.0, 11.46] and moving["taps"] == []
            for number in (1, 2):
                record = tap(number, Pose(0.02, -0.01, 0.15))
                cell.publish("plan_state", plan(PlanState.LOOKING, goal, taps=number, last=record))
                await first.state(lambda s, n=number: len(s["taps"]) == n)
            lost = tap(3, Pose(math.nan, math.nan, math.nan))
            cell.publish("plan_state", plan(PlanState.FAILED, goal, taps=3, last=lost))
            shown = (await first.state(lambda s: len(s["taps"]) == 3))["taps"]
            async with cell.open() as second:
                assert (await second.state(lambda s: s["taps"]))["taps"] == shown
            cell.publish("plan_state", plan(PlanState.LOOKING, Pose(0.0, 0.0, 0.0)))
            await first.state(lambda s: s["taps"] == [])
        assert shown[0]["commanded"] == [20.0, -10.0, 5.73]
        assert shown[0]["predicted"] == [19.0, -10.0, 5.73]
        assert shown[0]["measured"] == [20.0, -10.0, 8.59]
        assert shown[0]["remaining"] == [10.0, 2.86] and shown[0]["speed"] == 800
        assert shown[2]["measured"] == [None] * 3 and shown[2]["remaining"] == [None] * 2

    play(scenario)


def test_nodes_and_devices_are_described_in_text(cell: Cell) -> None:
    async def scenario() -> None:
        async with cell.open() as page:
            cell.plant()
            ready = await page.state(lambda s: s["mode"] == "ready")
            assert ready["object"]["pose"] == [10.0, -20.0, 28.65]
            rows = {row["name"]: row for row in ready["nodes"]}
            assert rows["scara_arm"]["life"] == "not running"
            status = DiagnosticStatus(name="/tapper_trigger", level=DiagnosticStatus.ERROR)
            status.message = "the interlock is open"
            foreign = DiagnosticStatus(name="/cell_b/tapper_trigger", message="not ours")
            cell.publish("/diagnostics", DiagnosticArray(status=[status, foreign]), 10)
            own = await page.state(
                lambda s: any(
                    row["name"] == "operator_page" and row["level"] == "ok" for row in s["nodes"]
                )
            )
            rows = {row["name"]: row for row in own["nodes"]}
            assert rows["operator_page"]["life"] == "active"
            assert "not ours" not in json.dumps(own)
            fault = ArmState(state=ArmState.FAULT, error_code=ErrorCode.ARM_ALARM)
            fault.error_msg = "the arm hit an end switch"
            cell.publish("arm_state", fault)
            shown = await page.state(lambda s: s["mode"] == "fault")
            assert shown["sentence"] == "the arm hit an end switch (503)"
            assert shown["sentence"] in [entry["text"] for entry in shown["log"]]
            silent = await page.state(lambda s: s["arm"]["state"] == "silent")
            assert silent["object"]["sentence"]
            cell.publish("arm_state", ArmState(state=ArmState.NOT_HOMED))
            cell.publish("plan_state", PlanState(state=PlanState.WAITING_FOR_CELL))
            waits = await page.state(lambda s: s["sentence"].startswith("the goal waits: "))
            assert waits["mode"] == "not ready" and waits["code"] != ErrorCode.NONE
            assert silent["runs_hint"] == "Runs are not recorded: run_recorder is not running."

    play(scenario)


def test_images_are_sent_only_to_open_pages_at_their_own_rate(cell: Cell) -> None:
    probe = cell.bench.probe
    assert probe is not None
    camera = load_cell().camera
    view = View(camera, CameraPose.above((0.02, -0.05, 0.7), (0.0, 0.0), 0.1))
    colours = np.zeros((camera.height, camera.width, 3), np.uint8)
    colours[:] = (200, 30, 60)
    height = load_cell().object.height

    def subscribers() -> int:
        return int(probe.count_subscribers("/camera/image_annotated"))

    def show() -> None:
        for topic, message, profile in (
            ("camera/camera_info", images.to_camera_info(camera), images.PICTURES),
            ("camera/image_annotated", images.to_message(colours, "bgr8"), images.PICTURES),
            ("camera/pose", PoseStamped(pose=camera_to_message(view.pose)), LATCHED),
        ):
            message.header.stamp = probe.get_clock().now().to_msg()
            cell.publish(topic, message, profile)

    async def pictures(page: Browser) -> bytes:
        """Publish images until one arrives."""
        while True:
            show()
            try:
                found = await asyncio.wait_for(page.connection.read_message(), 0.1)
            except asyncio.TimeoutError:
                continue
            if isinstance(found, bytes):
                return found

    async def scenario() -> None:
        assert subscribers() == 0
        async with cell.open() as page:
            frame = await asyncio.wait_for(pictures(page), TIMEOUT_S)
            number, _, age = PICTURE_HEADER.unpack(frame[:20])
            picture = cv2.imdecode(np.frombuffer(frame[20:], np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == colours.shape and age >= 0.0
            assert np.abs(picture[500, 600].astype(int) - colours[0, 0]).max() < 12
            for _ in range(5):  # nothing more is sent until the page reports the image as drawn
                show()
                await asyncio.sleep(0.1)
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(page.receive(lambda m: isinstance(m, bytes)), 0.5)
            await page.send({"do": "seen", "number": number})
            again = await asyncio.wait_for(pictures(page), TIMEOUT_S)
            assert PICTURE_HEADER.unpack(again[:20])[0] > number
            await ghost(page)
        cell.bench.wait(lambda: subscribers() == 0, "nobody listens when nobody looks")

    async def ghost(page: Browser) -> None:
        """Check that a pixel is converted to the place on the table that the camera sees at this
        pixel."""
        wanted = Pose(0.08, -0.05, 0.6)
        pixel = view.project([[wanted.x, wanted.y]], height)[0]
        u, v = (pixel + 0.5) / (camera.width, camera.height)
        await page.send({"do": "move", "number": 7, "u": u, "v": v, "angle": 30.0})
        answer = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "ghost")
        assert answer["number"] == 7 and answer["refusal"] == ""
        assert (answer["x"], answer["y"]) == pytest.approx((80.0, -50.0), abs=0.05)
        assert answer["angle"] == 30.0
        await page.send({"do": "place", "number": 8, "x": 400, "y": 0, "angle": 0})
        answer = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "ghost")
        assert "(103)" in answer["refusal"] and "400.0 mm" in answer["refusal"]

    play(scenario)


def test_stop_and_clear_reach_the_cell_and_a_missing_driver_is_reported(cell: Cell) -> None:
    received = cell.bench.listen(Bool, "emergency_stop", LATCHED)
    stop_port(cell)
    cleared: list[str] = []

    def clear(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        cleared.append("scara_arm")
        link = cell.page._stop
        assert link is not None and not link.held, "the page's own stop is released first"
        response.success, response.message = True, "clearing"
        return response

    assert cell.bench.probe is not None
    cell.bench.probe.create_service(Trigger, "scara_arm/clear_fault", clear)

    async def scenario() -> None:
        async with cell.open() as page:
            await page.send({"do": "stop"})
            assert (await page.answer("stop"))["ok"]
            cell.bench.wait(lambda: [m.data for m in received] == [True], "the stop")
            await asyncio.sleep(1.0)
            await page.send({"do": "clear"})
            answers = [await page.answer("clear"), await page.answer("clear")]
            assert {(a["ok"], a["text"]) for a in answers} == {
                (True, "scara_arm: clearing"),
                (False, "tapper_trigger does not answer; is it running?"),
            }
            cell.bench.wait(lambda: [m.data for m in received] == [True, False], "the latch ends")
            for name in ("cancel", "home", "press_button"):
                await page.send({"do": name})
                answer = await page.answer(name)
                assert answer["ok"] is False and "does not answer" in answer["text"]
            await page.send({"do": "goal", "x": 0, "y": 0, "angle": 0})
            assert "start tap_planner" in (await page.answer("goal"))["text"]
            cell.publish("arm_state", ArmState(state=ArmState.STOPPED))
            held = StopState(stopped=True, sources=["emergency_stop of /panel"])
            cell.publish("scara_arm/stop_state", held)
            await page.state(lambda s: "of /panel" in json.dumps(s["recovery"]))
            log = (await page.state(lambda s: len(s["log"]) >= 2))["log"]
            # The reports of page and arm about one stop are one event.
            assert [line["text"].split(" (")[0] for line in log if line["kind"] == "bad"] == [
                "STOP pressed on the page"
            ]

    play(scenario)
    assert cleared == ["scara_arm"]


def test_a_goal_gets_the_planners_refusal_and_can_be_canceled() -> None:
    nodes: list[Any] = []

    def make() -> list[Any]:
        nodes.extend([OperatorPage(), TapPlanner()])
        return list(nodes)

    with bench(make, PARAMETERS) as b:
        cell = Cell(b, nodes[0])
        b.wait(lambda: nodes[1].active, "the planner is active")
        assert b.probe is not None
        goals = b.probe.create_publisher(PoseStamped, "goal_pose", COMMAND)
        b.wait(lambda: goals.get_subscription_count() == 2, "the planner receives goals")
        goal = PoseStamped()
        goal.header.frame_id, goal.pose.position.x = "table", 0.05

        async def scenario() -> None:
            async with cell.open() as page:
                await page.state(lambda s: s["plan"]["state"] == "idle")
                await page.send({"do": "goal", "x": 400, "y": 0, "angle": 0})
                assert (await page.answer("goal"))["text"] == "goal sent"
                refused = await page.answer("goal")
                assert refused["ok"] is False and refused["text"].endswith("(103)")
                assert "400.0 mm" in refused["text"]
                log = (await page.state(lambda s: len(s["log"]) >= 2))["log"]
                assert log[-1]["text"] == f"goal refused: {refused['text']}"
                await page.send({"do": "cancel"})
                assert "there is no goal to cancel" in (await page.answer("cancel"))["text"]
                await page.send({"do": "goal", "x": 50, "y": 0, "angle": 10})
                # The planner's state may be received before this answer or after it.
                assert (await page.answer("goal"))["text"] == "goal sent"
                await page.state(lambda s: s["plan"]["busy"])
                await page.send({"do": "cancel"})
                assert (await page.answer("cancel"))["ok"]
                ended = await page.answer("goal")
                assert ended["text"] == f"the goal was canceled ({ErrorCode.GOAL_CANCELED})"
                # A goal without an action client, such as a goal that a planner has resumed.
                await page.state(lambda s: not s["plan"]["busy"])
                goals.publish(goal)
                await page.state(lambda s: s["plan"]["busy"])
                await page.send({"do": "cancel"})
                assert (await page.answer("cancel"))["text"] == "goal canceled; the arm withdraws"
                await page.state(lambda s: not s["plan"]["busy"])

        play(scenario)


def test_the_page_shows_the_planning_method_that_the_planner_uses() -> None:
    nodes: list[Any] = []

    def make() -> list[Any]:
        nodes.extend([OperatorPage(), TapPlanner()])
        return list(nodes)

    default = load_cell().file.goal.planner
    with bench(make, {**PARAMETERS, "tap_planner": {"planner": "exact"}}) as b:
        cell = Cell(b, nodes[0])
        b.wait(lambda: nodes[1].active, "the planner is active")
        assert b.probe is not None
        client = b.probe.create_client(SetParameters, "tap_planner/set_parameters")

        def set_elsewhere(method: str) -> None:
            changed = ParameterMessage(name="planner")
            changed.value.type = ParameterType.PARAMETER_STRING
            changed.value.string_value = method
            b.wait(client.service_is_ready, "the planner's parameters")
            done = client.call_async(SetParameters.Request(parameters=[changed]))
            b.wait(done.done, "the planner answers")
            assert done.result().results[0].successful

        async def scenario() -> None:
            async with cell.open() as page, cell.open() as other:
                await page.state(lambda s: s["planner"] == "exact")
                await other.send({"do": "set_planner", "planner": "conservative"})
                assert (await other.answer("settings"))["ok"]
                await page.state(lambda s: s["planner"] == "conservative")
                await page.send({"do": "set_planner", "planner": "no such method"})
                assert not (await page.answer("settings"))["ok"]
                assert (await page.state(lambda s: True))["planner"] == "conservative"
                await asyncio.to_thread(set_elsewhere, "exact")
                await page.state(lambda s: s["planner"] == "exact")
                await asyncio.to_thread(set_elsewhere, "")
                await page.state(lambda s: s["planner"] == default)

        assert default not in ("exact", "conservative")
        play(scenario)


def test_the_planning_method_is_unknown_without_a_planner(cell: Cell) -> None:
    async def scenario() -> None:
        async with cell.open() as page:
            assert (await page.state(lambda s: True))["planner"] is None
            await page.send({"do": "set_planner", "planner": "exact"})
            answer = await page.answer("settings")
            assert not answer["ok"] and "the planner does not answer" in answer["text"]

    play(scenario)


def several(folder: Path) -> Path:
    """Write a copy of the shipped cell with a second disk; return the path of its cell file."""
    content = yaml.safe_load((shared_folder() / "cell.yaml").read_text(encoding="utf-8"))
    for key in ("reference_markers", "camera_info", "object"):
        content[key] = str((shared_folder() / str(content[key])).resolve())
    other = yaml.safe_load(Path(content["object"]).read_text(encoding="utf-8"))
    other["name"], other["marker"]["id"] = "second disk", 30
    content["objects"] = ["second.yaml"]
    (folder / "second.yaml").write_text(yaml.safe_dump(other), encoding="utf-8")
    (folder / "cell.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder / "cell.yaml"


def test_several_objects_are_placed_by_a_preset_and_sent_as_one_arrangement(tmp_path: Path) -> None:
    nodes: list[Any] = []
    parameters = {
        "operator_page": {**PARAMETERS["operator_page"], "cell_file": str(several(tmp_path))},
        "tap_planner": {"cell_file": str(tmp_path / "cell.yaml")},
    }

    def make() -> list[Any]:
        nodes.extend([OperatorPage(), TapPlanner()])
        return list(nodes)

    with bench(make, parameters) as b:
        cell = Cell(b, nodes[0])
        b.wait(lambda: nodes[1].active, "the planner is active")
        own, other = nodes[0]._arrangements.names
        states = ObjectStates()
        for name, pose in ((own, Pose(-0.1, 0.0, 0.0)), (other, Pose(0.1, 0.05, 1.0))):
            state = ObjectState(object_id=name, visible=True, at_rest=True, frames_fused=30)
            state.pose.pose = to_message(pose)
            states.objects.append(state)

        async def scenario() -> None:
            async with cell.open() as page:
                welcome = await page.receive(
                    lambda m: isinstance(m, dict) and m["type"] == "welcome"
                )
                assert welcome["objects"] == [own, other]
                await page.send({"do": "preset", "preset": "swap", "objects": [own, other]})
                assert "is not seen" in (await page.answer("arrange"))["text"]
                cell.publish("object_states", states)
                shown = await page.state(lambda s: s["arrangement"]["objects"][1]["pose"])
                row = shown["arrangement"]["objects"][1]
                assert row["pose"] == [100.0, 50.0, 57.3] and row["at_rest"]
                assert shown["drafts"] is None
                draft = {"object": other, "x": 20, "y": -10, "angle": 30}
                await page.send({"do": "drafts", "goals": [draft]})
                async with cell.open() as second:  # as after a reload
                    found = await second.state(lambda s: s["drafts"])
                    assert found["drafts"] == [[other, 20.0, -10.0, 30.0]]
                await page.send({"do": "preset", "preset": "swap", "objects": [own, other]})
                preset = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "preset")
                assert preset["goals"] == [[own, 100.0, 50.0, 57.3], [other, -100.0, 0.0, 0.0]]
                await page.send({"do": "preset", "preset": "star", "objects": [own, other]})
                assert "must be one of line" in (await page.answer("arrange"))["text"]
                # Two goals at the same place: the answer is the planner's own refusal, which names
                # both objects.
                goals = [{"object": n, "x": 20, "y": 0, "angle": 0} for n in (own, other)]
                await page.send({"do": "arrange", "goals": goals})
                assert (await page.answer("arrange"))["text"] == "arrangement sent"
                refused = await page.answer("arrange")
                assert not refused["ok"] and refused["text"].endswith("(115)")
                assert own in refused["text"] and other in refused["text"]
                goals[1]["x"] = -150
                await page.send({"do": "arrange", "goals": goals})
                state = await page.state(lambda s: s["arrangement"]["active"])
                assert set(state["arrangement"]["progress"]) == {own, other}
                assert [row[:2] for row in state["drafts"]] == [[other, -150.0], [own, 20.0]]
                await page.send({"do": "cancel"})
                assert (await page.answer("cancel"))["ok"]
                state = await page.state(lambda s: not s["arrangement"]["active"])
                shown = state["arrangement"]["progress"][other]
                assert shown["state"] == "not reached" and shown["taps"] == 0
                await page.send(
                    {"do": "place", "number": 1, "object": "x", "x": 0, "y": 0, "angle": 0}
                )
                answer = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "ghost")
                assert "no object 'x'" in answer["trouble"] and answer["object"] == "x"

        play(scenario)


def test_recorded_runs_are_listed_but_nothing_outside_the_folder(tmp_path: Path) -> None:
    made: list[Any] = []

    def make() -> list[Any]:
        made.append(OperatorPage())
        return list(made)

    for name in ("runs/a-run", "elsewhere/forged"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "summary.json").write_text("{}")
    parameters = {"operator_page": {**PARAMETERS["operator_page"], "runs": tmp_path / "runs"}}
    with bench(make, parameters) as b:
        cell = Cell(b, made[0])

        async def scenario() -> None:
            async with cell.open() as page:
                found = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "runs")
                assert [run["name"] for run in found["runs"]] == ["a-run"]
                forged = str(tmp_path / "elsewhere" / "forged")
                cell.publish("last_run", String(data=forged))
                again = await page.receive(lambda m: isinstance(m, dict) and m["type"] == "runs")
                assert [run["name"] for run in again["runs"]] == ["a-run"]
                state = await page.state(lambda s: "recorded to" in s["runs_hint"])
                assert forged in state["runs_hint"] and "'runs'" in state["runs_hint"]
                cell.publish("last_run", String(data="\x01" * 100_000))
                await page.state(lambda s: len(s["runs_hint"]) < 6_000)

        play(scenario)


def stop_port(cell: Cell) -> int:
    """Return the port of the STOP server after waiting until it is ready."""
    cell.bench.wait(lambda: cell.page._stop and cell.page._stop.ready.is_set(), "STOP is served")
    with urllib.request.urlopen(f"http://{cell.address}/stop-port", timeout=TIMEOUT_S) as answer:
        return int(answer.read())


def press_stop(cell: Cell, port: int) -> int:
    """Press STOP as a browser does; return the HTTP status."""
    asked = urllib.request.Request(
        f"http://localhost:{port}/",
        data=b'{"do": "stop"}',
        headers={"Origin": f"http://{cell.address}"},
    )
    with urllib.request.urlopen(asked, timeout=TIMEOUT_S) as answer:
        return int(answer.status)


def test_stop_is_not_blocked_by_full_or_busy_pages(cell: Cell) -> None:
    received = cell.bench.listen(Bool, "emergency_stop", LATCHED)
    port = stop_port(cell)

    def busy(_: object) -> dict[str, object]:
        time.sleep(0.05)
        return {"type": "ghost", "number": 0, "trouble": "slow"}

    cell.page._ghost = type("Slow", (), {"answer": staticmethod(busy)})()

    async def scenario() -> None:
        async with contextlib.AsyncExitStack() as pages:
            opened = [await pages.enter_async_context(cell.open()) for _ in range(MAX_PAGES)]
            for page in opened:
                for number in range(50):
                    await page.send({"do": "place", "number": number, "x": 0, "y": 0, "angle": 0})
            async with cell.open() as late:  # the maximum number of pages is already connected
                assert await late.connection.read_message() is None
            assert await asyncio.to_thread(press_stop, cell, port) == 200
            cell.bench.wait(lambda: received and received[0].data, "the stop")

    play(scenario)


def test_a_stop_is_held_for_late_joiners_and_by_the_next_process(cell: Cell) -> None:
    port = stop_port(cell)
    link = cell.page._stop
    assert link is not None and not link.held
    assert press_stop(cell, port) == 200
    cell.bench.wait(lambda: link.held, "the stop is held")
    late = cell.bench.listen(Bool, "emergency_stop", LATCHED)
    cell.bench.wait(lambda: [m.data for m in late] == [True], "a late joiner sees it")
    assert link._process is not None
    link._process.kill()
    cell.bench.wait(lambda: [m.data for m in late] == [True, True], "the next process holds it")
    # The restarted process publishes the stop before it accepts requests. Until it accepts them, a
    # request to release the stop fails and is repeated.
    cell.bench.wait(link.release, "the next process takes the release")
    cell.bench.wait(lambda: [m.data for m in late] == [True, True, False], "it is released")
    assert not link.held


def test_on_the_network_the_page_requires_its_token_and_rejects_other_sites() -> None:
    made: list[Any] = []

    def make() -> list[Any]:
        made.append(OperatorPage())
        return list(made)

    parameters = {"operator_page": {"port": 0, "stop_port": 0, "address": "0.0.0.0"}}
    with bench(make, parameters) as b:
        cell = Cell(b, made[0])
        url, _, token = cell.page.urls[0].partition("#token=")
        assert len(token) > 20 and url.startswith("http://")
        assert token not in str(cell.page.health())
        port = cell.address.rpartition(":")[2]
        cell.address = f"127.0.0.1:{port}"

        async def scenario() -> None:
            async with cell.open() as page:
                assert await page.connection.read_message() is None
                assert page.connection.close_code == 4401
            asked = HTTPRequest(
                f"ws://{cell.address}/live", headers={"Origin": "http://evil.example"}
            )
            with pytest.raises(HTTPClientError, match="403"):
                await websocket_connect(asked)
            # also refused: this page sends no token when it connects
            async with cell.open() as page:
                with contextlib.suppress(WebSocketClosedError):
                    await page.send({"do": "hello", "token": token})
                assert await page.connection.read_message() is None

        play(scenario)


def test_a_port_in_use_is_reported_and_opened_when_it_becomes_free() -> None:
    made: list[Any] = []

    def make() -> list[Any]:
        made.append(OperatorPage())
        return list(made)

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with bench(make, {"operator_page": {"port": port, "stop_port": 0}}) as b:
            received = b.listen(DiagnosticArray, "/diagnostics")

            def complaints() -> list[str]:
                return [
                    s.message for m in received for s in m.status if f"port {port}" in s.message
                ]

            b.wait(complaints, "the taken port is said")
            assert "in use" in complaints()[0] and "set the parameters" in complaints()[0]
            taken.close()
            b.wait(lambda: made[0].urls, "the page is served")
            assert made[0].urls == [f"http://localhost:{port}/"]
