"""Creation of a cell's simulated camera from the simulation parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import ArrayLike

from tapping_cell.configuration.cell import Cell
from tapping_cell.simulation.rendered_camera import SceneObject, SceneRenderer, SceneSettings
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision.camera import CameraModel, CameraPose


def true_camera(calibrated: CameraModel, truth: CameraTruth) -> CameraModel:
    """Return the true camera: the calibrated camera with the lens errors of ``truth``."""
    first, *others = (
        (*calibrated.distortion, 0.0) if not calibrated.distortion else (calibrated.distortion)
    )
    return replace(
        calibrated,
        fx=calibrated.fx * truth.focal_factor,
        fy=calibrated.fy * truth.focal_factor,
        distortion=(first + truth.distortion_offset, *others),
    )


def make_renderer(
    cell: Cell,
    truth: CameraTruth,
    outline: ArrayLike,
    seed: int,
    others: Sequence[SceneObject] = (),
) -> SceneRenderer:
    """Return a renderer of the cell's table, its object and the ``others``, with the true
    parameters."""
    return SceneRenderer(
        camera=true_camera(cell.camera, truth),
        pose=CameraPose.above(truth.position, truth.aim, truth.turn),
        references=cell.references,
        outline=outline,
        marker=cell.object.seen(),
        settings=SceneSettings(
            noise=truth.noise,
            light_falloff=truth.light_falloff,
            rolling=truth.readout / truth.imaging_time,
        ),
        seed=seed,
        others=others,
    )
