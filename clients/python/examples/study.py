"""A study of 1000 tissues: how deep does a force dent each, and how does that depend on its springs?

    python study.py                1000 scenes, all processors
    python study.py 50 --threads 1
"""

import argparse
import time

import numpy as np

import palpate

SCRIPT = """
duration_s = 0.3
sample_every_s = 0.3
sample_points = [[15, 15]]

[[force]]
point = [15, 15]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
"""

parser = argparse.ArgumentParser()
parser.add_argument("scenes", type=int, nargs="?", default=1000)
parser.add_argument("--threads", type=int)
arguments = parser.parse_args()

random = np.random.default_rng(1)
springs = 10 ** random.uniform(0, 2, arguments.scenes)  # k, N/m
virtual = 10 ** random.uniform(0.5, 1.5, arguments.scenes)  # K″, N/m



def scene(k, k2, plan=None):
    settings = {"springs.stiffness_n_per_m": k, "anchor_springs.stiffness_n_per_m": k2}
    return palpate.Scene("paper", set=settings, plan=plan)


begun = time.perf_counter()
# What is fine enough for the stiffest tissue is so for all: the search for it is done once.
plan = palpate.Tissue(scene(springs.max(), virtual.max()))
cases = [(scene(k, k2, plan), SCRIPT) for k, k2 in zip(springs, virtual)]
runs = palpate.study(cases, held=True, threads=arguments.threads)
took_s = time.perf_counter() - begun
# Is it? Some of them again, in f64 with a quarter of the substep beside.
errors = [palpate.run(*case, audit=True).summary["audited_error"]["displacement"] for case in cases[:5]]

depth_m = np.array([-run.point((15, 15))["displacement_m"][-1, 2] for run in runs])
# depth ≈ a · k^b · K″^c
logs = np.column_stack([np.ones_like(springs), np.log(springs), np.log(virtual)])
a, b, c = np.linalg.lstsq(logs, np.log(depth_m), rcond=None)[0]
print(f"{len(runs)} tissues in {took_s:.2f} s: {1e3 * took_s / len(runs):.2f} ms each")
print(f"largest error of displacement of {len(errors)} that were audited: {max(errors):.1e}")
print(f"depth from {1e3 * depth_m.min():.1f} to {1e3 * depth_m.max():.1f} mm, about {1e3 * np.exp(a):.0f} mm * k^{b:.2f} * K''^{c:.2f}")
