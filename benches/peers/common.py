"""Shared by the peers: the paper's tissue in numbers, the forces on it, and the timing of a window.

The physics, at every point: structural and shear springs to 8 neighbours, each k (1 - L0/L)(x_b - x_a); a anchor
spring -K u to the rest position; damping -C v; a constant applied force. Central differences with implicit damping:
d <- p d + q F(u), u <- u + d, u from rest, d the increment of the last step. f32, one thread.

Each peer prints, for each size given as an argument, a JSON line: {"peer", "side", "least_ns", "median_ns"}, per point
and step, of many windows of some milliseconds. On meshes, whose files are the arguments, "mesh" is the file in place of
"side".
"""

import json
import statistics
import sys
import time

import numpy as np

SPACING_M = 1 / 30
STIFFNESS_N_PER_M = 10.0  # k, structural and shear
VIRTUAL_N_PER_M = 5.0  # K
DAMPING_N_S_PER_M = 0.5  # C
MASS_KG = 0.01
STEP_S = 1e-3

_g = DAMPING_N_S_PER_M * STEP_S / MASS_KG
P = np.float32((1 - _g / 2) / (1 + _g / 2))
Q = np.float32(STEP_S * STEP_S / MASS_KG / (1 + _g / 2))
K = np.float32(STIFFNESS_N_PER_M)
VIRTUAL = np.float32(VIRTUAL_N_PER_M)
H = np.float32(SPACING_M)

# Offsets of each neighbour: rows and columns.
NEIGHBOURS = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)]


def forces(side):
    """The held pushes of benches/kernel.rs: 0.1 N, falling off within a few points, and a weak one that reaches the rim."""
    middle = side // 2
    i, j = np.mgrid[0:side, 0:side]
    r = SPACING_M * np.hypot(i - middle, j - middle)
    strength = np.exp(-r / (2 * SPACING_M)) + 1e-2 * np.exp(-r / (side * SPACING_M / 4))
    return np.stack([0.03 * strength, 0.0 * strength, -0.1 * strength]).astype(np.float32)


def windows(run, points):
    """The least and the median time a point and step, ns; `run` does so many steps before it returns."""
    run(50)  # compiles, and sets everything in motion
    begin = time.perf_counter()
    run(10)
    # Even, for peers that swap two states.
    steps = 2 * max(1, round(2e-3 / ((time.perf_counter() - begin) / 10)))
    times = []
    end = time.perf_counter() + 1.0
    while len(times) < 5 or time.perf_counter() < end:
        begin = time.perf_counter()
        run(steps)
        times.append((time.perf_counter() - begin) / (steps * points) * 1e9)
    return {"least_ns": min(times), "median_ns": statistics.median(times)}


def measure(peer, make):
    """For each size: `make(side)` returns a function that does some steps, all of them before it returns."""
    for side in [int(argument) for argument in sys.argv[1:]]:
        print(json.dumps({"peer": peer, "side": side, **windows(make(side), side * side)}), flush=True)


class Mesh:
    """A file of benches/mesh.rs, all of it little-endian and of 32 bits: how many vertices and ends of springs there are,
    where each vertex rests, where the springs of each vertex begin, and to which vertex each leads. Lengths are in mean
    edges, times in steps."""

    TURN = np.float32(0.01)  # (K/m) dt²
    PULL = np.float32(0.03)  # (k/m) dt²

    def __init__(self, path):
        data = np.fromfile(path, "<u4")
        count, ends = map(int, data[:2])
        rest, starts, to = np.split(data[2:], [3 * count, 4 * count + 1])
        self.rest = rest.view("<f4").reshape(count, 3)
        self.starts, self.to = starts.astype(np.int32), to.astype(np.int32)
        assert self.to.size == ends

    def spans(self):
        """The vector of each spring at rest, from the vertex that it belongs to."""
        owner = np.repeat(np.arange(len(self.rest)), np.diff(self.starts))
        return self.rest[self.to] - self.rest[owner]

    def displaced(self):
        """Where the motion begins."""
        return np.float32(0.01) * np.sin(self.rest)


def measure_meshes(peer, make):
    """The same for each mesh."""
    for path in sys.argv[1:]:
        mesh = Mesh(path)
        print(json.dumps({"peer": peer, "mesh": path, **windows(make(mesh), len(mesh.rest))}), flush=True)


