"""Tune a small policy in the simulated cell, and compare it with the planning method `optimal`.

The policy has three parameters: which share of the largest possible rotation counts as reachable
by a single tap; if the rotation is not reachable, how far a first tap passes the goal; and which
share of the rotation this tap makes. The cross-entropy method tunes them: every episode of a
generation has other parameters, and the best quarter gives the next generation.

    python examples/learn_to_tap.py --generations 12 --trials 500
"""

import argparse
from functools import partial

import gymnasium
import numpy as np

from tapping_cell.planning import make_planner
from tapping_cell.se2 import difference
from tapping_cell.tapping_env import TappingEnv

SETTINGS = TappingEnv().settings
POPULATION = 16
GOAL = {"goal": (0.010, 0.0, np.radians(10.0))}  # the task of the paper


def tuned(parameters, distance, rotation):
    """Return distance and rotation of the next tap for remaining errors (n,); parameters (n, 3)."""
    share, past, first = np.clip(parameters, [0.3, 0.5, 0.3], [1.0, 3.0, 1.0]).T
    slope, turn = SETTINGS.cone_slope, np.abs(rotation)
    beyond = past * np.maximum(turn / slope - distance, 0.0) / 2.0
    beyond = np.maximum(beyond, SETTINGS.smallest_distance)
    direct = turn <= share * slope * distance
    along = np.where(direct, distance, distance + beyond)
    most = np.where(direct, 1.0, first) * slope * along
    return along, np.copysign(np.minimum(turn, most), rotation)


def episodes(vector, choose, count, seed):
    """Return the number of taps of ``count`` episodes of the published task in each environment,
    and the share of them that ended truly inside the tolerance."""
    taps, inside = np.zeros((count, vector.num_envs)), []
    for episode in range(count):
        observed, _ = vector.reset(seed=seed + episode * vector.num_envs, options=GOAL)
        running = np.ones(vector.num_envs, dtype=bool)
        while running.any():
            left = difference(observed[:, :3], observed[:, 3:])
            heading = np.arctan2(left[:, 1], left[:, 0])
            along, turn = choose(np.hypot(left[:, 0], left[:, 1]), left[:, 2])
            action = np.stack([along * np.cos(heading), along * np.sin(heading), turn], axis=-1)
            observed, _, ended, cut, info = vector.step(action)
            taps[episode] += running
            inside += info["inside"][running & ended].tolist()
            running &= ~(ended | cut)
    return taps, sum(inside) / taps.size


def main():
    """Tune, then measure both on the same fresh episodes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--generations", type=int, default=12)
    parser.add_argument("--trials", type=int, default=500)
    arguments = parser.parse_args()
    vector = gymnasium.make_vec("tapping_cell.tapping_env:Tapping-v0", num_envs=POPULATION)
    random, mean, spread = np.random.default_rng(0), np.array([0.8, 1.3, 0.8]), np.full(3, 0.25)
    for generation in range(arguments.generations):
        drawn = mean + spread * random.standard_normal((POPULATION, 3))
        taps, _ = episodes(vector, partial(tuned, drawn), 5, 1000 * generation)
        best = drawn[np.argsort(taps.mean(axis=0))[: POPULATION // 4]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.02
    print("parameters", np.round(mean, 3))
    optimal = make_planner("optimal", SETTINGS)
    methods = {"tuned": partial(tuned, mean[None]), "optimal": optimal.choose}
    for name, choose in methods.items():
        taps, inside = episodes(vector, choose, -(-arguments.trials // POPULATION), 10**6)
        error = 1.96 * taps.std() / np.sqrt(taps.size)
        print(f"{name}: {taps.mean():.2f} +- {error:.2f} taps, {100 * inside:.1f} % truly inside")
    vector.close()


if __name__ == "__main__":
    main()
