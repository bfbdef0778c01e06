"""Recording for `calibrate tapper` with the running cell: taps of different energies."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import read_csv
from tapping_cell.calibration.design import judged
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.growing_csv import GrowingCsv
from tapping_cell.calibration.tapper import RECORD_COLUMNS, SHARES, launch_ratio
from tapping_cell.calibration.trials import Trial, completed
from tapping_cell.cli import session
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.tap_feasibility import TapFeasibility
from tapping_cell.cli.tap_maker import SeriesStopped, TapMaker, trial_of
from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.nodes.clients.single_tap_client import NoAnswer, SingleTapClient

HEADER = ("energy", "distance", "rotation", "incidence", "distance_std")
LONGEST = 0.090
"""Maximum travel in m of the largest tap. The object file defines the travel of the smallest
tap."""
_STEP = 0.93
"""Factor by which the speed of the largest tap is multiplied repeatedly until this tap has enough
clearance on the table."""
_USELESS = 4
"""Number of consecutive unusable taps after which the recording is aborted."""
READY_TIMEOUT_S = 60.0
RATE_WINDOW_S = 1.0
_ALIKE = 0.02


def record(arguments: argparse.Namespace, cell: Cell, console: Console) -> bool:
    """Record taps until the requested number is reached. Return False if interrupted.

    Raises:
        CalibrationRefused: the cell or the object is unsuitable; the message states why.
        RecordError: the existing file cannot be continued.
    """
    end_on_signals()
    energies = energies_of(cell)
    growing = GrowingCsv(arguments.record, HEADER, arguments.resume)
    done = _recorded(growing, arguments.record)
    left = list(order(energies, arguments.taps, done))
    console.print(
        f"{len(left)} taps of {1e3 * energies[0]:.3g} to {1e3 * energies[-1]:.3g} mJ near the "
        "middle of the table; Ctrl-C stops the recording"
    )
    try:
        with SingleTapClient("calibrate_tapper", arguments.namespace) as client:
            session.wait_until_ready(client, READY_TIMEOUT_S, lambda: None, console)
            _make(cell, client, left, growing, console)
    except KeyboardInterrupt:
        console.print("interrupted; continue with --resume")
        return False
    except (SeriesStopped, NoAnswer, session.NotReadyInTime) as error:
        raise CalibrationRefused(f"{error}; continue with --resume") from error
    return True


def energies_of(cell: Cell) -> list[float]:
    """Return the energies of the taps in J, evenly spaced on a logarithmic scale. The lowest energy
    is that of the object's smallest tap. The highest energy is that of the largest tap with enough
    clearance.

    Raises:
        CalibrationRefused: there is not enough clearance, or the tapper's range is too narrow.
    """
    tap, curve, feasibility = (
        assembly.make_tap(cell),
        cell.file.tapper.curve(),
        TapFeasibility(cell),
    )
    still = np.zeros(2)
    launch = tap.sliding.launch(np.array([cell.object.smallest_tap, LONGEST]), still).speed
    ratio = float(launch_ratio(tap.impact, np.zeros(1))[0])
    slowest, fastest = (
        min(max(speed / ratio, curve.slowest), curve.fastest)
        for speed in np.atleast_1d(launch).tolist()
    )
    while problem := feasibility.problem(fastest, 0.0):
        fastest *= _STEP
        if fastest < 1.5 * slowest:
            raise CalibrationRefused(f"no series of taps fits on the table: {problem}")
    low, high = curve.energy_for(slowest), curve.energy_for(fastest)
    # The energies are slightly inside the range, so that rounding errors cannot make a speed exceed
    # the tapper's limits.
    return [float(e) for e in np.geomspace(low * (1 + 1e-9), high * (1 - 1e-9), len(SHARES))]


def order(energies: list[float], taps: int, done: list[float]) -> Iterator[float]:
    """Yield the energies of the taps that are missing from a series of ``taps`` taps. ``done``: the
    energies of the recorded taps. The lowest and the highest energy are used most often. The
    energies alternate, so that drift does not distort the curve and an interrupted record covers
    the whole range."""
    wanted = Counter(
        {e: max(1, round(taps * n / sum(SHARES))) for e, n in zip(energies, SHARES, strict=True)}
    )
    for energy in done:
        nearest = min(energies, key=lambda e: abs(math.log(e / energy)))
        if abs(math.log(nearest / energy)) < _ALIKE:
            wanted[nearest] -= 1
    # The taps of each energy are spread evenly over the recording.
    yield from (
        energy
        for _, energy in sorted(
            ((turn + 0.5) / count, energy)
            for energy, count in wanted.items()
            for turn in range(count)
        )
    )


def _make(
    cell: Cell,
    client: SingleTapClient,
    energies: list[float],
    growing: GrowingCsv,
    console: Console,
) -> None:
    session.require_object(client, cell)
    maker = TapMaker(client, lambda: None)
    curve, tap = cell.file.tapper.curve(), assembly.make_tap(cell)
    rate = client.camera_rate(RATE_WINDOW_S, lambda: None)
    header = ExperimentFile(
        format=1,
        made="",
        source="simulated" if client.simulated else "hardware",
        rest_position_std=cell.file.camera.position_noise,
        rest_rotation_std=cell.file.camera.angle_noise,
    )
    made = useless = 0
    for energy in energies:
        while True:
            result = maker.make(curve.speed_for(energy), 0.0, made)
            if result is None:
                continue
            made += 1
            trial = trial_of(client, tap, result.record, rate, result.error_msg)
            expected = math.hypot(result.record.dx, result.record.dy)
            trial = completed(judged(trial, header, expected))
            if trial.outcome in ("ok", "missed"):
                break
            useless += 1
            console.print(f"not recorded: {trial.outcome} ({trial.note})", highlight=False)
            if useless >= _USELESS:
                raise CalibrationRefused(
                    f"{useless} consecutive taps are unusable; cause of the last: {trial.note}"
                )
        useless = 0
        growing.append(_row(energy, trial))
        console.print(
            f"{1e3 * energy:.3g} mJ: {1e3 * trial.displacement:.2f} mm, "
            f"{math.degrees(trial.rotation):+.1f} deg ({1e3 * expected:.1f} mm expected)",
            highlight=False,
        )


def _row(energy: float, trial: Trial) -> tuple[float, ...]:
    incidence = trial.incidence if math.isfinite(trial.incidence) else 0.0
    return (energy, trial.displacement, trial.rotation, incidence, trial.displacement_std)


def _recorded(growing: GrowingCsv, path: Path) -> list[float]:
    """Return the energies of the taps that are already recorded."""
    if not growing.rows:
        return []
    return [float(energy) for energy in read_csv(path, RECORD_COLUMNS).values["energy"]]