class Block:
    """The block of benches/solid.rs, 60 × 60 × 30 mm in cubes of `cell_m`, held at its lowest face, from 0: its nodes x fastest,
    the tetrahedra of each cube, and the weights of an even pressure on a disc in the middle of its top."""

    YOUNGS_PA, POISSON, DENSITY, DAMPING_PER_S = 8e3, 0.45, 1060.0, 100.0
    RADIUS_M, FORCE_N = 0.005, 0.02
    SIZE_M = np.array([0.06, 0.06, 0.03])

    def __init__(self, cell_m):
        self.cell_m = cell_m
        self.cells = np.rint(self.SIZE_M / cell_m).astype(int)
        self.lame_pa = self.YOUNGS_PA * self.POISSON / ((1 + self.POISSON) * (1 - 2 * self.POISSON))
        self.shear_pa = self.YOUNGS_PA / (2 * (1 + self.POISSON))
        nx, ny, nz = self.cells + 1
        z, y, x = np.mgrid[0:nz, 0:ny, 0:nx]
        self.places_m = cell_m * np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        # Kuhn's six tetrahedra of each cube: the paths along its edges from one corner to the opposite one.
        strides = [1, nx, nx * ny]
        first = (np.arange(nx - 1)[None, None] + nx * np.arange(ny - 1)[None, :, None]
                 + nx * ny * np.arange(nz - 1)[:, None, None]).ravel()
        paths = [(0, 1, 2), (1, 2, 0), (2, 0, 1), (1, 0, 2), (0, 2, 1), (2, 1, 0)]
        tets = []
        for path, turned in zip(paths, [False] * 3 + [True] * 3):
            corners = [first + sum(strides[axis] for axis in path[:count]) for count in range(4)]
            if turned:
                corners[1], corners[2] = corners[2], corners[1]
            tets.append(np.stack(corners, axis=1))
        self.tets = np.stack(tets, axis=1).reshape(-1, 4)

    def weights(self, places_m):
        """The part of the disc's force on each place; its mean depth has the same weights."""
        low, high = places_m.min(axis=0), places_m.max(axis=0)
        line = np.linspace(-self.RADIUS_M, self.RADIUS_M, 401)
        x, y = np.meshgrid(line, line)
        inside = x * x + y * y <= self.RADIUS_M**2
        x, y = x[inside] + (low[0] + high[0]) / 2, y[inside] + (low[1] + high[1]) / 2
        weights = np.zeros(len(places_m))
        for at in np.flatnonzero(places_m[:, 2] > high[2] - 0.1 * self.cell_m):
            hats = [1 - np.abs(along - c) / self.cell_m for along, c in ((x, places_m[at, 0]), (y, places_m[at, 1]))]
            weights[at] = np.mean(np.clip(hats[0], 0, None) * np.clip(hats[1], 0, None))
        return weights / weights.sum()

    def held(self, places_m):
        """Whether each place is held."""
        return places_m[:, 2] < 0.1 * self.cell_m

    def push_n(self, weights):
        """The force on each place, N, of which `weights` are the parts."""
        push_n = np.zeros((len(weights), 3), np.float32)
        push_n[:, 2] = -self.FORCE_N * weights
        return push_n


def measure_blocks(peer, make, steps_per_ms):
    """For each size of cubes in mm: `make(block, steps in a millisecond)` returns a function that does so many steps and one
    that returns the mean depth under the disc, m. The first number of steps at which the block comes to rest counts;
    "restless_at" is the last that was tried if there is none."""
    for argument in sys.argv[1:]:
        block = Block(1e-3 * float(argument))
        for per_ms in steps_per_ms:
            run, depth_m = make(block, per_ms)
            run(200 * per_ms)
            before_m = depth_m()
            run(50 * per_ms)
            now_m = depth_m()
            if 0 < now_m < 0.03 and abs(now_m - before_m) < 0.01 * abs(before_m):
                break
        else:
            print(json.dumps({"peer": peer, "cell_mm": float(argument), "restless_at": steps_per_ms[-1]}), flush=True)
            continue
        told = {"peer": peer, "cell_mm": float(argument), "points": len(block.places_m), "steps_per_ms": per_ms}
        told["stiffness_n_per_m"] = block.FORCE_N / now_m
        print(json.dumps({**told, **windows(run, len(block.places_m))}), flush=True)
