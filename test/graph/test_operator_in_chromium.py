"""The operator's page in Chromium, connected to the complete simulated graph."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import socket
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from tapping_cell_msgs.msg import ArmState, TapperState

from tapping_cell.cli.graph import RECORDER, SIMULATED, Graph
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.se2 import Pose

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
Keys = webdriver.Keys
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
DRIVER = shutil.which("chromedriver")
if BROWSER is None or DRIVER is None:
    pytest.skip("Chromium and its chromedriver are not installed", allow_module_level=True)

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--disable-sync",
    "--window-size=1280,1000",
)
STATIC = Path(__file__).resolve().parents[2] / "tapping_cell" / "nodes" / "page" / "static"
TOLERANCE = (0.001, math.radians(1.0))
demanding = pytest.mark.skipif(
    os.environ.get("TAPPING_CELL_BROWSER") != "full",
    reason="a cell, its page and a browser exceed two cores here: TAPPING_CELL_BROWSER=full",
)


@dataclass
class Page:
    """The page in the browser and the cell that it shows."""

    driver: webdriver.Chrome
    graph: Graph
    client: GoalClient
    url: str
    downloads: Path

    def wait(self, condition: Callable[[], object], what: str, patience: float = 90.0) -> None:
        end = time.monotonic() + patience
        while not condition():
            self.graph.check()
            assert time.monotonic() < end, f"waited {patience:.0f} s in vain: {what}; {self.seen()}"
            time.sleep(0.1)

    def seen(self) -> str:
        return " | ".join(self.text(each) for each in ("mode", "banner", "goal-words"))

    def element(self, name: str) -> webdriver.remote.webelement.WebElement:
        return self.driver.find_element("id", name)

    def text(self, name: str) -> str:
        return str(self.element(name).text)

    def node_row(self, name: str) -> tuple[str, str] | None:
        """Return two texts of a node's row in the list: its life cycle state with the level, and
        its message. Return None if the node is not listed."""
        script = """
            const row = [...document.querySelectorAll("#nodes li")].find(
                (each) => each.querySelector(".name").textContent === arguments[0]);
            return row && [".life", ".said"].map(
                (part) => row.querySelector(part)?.textContent || "");
        """
        found = self.driver.execute_script(script, name)
        return tuple(found) if found else None

    def mode(self) -> str:
        return str(self.driver.execute_script("return document.body.dataset.mode"))

    def fields(self) -> list[float]:
        names = ("goal-x", "goal-y", "goal-angle")
        return [float(self.element(each).get_property("value") or "nan") for each in names]

    def settled_fields(self) -> list[float]:
        """Return the goal's fields when they have not changed for a second."""
        fields, since = self.fields(), time.monotonic()
        while time.monotonic() < since + 1.0:
            time.sleep(0.1)
            if self.fields() != fields:
                fields, since = self.fields(), time.monotonic()
        return fields

    def type_goal(self, *values: object) -> None:
        for name, value in zip(("goal-x", "goal-y", "goal-angle"), values, strict=True):
            field = self.element(name)
            field.clear()
            field.send_keys(str(value))

    def drag(self, name: str, right: int, down: int) -> None:
        hands = webdriver.ActionChains(self.driver, duration=100)
        hands.move_to_element(self.element(name)).click_and_hold()
        hands.move_by_offset(right // 2, down // 2).move_by_offset(
            right - right // 2, down - down // 2
        )
        hands.release().perform()

    def ready(self, patience: float = 90.0) -> None:
        self.wait(lambda: self.mode() == "ready", "the cell is ready", patience)

    def way_back(self) -> None:
        """Follow the numbered recovery steps after a stop until the cell is ready."""
        # The tapper clears its stop only within 10 s after the clear button at the cell was
        # pressed, so each attempt presses it again if necessary.
        for _ in range(5):
            for button in self.driver.find_elements("id", "step-press-button"):
                button.click()  # missing while the last press counts
            self.wait(
                lambda: not self.driver.find_elements("id", "step-press-button"), "the press counts"
            )
            self.element("step-clear").click()
            self.element("confirm-yes").click()
            end = time.monotonic() + 8.0
            while self.mode() == "stopped" and time.monotonic() < end:
                time.sleep(0.1)
            if self.mode() != "stopped":
                break
        assert self.mode() != "stopped", self.text("attention")
        # After a stop, the arm's position is unknown, and it homes only when a person requests it.
        self.wait(
            lambda: self.client.arm_state.state == ArmState.NOT_HOMED, "the arm asks to be homed"
        )
        self.wait(lambda: self.driver.find_elements("id", "step-home"), "the page offers to home")
        self.element("step-home").click()
        self.element("confirm-yes").click()
        self.ready()

    def answer_proposal(self, confirm: bool) -> str:
        """Confirm or reject the tap that waits for confirmation; return its id."""
        self.wait(lambda: self.element("planned-yes").is_displayed(), "a tap is proposed")
        button = self.element("planned-yes" if confirm else "planned-no")
        self.wait(button.is_enabled, "the buttons belong to the tap that is shown")
        tap_id = self.proposed()
        button.click()
        return tap_id

    def proposed(self) -> str:
        """Return the id of the tap whose description is shown."""
        return str(self.element("planned").get_attribute("data-tap"))


