"""Messages from a browser are validated strictly; Host, Origin and token decide who may connect."""

from __future__ import annotations

import json
import math
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.nodes.page.ghost import Ghost
from tapping_cell.nodes.page.guard import Guard, is_loopback, kept_token, urls
from tapping_cell.nodes.page.requests import (
    KINDS,
    LONGEST_NAME,
    MAX_OBJECTS,
    Arrange,
    BadRequest,
    Command,
    Confirm,
    Drafts,
    Hello,
    Jog,
    Move,
    NameGoal,
    Place,
    Preset,
    QueueGoal,
    Seen,
    SendGoal,
    Turn,
    Unqueue,
    parse,
)
from tapping_cell.se2 import Pose
from tapping_cell.vision import CameraModel, CameraPose, View

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)


WORDS = (
    "number",
    "x",
    "y",
    "angle",
    "u",
    "v",
    "token",
    "tap_id",
    "confirm",
    "ask",
    "planner",
    "name",
    "position_tolerance",
    "angle_tolerance",
    "object",
    "objects",
    "goals",
    "in_order",
    "preset",
)

GOAL = {"object": "red", "x": 0, "y": 0, "angle": 0}

# ---- messages


@given(st.text() | JSON.map(json.dumps) | st.binary())
def test_anything_other_than_a_request_is_refused_with_a_message(message: str | bytes) -> None:
    with pytest.raises(BadRequest) as refused:
        parse(message)
    assert len(str(refused.value)) > 15


@given(st.sampled_from(KINDS), st.dictionaries(st.sampled_from(WORDS), JSON, max_size=7))
def test_a_request_with_any_content_is_read_or_refused_and_every_number_is_finite(kind, content):
    try:
        request = parse(json.dumps({**content, "do": kind}))
    except BadRequest:
        return
    numbers = {
        Move: lambda r: (r.u, r.v, r.angle),
        Turn: lambda r: (r.x, r.y, r.u, r.v),
        Place: lambda r: r.pose,
        SendGoal: lambda r: (*r.pose, *r.tolerance),
        QueueGoal: lambda r: (*r.pose, *r.tolerance),
        NameGoal: lambda r: r.pose,
        Unqueue: lambda r: (r.number,),
        Confirm: lambda r: (r.tap_id,),
        Arrange: lambda r: (*(n for _, pose in r.goals for n in pose), *r.tolerance),
        Seen: lambda r: (r.number,),
    }.get(type(request), lambda _: ())
    assert all(math.isfinite(number) for number in numbers(request))
    for name in ("name", "planner"):
        text = getattr(request, name, "x")
        assert isinstance(text, str) and 0 < len(text) <= LONGEST_NAME


