"""Error messages and warnings about the table."""

from __future__ import annotations

from tapping_cell.vision.observation import Problem
from tapping_cell.vision.table.tracker import TableState, TableTracker


def table_refusal(
    state: TableState, table: TableTracker, unseen: float, timeout: float
) -> tuple[Problem, str] | None:
    """Return why a frame with the table in ``state`` gives no pose; None if a pose may be measured.

    ``unseen`` is the time (s) since reference markers were last measured, and ``timeout`` its
    limit.
    """
    s = table.settings
    if state is TableState.UNKNOWN:
        if table.measured >= s.least_references:
            return (
                Problem.TABLE_UNKNOWN,
                f"{table.measured} reference markers are seen, but no camera above the table can "
                "see them like this; check x and y in the table file (exchanged coordinates or a "
                "wrong sign mirror the table)",
            )
        return (
            Problem.TABLE_UNKNOWN,
            f"fewer than {s.least_references} of the reference markers {table.ids.tolist()} are "
            "seen; uncover them, check ids and dictionary in the table file, and turn off "
            "mirroring in the camera",
        )
    if state is TableState.CONTRADICTED:
        return Problem.TABLE_CONTRADICTED, _contradiction(table)
    if state is TableState.SUSPECT:
        return (
            Problem.CAMERA_MOVED,
            "the reference markers have changed their positions: the camera or the table is moving",
        )
    if state is TableState.TOO_FAR:
        return (
            Problem.CAMERA_MOVED_TOO_FAR,
            f"the camera or the table has moved by more than {s.largest_move * 1e3:.0f} mm since "
            "the start; check the mounting and configure again",
        )
    if unseen > timeout:
        return (
            Problem.REFERENCES_HIDDEN,
            f"the reference markers have been hidden for {unseen:.1f} s; uncover at least "
            f"{s.least_references} of them",
        )
    return None


def table_notice(displaced: list[int], doubled: list[int], missed: list[int]) -> str:
    """Warning about reference markers for a frame with a valid pose; empty if there is none.

    ``displaced`` are ids of markers that are not at their positions, ``doubled`` of those that are
    seen more than once, and ``missed`` of those that are not seen.
    """
    if displaced:
        names = ", ".join(map(str, displaced))
        if len(displaced) > 1:
            return (
                f"reference markers {names} are not at their positions in the table file; they are "
                "ignored; if none was moved, the file is wrong, or the calibration does not suit "
                "the images (are they rectified?)"
            )
        return f"reference marker {names} is not at its position in the table file; it is ignored"
    if doubled:
        names = ", ".join(map(str, doubled))
        return f"reference marker {names} is seen more than once; cover the other copies"
    names = ", ".join(map(str, sorted(missed)))
    return f"reference marker {names} is not seen; uncover it" if missed else ""


def _contradiction(table: TableTracker) -> str:
    names = ", ".join(map(str, table.used))
    if table.apart:
        return (
            f"the reference markers {names} have changed their relative positions: one of "
            "them was moved; put it back, or measure the table again and configure again"
        )
    # The limits of TableTracker._contradicted.
    limit = (1.0 if len(table.used) <= 2 else 3.0) * table.settings.displaced
    if table.error > limit:
        return (
            f"the reference markers {names} do not match the table file: after the best fit "
            f"they are off by up to {table.error:.1f} pixels (limit {limit:.1f}); check their "
            "positions, angles and sizes in the file and on the table"
        )
    if 2.0 * table.bloom > table.side:  # the fitted length is negative
        return (
            f"the reference markers {names} are turned by 180 degrees against the table file, as "
            "tags are that were printed from AprilTag's own pictures; add 3.14159265 to the theta "
            "of each of them"
        )
    return (
        f"the apparent side length of the reference markers {names} differs by "
        f"{2.0 * table.bloom:+.1f} pixels from that expected from the positions and sizes in the "
        "table file; check the sizes (of the black squares)"
    )
