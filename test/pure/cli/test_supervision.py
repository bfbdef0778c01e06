"""Nodes that end are restarted a limited number of times. Only the end of an essential node ends
the others."""

from __future__ import annotations

import os
import socket
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.cli.graph import IMAGES, IMAGES_DELAY_S, Ended, NodeDied, last_output
from tapping_cell.cli.supervision import DELAY_S, HUNG_S, MAX_RESTARTS, WINDOW_S, Supervisor
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import service_manager
from tapping_cell.nodes.service_manager import ALIVE, SOCKET_VARIABLE, Notifications, notify


class FakeGraph:
    """Processes that end when the test asks them to."""

    def __init__(self) -> None:
        self.down: dict[str, Ended] = {}
        self.started: list[str] = []
        self.process_ids = {"scara_arm": os.getpid()}

    def kill(self, name: str) -> None:
        self.end(name)

    def ended(self) -> list[Ended]:
        return list(self.down.values())

    def restart(self, name: str) -> None:
        del self.down[name]
        self.started.append(name)

    def end(self, name: str, status: int = -9, words: str = "it printed nothing") -> None:
        self.down[name] = Ended(name, status, words)


@pytest.mark.parametrize("name", ["camera_pose", "run_recorder", "tap_planner", "scara_arm"])
def test_a_killed_node_is_named_and_restarted(name: str) -> None:
    graph = FakeGraph()
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    graph.end(name)
    (incident,) = supervisor.check(10.0)
    assert incident.node == name and "SIGKILL" in incident.sentence
    delay = IMAGES_DELAY_S if name in IMAGES else DELAY_S
    assert not supervisor.check(10.0 + 0.9 * delay) and not graph.started
    assert not supervisor.check(10.0 + delay) and graph.started == [name]


@pytest.mark.parametrize("profile", ["fastdds_profile.xml", "fastdds_messages.xml"])
def test_a_node_with_images_is_restarted_after_the_others_have_forgotten_it(profile: str) -> None:
    space = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
    (lease,) = ElementTree.parse(shared_folder() / profile).iter(f"{space}leaseDuration")
    assert float(lease.findtext(f"{space}sec", "")) < IMAGES_DELAY_S


@pytest.mark.parametrize(("name", "ends"), [("operator_page", False), ("tapper_trigger", True)])
def test_a_node_that_ends_repeatedly_is_restarted_a_limited_number_of_times(name, ends):
    graph, now = FakeGraph(), 0.0
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    for _ in range(MAX_RESTARTS):
        graph.end(name)
        supervisor.check(now)
        now += IMAGES_DELAY_S
        supervisor.check(now)
    graph.end(name)
    if ends:
        with pytest.raises(NodeDied, match=f"without {name}, which ended 4 times"):
            supervisor.check(now)
        return
    (incident,) = supervisor.check(now)
    assert incident.given_up and "the cell works without it" in incident.sentence
    assert not supervisor.check(now + WINDOW_S) and name in supervisor.left_alone


def test_rare_exits_do_not_accumulate() -> None:
    graph = FakeGraph()
    supervisor = Supervisor(graph)  # type: ignore[arg-type]
    for number in range(20):
        graph.end("scara_arm")
        supervisor.check(number * WINDOW_S)
        supervisor.check(number * WINDOW_S + DELAY_S)
    assert len(graph.started) == 20


def test_a_node_that_refuses_its_parameters_is_not_restarted() -> None:
    graph = FakeGraph()
    graph.end("tap_planner", 1, "loading | error: unknown parameter 'speeed'")
    with pytest.raises(NodeDied, match="error: unknown parameter 'speeed'"):
        Supervisor(graph).check(0.0)  # type: ignore[arg-type]


def test_a_node_whose_loop_hangs_is_killed_and_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, notifications = FakeGraph(), Notifications()
    supervisor = Supervisor(graph, notifications)  # type: ignore[arg-type]
    monkeypatch.setenv(SOCKET_VARIABLE, notifications.address)
    # A node that has not reported yet is still loading.
    now = 0.0
    for _ in range(60):
        now += 0.5
        assert not supervisor.check(now)
    notify(ALIVE)
    assert not supervisor.check(now)
    # While this process was suspended, the silence of the nodes does not count.
    now += 10 * HUNG_S
    assert not supervisor.check(now)
    incidents = []
    for _ in range(int(2 * HUNG_S)):
        now += 0.5
        incidents += supervisor.check(now)
    (incident,) = incidents
    assert f"did not respond for {HUNG_S:.0f} s" in incident.sentence
    now += DELAY_S
    assert not supervisor.check(now) and graph.started == ["scara_arm"]
    notifications.close()


def test_only_the_sender_of_a_report_counts_as_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    notifications = Notifications()
    monkeypatch.setenv(SOCKET_VARIABLE, notifications.address)
    for state in ("STATUS=WATCHDOG", ALIVE, f"READY=1\n{ALIVE}"):
        notify(state)
    assert notifications.alive() == {os.getpid()} and notifications.alive() == set()
    notifications.close()
    notify(ALIVE)  # nobody listens: no error
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as full:
        full.bind("")
        monkeypatch.setenv(SOCKET_VARIABLE, "@" + full.getsockname()[1:].decode())
        for _ in range(1000):
            notify(ALIVE)  # nobody reads: it does not block


def test_only_the_first_character_makes_an_address_abstract(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = str(tmp_path / "user@1000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(1.0)
        monkeypatch.setenv(SOCKET_VARIABLE, address)
        notify(ALIVE)
        assert manager.recv(100) == ALIVE.encode()


def test_the_output_is_found_in_a_log_that_was_emptied(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    log.write_text("old\nnew\n")
    assert last_output(log, 4) == "new"
    assert last_output(log, 1000) == "old | new"


@given(st.text(), st.integers(1, 999))
def test_a_code_in_the_journal_is_a_field_that_no_sentence_forges(sentence: str, code: int) -> None:
    with (
        pytest.MonkeyPatch.context() as patch,
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal,
    ):
        journal.bind(f"{folder}/journal")
        journal.setblocking(False)
        patch.setattr(service_manager, "JOURNAL", f"{folder}/journal")
        patch.delenv(service_manager.STREAM_VARIABLE, raising=False)
        service_manager.journal("scara_arm", code, sentence)
        with pytest.raises(BlockingIOError):
            journal.recv(1)
        patch.setenv(service_manager.STREAM_VARIABLE, "8:1")
        service_manager.journal("scara_arm", code, sentence)
        entry = journal.recv(65536).decode(errors="replace").split("\n")
    fields = dict(line.split("=", 1) for line in entry if line)
    assert len(fields) == 5 and fields["TAPPING_CELL_CODE"] == str(code)
    assert fields["MESSAGE"].startswith("scara_arm: ")