def test_a_goal_is_in_millimetres_and_degrees() -> None:
    goal = parse('{"do": "goal", "x": 12.5, "y": -3, "angle": 90}')
    assert goal == SendGoal(Pose(0.0125, -0.003, math.radians(90)))
    close = parse('{"do": "goal", "x": 0, "y": 0, "angle": 0, "position_tolerance": 0.5}')
    assert close == SendGoal(Pose(0.0, 0.0, 0.0), (0.0005, 0.0))
    both = [{"object": name, "x": 10, "y": 0, "angle": 180} for name in ("red", "blue")]
    assert parse(json.dumps({"do": "arrange", "goals": both, "in_order": True})) == Arrange(
        (("red", Pose(0.01, 0.0, math.pi)), ("blue", Pose(0.01, 0.0, math.pi))), in_order=True
    )
    one = parse('{"do": "goal", "x": 1, "y": 0, "angle": 0, "object": "red"}')
    assert isinstance(one, SendGoal) and one.object == "red"
    assert parse('{"do": "drafts", "goals": []}') == Drafts(())
    assert parse(json.dumps({"do": "drafts", "goals": both[:1]})) == Drafts(
        (("red", Pose(0.01, 0.0, math.pi)),)
    )
    preset = {"do": "preset", "preset": "grid", "objects": ["red", "blue"]}
    assert parse(json.dumps(preset)) == Preset("grid", ("red", "blue"))
    assert parse('{"do": "stop"}') == Command("stop")
    assert parse('{"do": "jog", "axis": "x", "step": -5}') == Jog("x", -0.005)
    assert parse('{"do": "jog", "axis": "tool", "step": 180}') == Jog("tool", math.pi)
    for wrong in ('"w", "step": 1', '["x"], "step": 1', '"x", "step": "1"', '"x"'):
        with pytest.raises(BadRequest):
            parse(f'{{"do": "jog", "axis": {wrong}}}')
    assert parse('{"do": "confirm", "tap_id": 7, "confirm": true}') == Confirm(7, True)
    assert parse('{"do": "hello", "token": 5}') == Hello(5)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ('{"do": "goal", "x": NaN, "y": 0, "angle": 0}', "x is NaN"),
        ('{"do": "goal", "x": 1e999, "y": 0, "angle": 0}', "x is Infinity"),
        ('{"do": "goal", "x": null, "y": 0, "angle": 0}', "x is null; type a number"),
        ('{"do": "goal", "x": "7", "y": 0, "angle": 0}', 'x is "7"; type a number'),
        ('{"do": "goal", "x": true, "y": 0, "angle": 0}', "x is true; type a number"),
        ('{"do": "goal", "x": 2e6, "y": 0, "angle": 0}', "x is 2000000.0; a number between"),
        ('{"do": "goal", "x": 0, "angle": 0}', "y is null"),
        ('{"do": "seen", "number": -1}', "number is -1, not a whole number"),
        ('{"do": "confirm", "tap_id": 7}', "confirm is null; true or false"),
        ('{"do": "confirm", "tap_id": 7, "confirm": 1}', "confirm is 1; true or false"),
        ('{"do": "confirm", "tap_id": "7", "confirm": true}', "not a whole number"),
        ('{"do": "name_goal", "name": " ", "x": 0, "y": 0, "angle": 0}', "1 to 40 printable"),
        ('{"do": "forget_goal", "name": "a\\u0000"}', "1 to 40 printable"),
        ('{"do": "arrange", "goals": []}', "one goal or more"),
        ('{"do": "arrange", "goals": [7]}', "one goal or more"),
        ('{"do": "arrange", "goals": {}}', "goals is not a list of at most 20"),
        (json.dumps({"do": "arrange", "goals": [GOAL, GOAL]}), "each for a different object"),
        (json.dumps({"do": "arrange", "goals": [GOAL] * (MAX_OBJECTS + 1)}), "at most 20"),
        ('{"do": "preset", "preset": "grid", "objects": [7]}', "object is 7; 1 to 40"),
        ('{"do": "keep_run", "run": 7, "keep": true}', "run is 7; 1 to 120"),
        ('{"do": "keep_run", "run": "a", "keep": "no"}', 'keep is "no"; true or false'),
        ('{"do": "fly"}', "'do' is \"fly\", but must be one of hello"),
        ("[1]", "not a JSON object"),
        ('{"do"', "not JSON"),
        ("[" * 4000, "not JSON"),
        (b"{}", "binary"),
    ],
)
def test_an_invalid_request_is_refused_with_a_message(message: str | bytes, words: str) -> None:
    with pytest.raises(BadRequest) as refused:
        parse(message)
    assert words in str(refused.value)


# ---- connections

LOCAL = Guard.make("localhost", (), "")
OPEN = Guard.make("0.0.0.0", ["Cell.example"], "")


def test_network_access_requires_a_token_and_local_access_does_not() -> None:
    assert is_loopback("127.0.0.1") and is_loopback("::1") and is_loopback("localhost")
    assert not any(is_loopback(each) for each in ("0.0.0.0", "::", "192.168.1.5", "cell", ""))
    assert LOCAL.token == "" and LOCAL.admits(None)
    assert len(OPEN.token) >= 20 and OPEN.token != Guard.make("0.0.0.0", (), "").token
    assert Guard.make("::", (), "mine").token == "mine"
    assert Guard.make("127.0.0.1", (), "mine").admits("mine")


