"""Previews of goals: only the newest request of each page is computed, and pages take turns."""

from __future__ import annotations

import threading

from tapping_cell.nodes.page.goal_preview import Previews


def test_a_page_gets_its_newest_request_and_pages_take_turns() -> None:
    served: list[tuple[str, int]] = []
    begun, go, done = threading.Event(), threading.Event(), threading.Event()

    def serve(asked: tuple[str, int]) -> None:
        begun.set()
        assert go.wait(10.0)
        served.append(asked)
        if asked[0] == "last":
            done.set()

    previews = Previews(serve)
    previews.ask("hostile", ("hostile", -1))
    assert begun.wait(10.0)
    for number in range(10_000):
        previews.ask("hostile", ("hostile", number))
        if number == 5:
            previews.ask("quiet", ("quiet", 0))
    previews.ask("last", ("last", 0))
    go.set()
    assert done.wait(10.0)
    previews.close()
    assert served == [("hostile", -1), ("hostile", 9_999), ("quiet", 0), ("last", 0)]


def test_a_preview_that_fails_does_not_end_the_others() -> None:
    done = threading.Event()

    def serve(asked: int) -> None:
        if asked == 0:
            raise ArithmeticError("planted")
        done.set()

    previews = Previews(serve)
    previews.ask("a", 0)
    previews.ask("b", 1)
    assert done.wait(10.0)
    previews.close()