def browser_options(folder: Path) -> webdriver.ChromeOptions:
    """Return the options of a browser that keeps its files below ``folder``."""
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for flag in (*FLAGS, f"--user-data-dir={folder / 'browser'}"):
        options.add_argument(flag)
    return options


@contextmanager
def opened(folder: Path, **more: object) -> Iterator[Page]:
    """Start a cell with its page in a browser; ``more``: parameters of arm and tapper."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    parameters: dict[str, dict[str, object]] = {
        "sim_world": {"arm_port": folder / "arm", "tapper_port": folder / "tapper", "seed": 3},
        "scara_arm": {"port": folder / "arm", "home_on_activate": True, **more},
        "tapper_trigger": {"port": folder / "tapper", **more},
        # On a busy machine, late images can end taps, which are then planned again.
        "tap_planner": {"attempts": 20},
        "operator_page": {"port": port, "stop_port": 0, "runs": folder / "runs"},
        RECORDER: {"folder": folder / "runs", "pictures": False},
    }
    options = browser_options(folder)
    downloads = folder / "downloads"
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    nodes = (*SIMULATED, RECORDER, "operator_page")
    with (
        Graph(nodes, parameters, folder / "logs", {"HOME": str(folder)}) as graph,
        GoalClient() as client,
    ):
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        try:
            made = Page(driver, graph, client, f"http://localhost:{port}/", downloads)
            log = folder / "logs" / "operator_page.log"
            made.wait(lambda: made.url in log.read_text(), "the node says where its page is")
            driver.get(made.url)
            yield made
        finally:
            driver.quit()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with opened(tmp_path_factory.mktemp("cell")) as made:
        yield made


def test_an_idle_cell_is_shown_with_its_camera_image_and_nodes(page: Page) -> None:
    page.ready()
    names = ("sim_world", "camera_pose", "tap_planner", "scara_arm", "tapper_trigger")
    # On a busy machine, a node may report a warning instead of "ok". The page must show the same
    # message as the node's diagnostics.
    logged: dict[str, set[tuple[str, str]]] = {name: set() for name in names}

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            level = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "warning"}.get(status.level)
            name = status.name.split("/")[-1]
            if level and name in logged:
                logged[name].add(
                    (f"active, {level}", "" if status.message == "ok" else status.message)
                )

    node = page.client.node
    listener = page.client.in_executor(
        lambda: node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
    )
    page.wait(
        lambda: all(page.node_row(name) in logged[name] for name in names),
        "every node is active, with its own words",
    )
    # Destroy the subscription in the client's own thread; any other thread would race with its
    # executor.
    page.client.in_executor(lambda: node.destroy_subscription(listener))
    page.wait(lambda: page.element("picture").get_attribute("data-number"), "a picture")
    width, height = (page.element("picture").get_property(n) for n in ("width", "height"))
    assert (width, height) == (1280, 1024)
    page.wait(
        lambda: "s old" in page.text("picture-words") and not page.text("stage-words"),
        "a fresh picture",
    )
    assert page.element("stop").is_enabled() and not page.element("attention").is_displayed()
    assert not page.element("cancel").is_enabled() and not page.element("download").is_displayed()
    # The page's content security policy blocked nothing, and there were no script errors.
    complaints = [entry for entry in page.driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert complaints == []


def test_the_dragged_ghost_sets_the_goal_and_the_taps_are_listed(page: Page) -> None:
    page.wait(lambda: page.element("ghost-outline").is_displayed(), "the ghost")
    page.wait(lambda: math.isfinite(page.fields()[0]), "the ghost's numbers")
    seen = page.client.object_pose()
    assert page.fields()[:2] == pytest.approx([1e3 * seen.x, 1e3 * seen.y], abs=0.2)
    before = page.fields()
    shown = page.element("picture").rect["width"]
    page.drag("ghost-outline", 60, 24)
    # A camera pixel is about 0.61 mm on the table; the image is scaled to the size at which the
    # page shows it.
    scale = 0.61 * 1280 / shown
    wanted = [before[0] + 60 * scale, before[1] - 24 * scale]
    page.wait(lambda: page.fields()[:2] == pytest.approx(wanted, abs=3.0), f"{wanted}")
    turned = page.fields()[2]
    page.drag("ghost-handle", 6, 10)
    page.wait(lambda: abs(page.fields()[2] - turned) > 3.0, "the handle turns the ghost")
    x, y, angle = page.settled_fields()
    ghost = page.element("ghost-outline")
    ghost.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_UP, Keys.PAGE_DOWN)
    keyed = [x + 2, y + 1, angle - 1]
    page.wait(lambda: page.fields() == pytest.approx(keyed, abs=0.15), f"the keys: {keyed}")
    x, y, angle = page.fields()
    assert not page.element("goal-trouble").text
    page.element("send").click()
    page.wait(lambda: page.mode() == "moving", "the cell moves")
    page.wait(lambda: page.driver.find_elements("css selector", "#taps tbody tr"), "the first tap")
    page.wait(lambda: "reached" in page.text("goal-words"), "the goal is reached", 150.0)
    rows = page.driver.find_elements("css selector", "#taps tbody tr")
    assert str(len(rows)) == page.text("to-go-taps")
    assert rows[-1].find_elements("css selector", "td.remaining.inside")
    true = page.client.settled_truth()
    goal = Pose(1e-3 * x, 1e-3 * y, math.radians(angle))
    slack = 0.1 + 1e-9  # the fields are rounded to 0.1 mm and 0.1 degrees
    assert true is not None and true.distance_to(goal) <= TOLERANCE[0] + 1e-3 * slack
    assert abs(true.rotation_to(goal)) <= TOLERANCE[1] + math.radians(slack)
    assert "goal reached" in page.text("log")


def test_the_run_is_downloaded(page: Page) -> None:
    page.wait(lambda: page.element("download").is_displayed(), "the run is recorded")
    rows = page.driver.find_elements("css selector", "#runs tbody tr")
    assert len(rows) == 1 and "reached" in rows[0].text
    page.element("download").click()
    page.wait(lambda: list(page.downloads.glob("*.zip")), "the download")
    with zipfile.ZipFile(next(page.downloads.glob("*.zip"))) as run:
        names = {Path(name).name for name in run.namelist()}
        summary = next(name for name in run.namelist() if name.endswith("summary.json"))
        assert json.loads(run.read(summary)) and "taps.csv" in names
        assert any(name.endswith(".mcap") for name in names)


@demanding
def test_every_tap_is_confirmed_if_the_operator_enables_it(page: Page) -> None:
    page.ready()
    page.element("ask").click()
    page.wait(lambda: "is on" in page.text("settings-answer"), "the planner asks from now on")
    seen = page.client.object_pose()
    page.type_goal(f"{1e3 * seen.x - 40:.1f}", f"{1e3 * seen.y:.1f}", 0)
    page.element("send").click()
    first = page.answer_proposal(False)
    page.wait(lambda: page.proposed() != first, "another tap is proposed")
    assert "skipped" in page.text("planned-words")
    assert page.element("planned-drawing").get_attribute("hidden") is None
    assert len((page.element("planned-ellipse").get_attribute("points") or "").split()) == 48
    assert page.text("mode-word") == "YOUR TURN"
    time.sleep(2.0)
    assert page.client.arm_state.state == ArmState.IDLE, "nothing moves before the answer"
    end = time.monotonic() + 150.0
    while "reached" not in page.text("goal-words"):
        assert time.monotonic() < end, page.seen()
        if page.element("planned-yes").is_displayed() and page.element("planned-yes").is_enabled():
            page.element("planned-yes").click()
            page.wait(lambda: page.mode() != "waiting", "the answer is taken")
        time.sleep(0.1)
    page.element("ask").click()
    page.wait(lambda: "is off" in page.text("settings-answer"), "the planner does not ask any more")


@demanding
def test_queued_goals_are_reached_in_order(page: Page) -> None:
    page.ready()
    seen = page.client.object_pose()
    for step in (20, -15):
        page.type_goal(f"{1e3 * seen.x + step:.1f}", f"{1e3 * seen.y:.1f}", 0)
        page.element("enqueue").click()
        page.wait(lambda: "added" in page.text("queue-answer"), "the goal waits")
        page.driver.execute_script("document.getElementById('queue-answer').textContent = ''")
    assert "2 goals are waiting" in page.text("queue-words")
    assert page.mode() == "ready", "nothing moves before the queue is run"
    before = page.text("log").count("goal reached")
    page.element("queue-run").click()
    page.wait(lambda: page.text("log").count("goal reached") == before + 2, "both goals", 200.0)
    page.wait(lambda: page.text("queue-words") == "No goal is waiting.", "the queue is empty")
    true = page.client.settled_truth()
    assert true is not None and abs(true.x - (seen.x - 0.015)) < 1.2e-3


@demanding
def test_a_named_goal_is_restored_after_a_reload(page: Page) -> None:
    page.ready()
    page.element("more").find_element("tag name", "summary").click()
    page.type_goal("12.5", "-7.5", "33")
    page.element("new-name").send_keys("beside the light")
    page.element("keep").click()
    page.wait(lambda: "saved as" in page.text("queue-answer"), "the name is kept")
    page.driver.refresh()
    page.ready()
    page.element("more").find_element("tag name", "summary").click()
    page.wait(lambda: "beside the light" in page.text("named"), "the name")
    page.element("named").send_keys("beside the light")
    page.wait(lambda: page.fields() == pytest.approx([12.5, -7.5, 33.0], abs=0.11), "the goal")


@demanding
def test_a_second_page_shows_the_same_state_and_can_stop(page: Page) -> None:
    page.ready()
    first = page.driver.current_window_handle
    page.driver.switch_to.new_window("window")
    page.driver.get(page.url)
    page.ready()
    page.wait(lambda: page.element("stop").is_enabled(), "STOP of the second page")
    page.element("stop").click()
    page.wait(lambda: page.mode() == "stopped", "the second page says so")
    page.driver.close()
    page.driver.switch_to.window(first)
    page.wait(lambda: page.mode() == "stopped", "the first page says so")
    page.way_back()


def test_invalid_input_is_answered_with_a_message_and_nothing_moves(page: Page) -> None:
    page.ready()
    page.type_goal("abc", 0, 0)
    page.element("send").click()
    assert page.text("goal-trouble") == "x is 'abc': type a number in mm, such as 12.5."
    page.type_goal("400", 0, 0)
    page.wait(lambda: "400.0 mm" in page.text("goal-trouble"), "the refusal to come")
    page.element("send").click()
    page.wait(lambda: "(103)" in page.text("goal-answer"), "the planner's own refusal")
    assert page.mode() == "ready"


def test_stop_takes_one_click_and_recovery_is_confirmed(page: Page) -> None:
    seen = page.client.object_pose()
    page.type_goal(1e3 * seen.x - 60, 1e3 * seen.y, 0)
    page.element("send").click()
    client = page.client
    page.wait(
        lambda: client.arm_state and client.arm_state.state == ArmState.MOVING, "the arm moves"
    )
    page.element("stop").click()
    page.wait(
        lambda: (
            client.arm_state.state == ArmState.STOPPED
            and client.tapper_state.state == TapperState.STOPPED
        ),
        "both stopped",
    )
    page.wait(lambda: page.mode() == "stopped", "the page says so")
    assert page.element("attention").is_displayed()
    typed = page.fields()
    assert not page.element("send").is_enabled() and "is stopped" in page.text("goal-blocked")
    page.element("step-clear").click()
    time.sleep(0.5)
    assert page.mode() == "stopped", "nothing is cleared before it is confirmed"
    page.element("confirm-no").click()
    assert page.mode() == "stopped" and page.element("step-clear").is_displayed()
    page.way_back()
    assert not page.element("attention").is_displayed()
    assert page.fields() == typed, "what was typed stays"


def test_a_lost_server_is_reported_and_reconnected_automatically(page: Page) -> None:
    page.ready()
    os.kill(page.graph.process_ids["operator_page"], signal.SIGKILL)
    end = time.monotonic() + 90
    while page.mode() != "lost":
        assert time.monotonic() < end
        time.sleep(0.1)
    # Buttons whose requests would not be received are disabled. STOP has its own process and is
    # checked every 2 s. The process ends with the server, so STOP is disabled a little later.
    for name in ("send", "cancel", "goal-x", "home-ghost"):
        assert not page.element(name).is_enabled(), name
    end = time.monotonic() + 90
    while page.element("stop").is_enabled():
        assert time.monotonic() < end, "STOP is offered, but not served"
        time.sleep(0.1)
    assert not page.element("download").is_displayed()
    assert "use its wired emergency stop" in page.text("banner")
    assert "This image is" in page.text("stage-words")
    assert "lost" in str(page.driver.execute_script("return document.body.className"))
    page.graph.restart("operator_page")
    page.ready()
    assert not page.element("banner").is_displayed() and page.element("stop").is_enabled()


def test_the_page_fits_the_width_of_a_phone(page: Page) -> None:
    page.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True},
    )
    page.ready()
    assert page.driver.execute_script("return document.documentElement.scrollWidth") <= 390
    stop = page.driver.execute_script(
        "const box = document.getElementById('stop').getBoundingClientRect();"
        "return [box.left, box.right, box.top, box.bottom, innerWidth, innerHeight];"
    )
    left, right, top, bottom, width, height = stop
    assert left >= 0 and right <= width and top >= 0 and bottom <= height
    assert right - left > 300 and bottom - top >= 60
    covered = page.driver.execute_script(
        "return document.getElementById('main').getBoundingClientRect().bottom;"
    )
    assert covered <= top, "STOP covers something"
    for control in page.driver.find_elements("css selector", "button, input"):
        if control.is_displayed():
            assert control.rect["height"] >= 44, control.get_attribute("id")


@demanding
def test_set_up_mode_moves_only_while_the_key_is_held(tmp_path: Path) -> None:
    with opened(tmp_path, set_up=True) as page:
        page.wait(lambda: page.element("set-up").is_displayed(), "set-up mode is shown")
        page.wait(lambda: page.driver.find_elements("id", "step-home"), "the page offers to home")
        arm = lambda: page.client.arm_state.state  # noqa: E731
        hands = webdriver.ActionChains(page.driver, duration=50)
        hands.click_and_hold(page.element("enable")).perform()
        page.wait(lambda: page.client.arm_state.enabled, "the arm hears the key")
        time.sleep(1.0)
        assert page.client.arm_state.enabled, "held on"
        # The mouse holds the enabling button, so a script clicks the other buttons.
        page.driver.execute_script("document.getElementById('step-home').click()")
        page.driver.execute_script("document.getElementById('confirm-yes').click()")
        page.wait(lambda: arm() == ArmState.HOMING, "the arm homes while the key is held")
        webdriver.ActionChains(page.driver, duration=0).release().perform()
        page.wait(lambda: arm() != ArmState.HOMING, "the arm stops")
        page.wait(lambda: not page.client.arm_state.enabled, "the arm hears the release")
        assert not page.client.arm_state.homed
        # Closing the page while the enabling button is held releases the button.
        hands = webdriver.ActionChains(page.driver, duration=50)
        hands.click_and_hold(page.element("enable")).perform()
        page.wait(lambda: page.client.arm_state.enabled, "held again")
        page.driver.get("about:blank")
        page.wait(lambda: not page.client.arm_state.enabled, "it is released")


@demanding
def test_two_fingers_jog_the_arm_until_the_first_one_slides_away(tmp_path: Path) -> None:
    with opened(tmp_path, set_up=True) as page:
        size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
        page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        page.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
        page.wait(lambda: page.element("set-up").is_displayed(), "set-up mode is shown")
        page.driver.execute_script("document.getElementById('set-up').scrollIntoView()")
        arm = lambda: page.client.arm_state.state  # noqa: E731

        def touch(kind: str, *fingers: tuple[int, float, float]) -> None:
            points = [{"id": finger, "x": x, "y": y} for finger, x, y in fingers]
            page.driver.execute_cdp_cmd(
                "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points}
            )

        def middle(name: str) -> tuple[float, float]:
            return tuple(
                page.driver.execute_script(
                    "const box = document.getElementById(arguments[0]).getBoundingClientRect();"
                    "return [box.left + box.width / 2, box.top + box.height / 2];",
                    name,
                )
            )

        x, y = middle("enable")
        touch("touchStart", (0, x, y))
        page.wait(lambda: page.element("jog-home").is_enabled(), "the key is held")
        touch("touchStart", (0, x, y), (1, *middle("jog-home")))
        touch("touchEnd", (1, *middle("jog-home")))
        page.wait(lambda: arm() == ArmState.HOMING, "the second finger homes the arm")
        touch("touchMove", (0, x, y + 60))
        assert page.element("enable").get_attribute("aria-pressed") == "false"
        page.wait(lambda: arm() == ArmState.STOPPED, "the arm stops as the finger slides away")


def test_the_tables_of_an_arrangement_stay_inside_their_cards(tmp_path: Path) -> None:
    options = browser_options(tmp_path)
    tap = {
        **{"speed": 1169, "outcome": "fired", "method": "optimal", "before": [250, 1]},
        **{"commanded": [-108.8, -133.0, -115.0], "predicted": [-108.4, -132.4, -115.9]},
        **{"measured": [-198.5, -128.3, -116.2], "remaining": [166.91, -121.61]},
    }
    # The first object took nine taps.
    taps = [{**tap, "object": "aluminium disk", "number": 1}]
    taps += [{**tap, "object": "square 2", "number": number} for number in (10, 11)]
    run = {
        **{"name": "run", "outcome": "not truly reached", "error": "", "began": 1.7e9},
        **{"objects": 1, "goal": [-120, -130, -150], "taps": 12, "residual": [70.98, -120.1]},
        **{"report": True, "kept": False},
    }
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    try:
        driver.get((STATIC / "index.html").as_uri())
        for width in (1920, 1366, 1280, 390):
            size = {"width": width, "height": 768, "deviceScaleFactor": 1, "mobile": width < 760}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            driver.execute_script(
                "state = {plan: {tolerance: [1, 1], object: 'square 2'}, taps: arguments[0]};"
                "renderTaps(); renderRuns(Array(12).fill(arguments[1]), 'key', '', true);",
                taps,
                run,
            )
            for name in ("taps", "runs"):
                beyond = driver.execute_script(
                    "const table = document.getElementById(arguments[0]);"
                    "const card = table.parentElement;"
                    "return table.getBoundingClientRect().right - card.getBoundingClientRect().left"
                    " - card.clientLeft - card.clientWidth;",
                    name,
                )
                # clientWidth is rounded to whole pixels.
                assert beyond < 1, f"{name} at a width of {width}: {beyond} px beyond its card"
            goal = driver.execute_script(
                "$('arrange-card').hidden = false;"
                "const row = arrangement.row('aluminium disk', false);"
                "row.ghost.touched = true; row.pose = {x: -235.9, y: -120.3, angle: -120.1};"
                "arrangement.describe(row); row.progress.textContent = 'being tapped';"
                "document.querySelector('#arrange-table tbody').replaceChildren(row.element);"
                "return [row.goal.scrollWidth, row.goal.clientWidth];"
            )
            assert goal[0] <= goal[1], f"the goal covers the progress at a width of {width}: {goal}"
        spoken = driver.find_element("id", "plot").get_attribute("aria-label")
        assert "at the start 250.0 mm, after tap 10 166.9 mm" in spoken
        driver.execute_script(
            "arrangement.several = true; renderTaps();"
            "$('run-filter').value = whenOf(arguments[0]);"
            "renderRuns([arguments[0]], '', '', true);",
            run,
        )
        assert len(driver.find_elements("css selector", "#runs tbody tr")) == 1
        shown = [each.text for each in driver.find_elements("css selector", "#plot text")]
        assert "start" in shown and "10" in shown and "1" not in shown
        assert "square 2: tolerance 1 mm" in shown
    finally:
        driver.quit()


def test_the_page_file_references_no_other_host() -> None:
    for file in STATIC.iterdir():
        foreign = file.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in foreign and "https://" not in foreign, file.name
