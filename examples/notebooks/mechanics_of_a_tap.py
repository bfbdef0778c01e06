# %% [markdown]
# # Mechanics of a tap
#
# A striker hits a flat object, and the object slides until friction stops it. This notebook
# follows one tap from the strike to rest, and shows which displacements a tap can cause. All
# values are in SI units and radians. The equations are in docs/mechanics.md.

# %%
import math

import matplotlib.pyplot as plt
import numpy as np

from tapping_cell.configuration.assembly import make_tap
from tapping_cell.configuration.cell import load_cell
from tapping_cell.mechanics import Sliding

tap = make_tap(load_cell())  # the aluminium disk of the paper, and the cell's striker
print(f"radius {1e3 * tap.body.bounding_radius:.0f} mm, friction {tap.sliding.friction}")

# %% [markdown]
# ## The slide
#
# After the impact the object moves at a speed and rotates at a spin. Friction slows both, and
# both vanish at the same time; with this torque factor the spin fades faster. `launch` is the
# inverse problem: which speed and spin give a displacement?

# %%
wanted = 0.010, math.radians(3.0)
speed, spin = (float(value) for value in tap.sliding.launch(*wanted))
rest = tap.sliding.rest(speed, spin)
time = np.linspace(0.0, float(rest.duration), 200)
profile = tap.sliding.profile(speed, spin, time)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.plot(1e3 * time, 1e3 * profile.speed)
left.set(xlabel="time (ms)", ylabel="speed (mm/s)")
right.plot(1e3 * time, np.degrees(profile.spin), color="C1")
right.set(xlabel="time (ms)", ylabel="spin (degrees/s)")
plt.show()

# %% [markdown]
# ## The strike
#
# `plan` finds the contact and the striker for a displacement, and `outcome` computes what this
# strike causes: the same displacement. If the striker is 1 mm beside its place, the
# displacement differs.

# %%
displacement = np.array([0.010, 0.0, math.radians(3.0)])
plan = tap.plan(displacement)
moved = tap.outcome(np.zeros(3), plan.strike_pose, plan.striker_speed)
assert np.allclose(moved, displacement, atol=1e-9)
x, y, heading = plan.strike_pose
beside = plan.strike_pose + 0.001 * np.array([-math.sin(heading), math.cos(heading), 0.0])
changed = tap.outcome(np.zeros(3), beside, plan.striker_speed)
print(f"striker: {float(plan.striker_speed):.3f} m/s, {math.degrees(plan.incidence):.1f} degrees")
print(f"1 mm beside: {1e3 * changed[0]:.2f} mm, {math.degrees(changed[2]):.2f} degrees")

figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
outline = 1e3 * tap.body.boundary(np.linspace(-math.pi, math.pi, 100))
axes.plot(*outline.T, "k")
axes.plot(*(outline + 1e3 * displacement[:2]).T, "k--", lw=0.8)
tail = 1e3 * x - 25 * math.cos(heading), 1e3 * y - 25 * math.sin(heading)
axes.annotate("", (1e3 * x, 1e3 * y), tail, arrowprops={"arrowstyle": "->", "color": "C3", "lw": 2})
axes.set(
    aspect="equal",
    xlim=(-90, 70),
    xlabel="x (mm)",
    ylabel="y (mm)",
    title="strike, object before and after",
)
plt.show()

# %% [markdown]
# ## The cone
#
# The friction at the contact limits the direction of the impulse, and so the rotation: one tap
# of the distance d rotates the object by at most k d. The torque factor of the sliding friction
# (3.64 for the paper's disk) makes this cone narrower.

# %%
contacts = np.linspace(-0.035, 0.035, 29)  # offset of the striker's line from the centre, m
poses = np.stack([np.full_like(contacts, -0.08), contacts, np.zeros_like(contacts)], axis=-1)
figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
for striker_speed in np.linspace(0.1, 0.6, 6):
    results = tap.outcome(np.zeros(3), poses, striker_speed)
    distance = 1e3 * np.hypot(results[:, 0], results[:, 1])
    axes.plot(distance, np.degrees(results[:, 2]), ".", color="C0", ms=4)
reach = np.array([0.0, distance.max()])
edge = np.degrees(1e-3 * reach * tap.cone_slope)
axes.fill_between(reach, -edge, edge, color="C0", alpha=0.15, lw=0)
axes.set(xlabel="distance (mm)", ylabel="rotation (degrees)", title="single taps and their cone")
plt.show()
# Straight strikes beside the centre stay inside the cone.
assert np.all(np.abs(results[:, 2]) <= 1e-3 * distance * tap.cone_slope * (1 + 1e-6))

# %%
for factor in (1.0, 2.17, 3.64):
    sliding = Sliding(tap.body, tap.sliding.friction, factor)
    turned = math.degrees(sliding.rest(speed, spin).rotation)
    print(f"torque factor {factor:.2f}: the same launch rotates the object by {turned:.2f} degrees")