def test_the_generated_token_survives_a_restart_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    file = tmp_path / "domain0/page_token"
    token = kept_token(file)
    assert len(token) >= 20 and kept_token(file) == token
    assert file.stat().st_mode & 0o077 == 0
    file.write_text("")
    assert kept_token(file) not in ("", token)


@given(JSON)
def test_only_the_right_token_is_admitted(token: object) -> None:
    assert not OPEN.admits(token)
    assert OPEN.admits(OPEN.token)


@pytest.mark.parametrize(
    ("guard", "host", "origin"),
    [
        (LOCAL, "localhost:8010", "http://localhost:8010"),
        (LOCAL, "127.0.0.1:8010", "http://127.0.0.1:8010"),
        (LOCAL, "[::1]:8010", "http://[::1]:8010"),
        (LOCAL, "localhost:9000", "http://localhost:9000"),  # through an SSH tunnel
        (OPEN, "192.168.1.5:8010", "http://192.168.1.5:8010"),
        (OPEN, "[fd00::5]:8010", "http://[fd00::5]:8010"),
        (OPEN, "cell.example", "https://cell.example"),  # behind a reverse proxy
    ],
)
def test_the_pages_own_origin_may_command(guard: Guard, host: str, origin: str) -> None:
    assert guard.refusal(host, origin, command=True) == ""
    assert guard.refusal(host, None, command=False) == ""


@pytest.mark.parametrize(
    ("guard", "host", "origin"),
    [
        (LOCAL, "localhost:8010", None),
        (LOCAL, "localhost:8010", "null"),
        (LOCAL, "localhost:8010", "http://evil.example"),
        (LOCAL, "localhost:8010", "http://localhost:3000"),  # another program on this computer
        (LOCAL, "localhost:8010", "http://localhost:8010.evil.example"),
        (LOCAL, "localhost:8010", "http://localhost:8010@evil.example"),
        (LOCAL, "localhost:8010", "file://localhost:8010"),
        (LOCAL, "localhost:8010", "http://127.0.0.1:8010"),
        # a foreign name that resolves to this computer
        (LOCAL, "evil.example:8010", "http://evil.example:8010"),
        (LOCAL, "192.168.1.5:8010", "http://192.168.1.5:8010"),
        (LOCAL, "", "http://"),
        (LOCAL, "localhost:99999", "http://localhost:99999"),
        (LOCAL, "evil@localhost:8010", "http://evil@localhost:8010"),
        (OPEN, "evil.example:8010", "http://evil.example:8010"),
        (OPEN, "192.168.1.5.evil.example", "http://192.168.1.5.evil.example"),
    ],
)
def test_other_origins_may_not_command(guard: Guard, host: str, origin: str | None) -> None:
    assert len(guard.refusal(host, origin, command=True)) > 15


@given(st.text(), st.text() | st.none())
def test_any_other_host_is_refused_with_a_message(host: str, origin: str | None) -> None:
    assert LOCAL.refusal(host, origin, command=True)


def test_the_token_is_in_the_url_fragment_that_browsers_do_not_send() -> None:
    assert urls("localhost", 8010, "") == ["http://localhost:8010/"]
    assert urls("::1", 80, "") == ["http://[::1]:80/"]
    assert urls("192.168.1.5", 8010, "abc") == ["http://192.168.1.5:8010/#token=abc"]
    assert all(url.endswith(":8010/#token=abc") for url in urls("0.0.0.0", 8010, "abc"))


@given(st.text(st.characters(codec="utf-8"), min_size=1))
def test_the_page_reads_the_same_token_from_the_url(token: str) -> None:
    (url,) = urls("localhost", 8010, token)
    assert url.isascii() and url.isprintable() and " " not in url
    fields = parse_qs(urlsplit(url).fragment, strict_parsing=True)  # as URLSearchParams in page.js
    assert fields == {"token": [token]}


# ---- the goal preview on the image

TRIANGLE = np.array([(0.04, -0.02), (0.0, 0.05), (-0.04, -0.02)])
CAMERA = CameraModel(1280, 1024, 1150.0, 1140.0, 630.0, 520.0, (-0.12, 0.08, 0.0004, -0.0003, 0.0))


