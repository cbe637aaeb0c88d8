"""The study of examples/study.py in Palpate, numba and NumPy: the time of each, and its largest error.

    python study.py [SCENES]       needs palpate and numpy; numba is left out if it is not installed

1000 sheets of 31 × 31 points with springs and anchor springs of their own, pushed for 0.3 s. The peers are written as an expert
would: central differences with implicit damping, steps of 1 ms, f32; NumPy takes many sheets at once, numba one on each
processor. Palpate is measured with the same scheme, and within 1e-5: with a plan of its own for each sheet, which takes a search,
and with the plan of the stiffest for all. Errors are those of the depth at the end,
relative to the largest, against Palpate with a tolerance of 1e-7.
"""

import os
import sys
import time

import numpy as np

import palpate

SCENES = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
SIDE, STEPS, H, MASS_KG, DAMPING = 31, 300, 1 / 30, 0.01, 0.5
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
g = DAMPING * 1e-3 / MASS_KG
P = np.float32((1 - g / 2) / (1 + g / 2))
Q = np.float32(1e-6 / MASS_KG / (1 + g / 2))
OFFSETS = [(0, 1), (1, 0), (1, 1), (1, -1)]

random = np.random.default_rng(1)
springs = (10 ** random.uniform(0, 2, SCENES)).astype(np.float32)
virtual = (10 ** random.uniform(0.5, 1.5, SCENES)).astype(np.float32)
i, j = np.mgrid[:SIDE, :SIDE]
push = (-np.exp(-150 * H * np.hypot(i - 15, j - 15))).astype(np.float32)


def in_palpate(one_plan=False, **settings):
    def scene(k, k2, plan=None):
        own = {"springs.stiffness_n_per_m": float(k), "anchor_springs.stiffness_n_per_m": float(k2)}
        return palpate.Scene("paper", set={**own, **settings}, plan=plan)

    def study():
        plan = palpate.Tissue(scene(springs.max(), virtual.max())) if one_plan else None
        scenes = [scene(k, k2, plan) for k, k2 in zip(springs, virtual)]
        runs = palpate.study([(scene, SCRIPT) for scene in scenes], held=True)
        return np.array([-run.point((15, 15))["displacement_m"][-1, 2] for run in runs])

    return study


def spans(shift):
    here = slice(max(0, -shift), SIDE - max(0, shift))
    return here, slice(here.start + shift, here.stop + shift)


def in_numpy(at_once=16):
    def study():
        depths = []
        for first in range(0, SCENES, at_once):
            k = springs[first : first + at_once, None, None]
            k2 = virtual[first : first + at_once, None, None, None]
            u = np.zeros((k.shape[0], 3, SIDE, SIDE), np.float32)
            d = np.zeros_like(u)
            for _ in range(STEPS):
                force = -k2 * u
                force[:, 2] += push
                for di, dj in OFFSETS:
                    (hi, ti), (hj, tj) = spans(di), spans(dj)
                    apart = u[:, :, ti, tj] - u[:, :, hi, hj]
                    apart += np.array([di, dj, 0], np.float32).reshape(3, 1, 1) * np.float32(H)
                    length = np.sqrt((apart * apart).sum(axis=1))
                    pull = apart * (k * (1 - np.float32(H * np.hypot(di, dj)) / length))[:, None]
                    force[:, :, hi, hj] += pull
                    force[:, :, ti, tj] -= pull
                d *= P
                force *= Q
                d += force
                u += d
            depths.append(-u[:, 2, 15, 15])
        return np.concatenate(depths)

    return study


def in_numba():
    import numba

    h = np.float32(H)
    neighbours = np.array([(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)])
    lengths = (H * np.hypot(neighbours[:, 0], neighbours[:, 1])).astype(np.float32)
    one = np.float32(1)

    @numba.njit(parallel=True, fastmath=True, error_model="numpy")
    def study(springs, virtual, push):
        depths = np.zeros(springs.size, np.float32)
        for scene in numba.prange(springs.size):
            k, k2 = springs[scene], virtual[scene]
            # A rim of points that no spring reaches: no point needs a branch.
            u = np.zeros((3, SIDE + 2, SIDE + 2), np.float32)
            d = np.zeros((3, SIDE, SIDE), np.float32)
            is_there = np.zeros((SIDE + 2, SIDE + 2), np.float32)
            is_there[1 : SIDE + 1, 1 : SIDE + 1] = one
            fx, fy, fz = np.zeros((3, SIDE), np.float32)
            for _ in range(STEPS):
                for i in range(SIDE):
                    x, y, z = u[0, i + 1, 1:-1], u[1, i + 1, 1:-1], u[2, i + 1, 1:-1]
                    down = push[i]
                    for j in range(SIDE):
                        fx[j], fy[j], fz[j] = -k2 * x[j], -k2 * y[j], down[j] - k2 * z[j]
                    for n in range(8):
                        a, b = neighbours[n]
                        row, first = i + 1 + a, 1 + b
                        xs, ys, zs = u[0, row, first:], u[1, row, first:], u[2, row, first:]
                        there = is_there[row, first:]
                        x0, y0, rest = np.float32(a * h), np.float32(b * h), lengths[n]
                        for j in range(SIDE):
                            ax, ay, az = xs[j] - x[j] + x0, ys[j] - y[j] + y0, zs[j] - z[j]
                            pull = there[j] * k * (one - rest / np.sqrt(ax * ax + ay * ay + az * az))
                            fx[j] += pull * ax
                            fy[j] += pull * ay
                            fz[j] += pull * az
                    dx, dy, dz = d[0, i], d[1, i], d[2, i]
                    for j in range(SIDE):
                        dx[j] = P * dx[j] + Q * fx[j]
                        dy[j] = P * dy[j] + Q * fy[j]
                        dz[j] = P * dz[j] + Q * fz[j]
                for c in range(3):
                    for i in range(SIDE):
                        for j in range(SIDE):
                            u[c, i + 1, j + 1] += d[c, i, j]
            depths[scene] = -u[2, 16, 16]
        return depths

    study(springs[:2], virtual[:2], push)  # compiles
    return lambda: study(springs, virtual, push)


SAME = {"stepping.integrator": "central", "stepping.substeps": 1, "stepping.precision": "f32"}
rows = [
    ("Palpate, a plan for each", in_palpate),
    ("Palpate, the stiffest's plan", lambda: in_palpate(one_plan=True)),
    ("Palpate, central, 1 ms, f32", lambda: in_palpate(one_plan=True, **SAME)),
    ("numba, central, 1 ms, f32", in_numba),
    ("NumPy, central, 1 ms, f32", in_numpy),
]
truth = in_palpate(**{"stepping.tolerance": 1e-7})()
print(f"{SCENES} sheets of {SIDE} x {SIDE} points, {STEPS} steps, {os.cpu_count()} processors")
print(f"{'':34}{'time, s':>9}{'ms each':>9}{'error':>10}")
for name, make in rows:
    try:
        study = make()
    except ImportError as error:
        print(f"{name:34} left out: {error}")
        continue
    took_s = []
    for _ in range(2):
        begun = time.perf_counter()
        depth_m = study()
        took_s.append(time.perf_counter() - begun)
    error = np.abs(depth_m - truth).max() / truth.max()
    print(f"{name:34}{min(took_s):9.2f}{1e3 * min(took_s) / SCENES:9.2f}{error:10.1e}")
