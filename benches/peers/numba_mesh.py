"""The step on a mesh in numba, written by an expert: springs in compressed rows (CSR), each evaluated from both ends, so
that nothing is scattered; a vertex and its displacement in one record of 16 bytes; one pass per step, many steps per call.
Displacements of this and the last step lie in two arrays that are swapped."""

import numba
import numpy as np

import common

ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)
TURN, PULL = common.Mesh.TURN, common.Mesh.PULL
# Divisions need no check for 0, which would cost a branch.
options = {"fastmath": True, "error_model": "numpy"}


@numba.njit(**options)
def step(u, last, starts, to, rest):
    for i in range(starts.size - 1):
        x, y, z = u[i, 0], u[i, 1], u[i, 2]
        force_x, force_y, force_z = -TURN * x, -TURN * y, -TURN * z
        for s in range(starts[i], starts[i + 1]):
            j = to[s]
            a, b, c = u[j, 0] - x, u[j, 1] - y, u[j, 2] - z
            rest_x, rest_y, rest_z = rest[s, 0], rest[s, 1], rest[s, 2]
            # The strain without cancellation: q = (L² - L0²)/L0², and 1 - L0/L = q/(s (1 + s)), s = √(1 + q).
            q = (a * (TWO * rest_x + a) + b * (TWO * rest_y + b) + c * (TWO * rest_z + c)) * rest[s, 3]
            root = np.sqrt(ONE + q)
            pull = PULL * q / (root * (ONE + root))
            force_x += pull * (rest_x + a)
            force_y += pull * (rest_y + b)
            force_z += pull * (rest_z + c)
        last[i, 0] = x + (x - last[i, 0]) + force_x
        last[i, 1] = y + (y - last[i, 1]) + force_y
        last[i, 2] = z + (z - last[i, 2]) + force_z


@numba.njit(**options)
def advance(steps, u, last, starts, to, rest):
    for _ in range(steps // 2):
        step(u, last, starts, to, rest)
        step(last, u, starts, to, rest)


def make(mesh):
    u = np.zeros((len(mesh.rest), 4), np.float32)
    u[:, :3] = mesh.displaced()
    spans = mesh.spans()
    rest = np.column_stack([spans, 1 / np.sum(spans * spans, axis=1)]).astype(np.float32)
    last = u.copy()
    # Indices without a sign need no check for those that count from the end.
    starts, to = mesh.starts.astype(np.uint32), mesh.to.astype(np.uint32)
    return lambda steps: advance(steps, u, last, starts, to, rest)


common.measure_meshes("numba", make)
