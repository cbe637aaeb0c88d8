"""The step in numba, written by an expert: vectorized loops over rows, one pass per step, many steps per call.
Displacements of this and the last step lie in two padded grids that are swapped; a point gathers its 8 springs. Springs
into the padding have no stiffness, so no point needs a branch."""

import numba
import numpy as np

import common

K, VIRTUAL, H, P, Q = common.K, common.VIRTUAL, common.H, common.P, common.Q
DIAGONAL = np.float32(np.sqrt(2.0)) * H
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
VECTOR = 16
# Divisions need no check for 0, which would prevent vectorization.
options = {"fastmath": True, "error_model": "numpy"}


@numba.njit(inline="always", **options)
def spring(x, y, z, rest_x, rest_y, length, k):
    """The force of a spring whose far end is (x, y, z) more displaced than its near end."""
    stretch = x * (TWO * rest_x + x) + y * (TWO * rest_y + y) + z * z
    square = length * length + stretch
    scale = k * stretch / (square + length * np.sqrt(square))
    return scale * (rest_x + x), scale * (rest_y + y), scale * z


@numba.njit(inline="always", **options)
def row(x_up, x, x_down, y_up, y, y_down, z_up, z, z_down, last_x, last_y, last_z, fx, fy, fz, up, down, left, right):
    """Writes a row's next displacements over its last ones. `up` to `right`: the stiffness of springs that way."""
    for j in range(left.size):
        u, v, w = x[j + 1], y[j + 1], z[j + 1]
        a, b = left[j], right[j]
        x0, y0, z0 = spring(x[j] - u, y[j] - v, z[j] - w, ZERO, -H, H, a * K)
        x1, y1, z1 = spring(x[j + 2] - u, y[j + 2] - v, z[j + 2] - w, ZERO, H, H, b * K)
        x2, y2, z2 = spring(x_up[j + 1] - u, y_up[j + 1] - v, z_up[j + 1] - w, -H, ZERO, H, up)
        x3, y3, z3 = spring(x_down[j + 1] - u, y_down[j + 1] - v, z_down[j + 1] - w, H, ZERO, H, down)
        x4, y4, z4 = spring(x_up[j] - u, y_up[j] - v, z_up[j] - w, -H, -H, DIAGONAL, a * up)
        x5, y5, z5 = spring(x_up[j + 2] - u, y_up[j + 2] - v, z_up[j + 2] - w, -H, H, DIAGONAL, b * up)
        x6, y6, z6 = spring(x_down[j] - u, y_down[j] - v, z_down[j] - w, H, -H, DIAGONAL, a * down)
        x7, y7, z7 = spring(x_down[j + 2] - u, y_down[j + 2] - v, z_down[j + 2] - w, H, H, DIAGONAL, b * down)
        force_x = fx[j] + x0 + x1 + x2 + x3 + x4 + x5 + x6 + x7 - VIRTUAL * u
        force_y = fy[j] + y0 + y1 + y2 + y3 + y4 + y5 + y6 + y7 - VIRTUAL * v
        force_z = fz[j] + z0 + z1 + z2 + z3 + z4 + z5 + z6 + z7 - VIRTUAL * w
        last_x[j] = u + P * (u - last_x[j]) + Q * force_x
        last_y[j] = v + P * (v - last_y[j]) + Q * force_y
        last_z[j] = w + P * (w - last_z[j]) + Q * force_z


@numba.njit(**options)
def step(u, last, applied, left, right):
    rows = applied.shape[1]
    for i in range(rows):
        up = ZERO if i == 0 else K
        down = ZERO if i == rows - 1 else K
        row(
            u[0, i], u[0, i + 1], u[0, i + 2],
            u[1, i], u[1, i + 1], u[1, i + 2],
            u[2, i], u[2, i + 1], u[2, i + 2],
            last[0, i + 1, 1:], last[1, i + 1, 1:], last[2, i + 1, 1:],
            applied[0, i], applied[1, i], applied[2, i],
            up, down, left, right,
        )  # fmt: skip


@numba.njit(**options)
def advance(steps, u, last, applied, left, right):
    for _ in range(steps // 2):
        step(u, last, applied, left, right)
        step(last, u, applied, left, right)


def make(side):
    # Whole vectors per row. Points beyond the sheet have no springs and no force, and stay in place.
    width = -(-side // VECTOR) * VECTOR
    u, last = np.zeros((2, 3, side + 2, width + 2), np.float32)
    applied = np.zeros((3, side, width), np.float32)
    applied[:, :, :side] = common.forces(side)
    left, right = np.zeros((2, width), np.float32)
    left[1:side] = right[: side - 1] = 1
    return lambda steps: advance(steps, u, last, applied, left, right)


common.measure("numba", make)
