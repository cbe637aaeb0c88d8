"""The step in NumPy: whole arrays, each spring once, its force added to one end and taken from the other."""

import numpy as np

import common


def spans(shift, side):
    """The points that have a neighbour `shift` away, and those neighbours, along one axis."""
    here = slice(max(0, -shift), side - max(0, shift))
    return here, slice(here.start + shift, here.stop + shift)


def make(side):
    u = np.zeros((3, side, side), np.float32)
    d = np.zeros_like(u)
    applied = common.forces(side)
    springs = []
    for di, dj in common.NEIGHBOURS[::2]:
        (here_i, there_i), (here_j, there_j) = spans(di, side), spans(dj, side)
        rest = np.array([di, dj, 0], np.float32).reshape(3, 1, 1) * common.H
        length = np.float32(np.sqrt(di * di + dj * dj)) * common.H
        springs.append(((slice(None), here_i, here_j), (slice(None), there_i, there_j), rest, length))

    def run(steps):
        for _ in range(steps):
            force = applied - common.VIRTUAL * u
            for here, there, rest, length in springs:
                apart = u[there] - u[here]
                apart += rest
                now = np.sqrt(np.einsum("cij,cij->ij", apart, apart))
                apart *= common.K * (1 - length / now)
                force[here] += apart
                force[there] -= apart
            np.multiply(d, common.P, out=d)
            force *= common.Q
            np.add(d, force, out=d)
            np.add(u, d, out=u)

    return run


common.measure("NumPy", make)