def ghost(spin: float = 0.1) -> Ghost:
    view = View(CAMERA, CameraPose.above((0.05, -0.08, 0.7), (0.01, 0.0), spin))
    return Ghost(view, TRIANGLE, 0.012, lambda pose: "too far" if pose.x > 0.2 else "")


places = st.builds(
    Pose, st.floats(-0.25, 0.25), st.floats(-0.18, 0.18), st.floats(-math.pi, math.pi)
)


@given(places)
def test_a_ghost_projected_to_the_image_and_back_keeps_its_pose(pose: Pose) -> None:
    made = ghost()
    seen = made.answer(Place(1, pose))
    (u, v), (hu, hv) = seen["centre"], seen["handle"]
    moved = made.pose(Move(2, u, v, pose.theta))
    assert moved.distance_to(pose) < 2e-5  # image coordinates are rounded to 1e-5 of the image size
    turned = made.pose(Turn(3, pose.x, pose.y, hu, hv))
    assert abs(turned.rotation_to(pose)) < 5e-4
    assert seen["refusal"] == ("too far" if pose.x > 0.2 else "")
    assert len(seen["outline"]) == len(TRIANGLE)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-1e4, 1e4))
def test_any_pixel_or_pose_gives_numbers_or_an_error_message(a: float, b: float, c: float) -> None:
    made = ghost()
    for request in (Move(1, a, b, c), Turn(1, a, b, c, a), Place(1, Pose(a, b, c))):
        try:
            json.dumps(made.answer(request), allow_nan=False)
        except BadRequest as refused:
            assert "not on the table" in str(refused)


@pytest.mark.parametrize(
    ("turns", "right"), [(0, 0), (1, 90), (2, 180), (3, -90)], ids=["0", "90", "180", "270"]
)
def test_the_arrow_keys_follow_the_image_axes(turns: int, right: int) -> None:
    made = ghost(spin=turns * math.pi / 2 + 0.1)
    before = made.answer(Place(1, Pose(0.0, 0.0, 0.0)))
    way = math.radians(before["right"])
    after = made.answer(Place(2, Pose(0.02 * math.cos(way), 0.02 * math.sin(way), 0.0)))
    du, dv = np.subtract(after["centre"], before["centre"])
    assert du > 0.01 and abs(dv) < du
    assert before["right"] == right


@given(
    places,
    st.floats(0.0005, 0.01),
    st.floats(0.0005, 0.01),
    st.floats(-math.pi, math.pi),
    st.integers(0, 2**32 - 1),
)
def test_the_ellipse_holds_95_of_100_results(predicted, along, across, turn, seed):
    """Compare the drawn ellipse with random samples of the result, each of which is projected into
    the camera's image."""
    made = ghost()
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = axes @ np.diag([along**2, across**2]) @ axes.T
    drawing = made.planned(Pose(0, 0, 0), Pose(0, 0, 0), predicted, covariance)
    draws = np.random.default_rng(seed).multivariate_normal(predicted[:2], covariance, 4000)
    seen = np.array(made._seen(draws), dtype=np.float32)
    edge = np.array(drawing["ellipse"], dtype=np.float32)[:, None, :]
    inside = [cv2.pointPolygonTest(edge, point.tolist(), False) > 0 for point in seen]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_the_arrow_points_along_the_striker_and_ends_at_its_ball() -> None:
    made = ghost()
    strike = Pose(0.05, 0.02, math.radians(90))
    drawing = made.planned(Pose(0, 0, 0), strike, Pose(0.05, 0.1, 0), np.eye(2) * 1e-6)
    (u0, v0), (u1, v1) = drawing["arrow"]
    ends = [made.pose(Move(1, u, v, 0.0)) for u, v in ((u0, v0), (u1, v1))]
    assert ends[0].x == pytest.approx(0.05, abs=1e-4) and ends[1].x == pytest.approx(0.05, abs=1e-4)
    assert ends[0].y < 0.02 < ends[1].y < 0.04
