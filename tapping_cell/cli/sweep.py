"""Evaluations over a parameter grid: ``evaluate --sweep friction=0.1:0.4:7 tolerance=1,0.3``.

Each point of the grid is one evaluation. The points share the cores of this computer, or the
workers of a Dask cluster (``--cluster``). Completed points are stored in the report's folder, so
that the same command resumes after an interruption. To resume a sweep, the options that all its
points have in common must not change.

Every worker of a cluster must have the same version of this package, and its files (cell, object,
truth) under the same paths. Dask is an optional dependency: ``pip install distributed``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.durable_file import replace_text
from tapping_cell.planning import PlanningError

CONNECTION_DEADLINE = "10s"
POINTS = "points.jsonl"
"""File with one line per point: its values, the common options, and its results."""
Value = float | str
Point = dict[str, Value]


def _both(name: str) -> Callable[[argparse.Namespace, Value], None]:
    """Return a function that sets both numbers of an option (such as mm and degrees) to one
    value."""
    return lambda arguments, value: setattr(arguments, name, (value, value))


def _entry(name: str, index: int) -> Callable[[argparse.Namespace, Value], None]:
    def put(arguments: argparse.Namespace, value: Value) -> None:
        before = list(getattr(arguments, name))
        before[index] = value
        setattr(arguments, name, tuple(before))

    return put


def _plain(name: str) -> Callable[[argparse.Namespace, Value], None]:
    return lambda arguments, value: setattr(arguments, name, value)


PARAMETERS: dict[str, Callable[[argparse.Namespace, Value], None]] = {
    "planner": _plain("planner"),
    "friction": _plain("true_friction"),
    "tolerance": _both("tolerance"),
    "distance-scatter": _entry("scatter", 0),
    "rotation-scatter": _entry("scatter", 1),
    "direction-scatter": _entry("scatter", 2),
    "position-floor": _entry("scatter_floor", 0),
    "angle-floor": _entry("scatter_floor", 1),
    "camera-noise": _both("camera_noise"),
    "camera-position-noise": _entry("camera_noise", 0),
    "camera-angle-noise": _entry("camera_noise", 1),
    "distance-bias": _entry("gain_bias", 0),
    "rotation-bias": _entry("gain_bias", 1),
    "round-position": _plain("round_position"),
    "round-angle": _plain("round_angle"),
    "box": _plain("box"),
}
"""For each parameter of a sweep, the function that sets it in the options of ``evaluate``. A value
has the unit of its option. ``friction`` is the true coefficient."""


def read_axis(text: str) -> tuple[str, tuple[Value, ...]]:
    """Parse name and values from ``name=first:last:count`` or ``name=value,value``.

    Raises:
        PlanningError: the parameter does not exist, or its values are invalid.
    """
    name, _, given = text.partition("=")
    if name not in PARAMETERS:
        raise PlanningError(
            f"'{name}' cannot be swept; choose from {', '.join(sorted(PARAMETERS))}"
        )
    if name == "planner":
        names = tuple(part for part in given.split(",") if part)
        if not names:
            raise PlanningError("planner= names no method; give for example planner=optimal,exact")
        return name, names
    try:
        if ":" in given:
            first, last, count = given.split(":")
            values = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            values = [float(part) for part in given.split(",")]
    except ValueError:
        values = []
    if not values or not all(map(math.isfinite, values)):
        raise PlanningError(
            f"'{text}' gives no values; write {name}=first:last:count or {name}=value,value"
        )
    return name, tuple(float(f"{value:.10g}") for value in values)


def read_axes(texts: Sequence[str]) -> dict[str, tuple[Value, ...]]:
    """Parse the axes of a sweep. Raises PlanningError if an axis is named twice."""
    axes: dict[str, tuple[Value, ...]] = {}
    for text in texts:
        name, values = read_axis(text)
        if name in axes:
            raise PlanningError(f"{name} is swept twice; give all its values in one list")
        axes[name] = values
    return axes


def grid(axes: dict[str, tuple[Value, ...]]) -> Iterator[Point]:
    """Yield every combination of the values; the last axis varies fastest."""
    for values in itertools.product(*axes.values()):
        yield dict(zip(axes, values, strict=True))


def arguments_at(arguments: argparse.Namespace, point: Point) -> argparse.Namespace:
    """Return the options of one point."""
    chosen = argparse.Namespace(**vars(arguments))
    for name, value in point.items():
        PARAMETERS[name](chosen, value)
    return chosen


class KeptPoints:
    """Completed points of a sweep on disk. ``common``: the common options of the points.

    Raises:
        PlanningError: the folder contains another sweep.
    """

    def __init__(self, folder: Path, common: dict[str, Any]) -> None:
        self._file = folder / POINTS
        self._common: dict[str, Any] = json.loads(json.dumps(common))
        self._done: dict[str, dict[str, Any]] = {}
        folder.mkdir(parents=True, exist_ok=True)
        text = self._file.read_text(encoding="utf-8") if self._file.exists() else ""
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            # Remove a line that an interruption left incomplete.
            replace_text(self._file, whole)
        for line in whole.splitlines():
            kept = json.loads(line)
            if kept["common"] != self._common:
                differ = sorted(
                    name
                    for name in {*kept["common"], *self._common}
                    if kept["common"].get(name) != self._common.get(name)
                )
                raise PlanningError(
                    f"{self._file} contains a sweep with other options ({', '.join(differ)});"
                    " choose another folder, or delete this file"
                )
            self._done[_key(kept["point"])] = kept["figures"]

    def get(self, point: Point) -> dict[str, Any] | None:
        """Return the results of a completed point."""
        return self._done.get(_key(point))

    def keep(self, point: Point, figures: dict[str, Any]) -> None:
        """Store a point on disk, so that an interruption does not lose it."""
        self._done[_key(point)] = figures
        line = json.dumps({"point": point, "common": self._common, "figures": figures})
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
            stream.flush()
            os.fsync(stream.fileno())


def _key(point: Point) -> str:
    return json.dumps(point, sort_keys=True)


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """Connect to the scheduler at ``address`` (``tcp://host:8786`` or ``host:8786``).

    Raises:
        PlanningError: Dask is not installed, or no scheduler with a worker answers at ``address``.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise PlanningError(
            f"--cluster {address} needs Dask, which is not installed; pip install distributed"
        ) from error
    try:
        client = Client(address, timeout=CONNECTION_DEADLINE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise PlanningError(
            f"no Dask scheduler answers at {address} ({error}); start one with 'dask scheduler' "
            "and give the address that it prints"
        ) from error
    with client:
        if not client.nthreads():
            raise PlanningError(
                f"the Dask scheduler at {address} has no worker; start one on each computer with "
                f"'dask worker {address}'"
            )
        with client.get_executor() as executor:
            yield executor


def sweep(
    points: Sequence[Point],
    kept: KeptPoints,
    measure: Callable[[Point], dict[str, Any]],
    processes: int | None,
    note: Callable[[int], None],
    cluster: AbstractContextManager[Executor] | None = None,
) -> list[tuple[Point, dict[str, Any]]]:
    """Return the results of every point. Stored points are not evaluated again.

    Args:
        points: points in the order of the result.
        kept: storage of completed points.
        measure: function that returns the results of a point; must be picklable.
        processes: number of processes; None for one per core.
        note: callback with the number of points just completed.
        cluster: executor on other computers; None to use this computer.
    """
    missing = [point for point in points if kept.get(point) is None]
    note(len(points) - len(missing))
    workers = min(processes or os.cpu_count() or 1, len(missing))
    if cluster is not None and missing:
        with cluster as pool:
            _measure_together(missing, kept, measure, pool, note)
    elif workers <= 1:
        for point in missing:
            kept.keep(point, measure(point))
            note(1)
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            _measure_together(missing, kept, measure, pool, note)
    rows = []
    for point in points:
        figures = kept.get(point)
        assert figures is not None
        rows.append((point, figures))
    return rows


def _measure_together(
    points: Sequence[Point],
    kept: KeptPoints,
    measure: Callable[[Point], dict[str, Any]],
    pool: Executor,
    note: Callable[[int], None],
) -> None:
    running = {pool.submit(measure, point): point for point in points}
    try:
        for done in as_completed(running):
            kept.keep(running[done], done.result())
            note(1)
    except BaseException:
        # After an interruption or a failed point, points that have not started are cancelled.
        for future in running:
            future.cancel()
        raise
