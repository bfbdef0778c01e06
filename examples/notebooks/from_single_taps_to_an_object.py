# %% [markdown]
# # From single taps to a fitted object
#
# Friction, torque factor and impact of an object follow from single taps: strike the object at
# a few speeds and angles, measure how far it slides and rotates, and fit the model. Here the
# simulated world makes the taps, with parameters that the fit does not know. On a cell,
# `single-tap` records them, and `object fit` does the rest (docs/objects.md).

# %%
import math
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.object_file import with_estimates
from tapping_cell.calibration.object_fit import fit_object
from tapping_cell.cli.simulated_single_taps import Design, simulated_experiment
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.simulation.truth import ScatterTruth, TruthFile

known = load_object(shared_folder() / "objects" / "aluminium_disk.yaml")
secret = replace(known, friction=0.22, torque_factor=2.8)  # what the object really is
striker = StrikerSection(mass=0.1, tip_radius=0.0054, constraint="free")
truth = TruthFile((0.0, 0.0, 0.0), scatter=ScatterTruth(speed=0.03, spin=0.05, direction=0.01))

# %% [markdown]
# ## The experiment
#
# Four runs of ten taps: two angles of incidence, two speeds. A track of each slide at 30 images
# a second gives the velocities after the impact.

# %%
experiment = simulated_experiment(secret, striker, truth, Design(), seed=1)
trials = experiment.trials
figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for run in sorted({trial.run for trial in trials}):
    own = [trial for trial in trials if trial.run == run]
    axes.plot(
        [1e3 * trial.displacement for trial in own],
        [math.degrees(abs(trial.rotation)) for trial in own],
        "o",
        label=f"{own[0].striker_speed:.2f} m/s, {math.degrees(abs(own[0].incidence)):.0f} degrees",
    )
axes.set(xlabel="distance (mm)", ylabel="rotation (degrees)", title="measured taps of each run")
axes.legend()
plt.show()

# %% [markdown]
# ## The fit
#
# The fit starts from the object file and gives each value with its 95 % interval.

# %%
fit = fit_object([experiment], known)
for entry in fit.estimates[:4]:
    interval = f"{entry.low:.3f} to {entry.high:.3f}"
    print(f"{entry.name:<16} {entry.old:.3f} -> {entry.value:.3f} ({interval})")
estimates = {entry.name: entry for entry in fit.estimates}
assert abs(estimates["friction"].value / secret.friction - 1) < 0.03
assert abs(estimates["torque_factor"].value / secret.torque_factor - 1) < 0.06

# %% [markdown]
# ## Does the model explain the taps?
#
# Left: the displacement that the fitted slide predicts from the measured velocities. Right: the
# prediction from the strike alone. The scatter of the impact shows only on the right.

# %%
figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, predicted, title in zip(
    panels, (fit.by_sliding, fit.by_tapping), ("slide", "impact and slide"), strict=True
):
    axes.plot(1e3 * fit.measured.distance, 1e3 * predicted.distance, "o", label="distance (mm)")
    axes.plot(
        np.degrees(np.abs(fit.measured.rotation)),
        np.degrees(np.abs(predicted.rotation)),
        "s",
        label="rotation (degrees)",
    )
    axes.axline((0.0, 0.0), slope=1.0, color="k", lw=0.8)
    axes.set(xlabel="measured", ylabel="predicted", title=title)
    axes.legend()
plt.show()

# %% [markdown]
# ## What the planner gains
#
# With the old values, a planned tap of 10 mm ends short, because the true friction is higher.

# %%
fitted = with_estimates(known, fit.estimates)
table = secret.tap(striker.striker())
for name, content in (("old file", known), ("fitted file", fitted)):
    plan = content.tap(striker.striker()).plan((0.010, 0.0, math.radians(2.0)))
    moved = table.outcome((0.0, 0.0, 0.0), plan.strike_pose, plan.striker_speed)
    print(f"{name}: {1e3 * moved[0]:.2f} mm, {math.degrees(moved[2]):.2f} degrees")
assert abs(moved[0] - 0.010) < 0.0005
