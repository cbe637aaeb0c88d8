"""A solid of tetrahedra in numba, one thread, f32, as its user would write it: the law of `[solid]`, W = μ/2 (|F|² - 3 -
2 (J - 1)) + λ/2 (J - 1)², with J averaged at the nodes, which cures the locking of linear tetrahedra (Bonet and Burton,
doi:10.1002/(SICI)1099-0887(199805)14:5<437::AID-CNM162>3.0.CO;2-W). Symplectic Euler."""

import numba
import numpy as np

import common


@numba.njit(fastmath=True, error_model="numpy")
def advance(steps, u, d, f, growth, slopes, tets, gradients, volumes, node_volumes, mobility, push, shear, lame, keep):
    quarter, one = np.float32(0.25), np.float32(1)
    for _ in range(steps):
        growth[:] = 0
        f[:] = push
        for e in range(tets.shape[0]):
            a = tets[e, 0]
            h = slopes[e]
            for c in range(3):
                for k in range(3):
                    h[c, k] = 0
                for i in range(3):
                    moved = u[tets[e, i + 1], c] - u[a, c]
                    for k in range(3):
                        h[c, k] += moved * gradients[e, i, k]
            c00 = h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1]
            c01 = h[1, 2] * h[2, 0] - h[1, 0] * h[2, 2]
            c02 = h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0]
            minors = c00 + h[0, 0] * h[2, 2] - h[0, 2] * h[2, 0] + h[0, 0] * h[1, 1] - h[0, 1] * h[1, 0]
            grown = h[0, 0] + h[1, 1] + h[2, 2] + minors + h[0, 0] * c00 + h[0, 1] * c01 + h[0, 2] * c02
            for i in range(4):
                growth[tets[e, i]] += quarter * volumes[e] * grown
        for n in range(growth.size):
            growth[n] /= node_volumes[n]
        for e in range(tets.shape[0]):
            h = slopes[e]
            pressure = np.float32(0)
            for i in range(4):
                pressure += quarter * growth[tets[e, i]]
            pressure *= lame
            trace = h[0, 0] + h[1, 1] + h[2, 2]
            for c in range(3):
                c1, c2 = (c + 1) % 3, (c + 2) % 3
                whole = np.float32(0)
                stress0, stress1, stress2 = np.float32(0), np.float32(0), np.float32(0)
                for k in range(3):
                    k1, k2 = (k + 1) % 3, (k + 2) % 3
                    cofactor = h[c1, k1] * h[c2, k2] - h[c1, k2] * h[c2, k1]
                    diagonal = one if c == k else np.float32(0)
                    # cof F - I = tr(H) I - Hᵀ + cof H
                    turned = diagonal * trace - h[k, c] + cofactor
                    stress = shear * (h[c, k] - turned) + pressure * (diagonal + turned)
                    if k == 0:
                        stress0 = stress
                    elif k == 1:
                        stress1 = stress
                    else:
                        stress2 = stress
                for i in range(3):
                    g = gradients[e, i]
                    force = volumes[e] * (stress0 * g[0] + stress1 * g[1] + stress2 * g[2])
                    f[tets[e, i + 1], c] -= force
                    whole += force
                f[tets[e, 0], c] += whole
        for n in range(u.shape[0]):
            for c in range(3):
                d[n, c] = keep * d[n, c] + mobility[n] * f[n, c]
                u[n, c] += d[n, c]


def make(block, per_ms):
    dt_s = 1e-3 / per_ms
    places, tets = block.places_m, block.tets
    edges = (places[tets[:, 1:]] - places[tets[:, :1]]).transpose(0, 2, 1)
    volumes = np.linalg.det(edges) / 6
    assert (volumes > 0).all()
    node_volumes = np.bincount(tets.ravel(), np.repeat(volumes / 4, 4))
    mobility = np.where(block.held(places), 0, dt_s**2 / (block.DENSITY * node_volumes))
    weights = block.weights(places)
    single = lambda values: np.ascontiguousarray(values, np.float32)
    u, d, f = (np.zeros(places.shape, np.float32) for _ in range(3))
    slopes = np.zeros((len(tets), 3, 3), np.float32)
    data = (single(np.linalg.inv(edges)), single(volumes), single(node_volumes), single(mobility), block.push_n(weights))
    laws = np.float32(block.shear_pa), np.float32(block.lame_pa), np.float32(1 - block.DAMPING_PER_S * dt_s)
    growth = np.zeros(len(places), np.float32)
    run = lambda steps: advance(steps, u, d, f, growth, slopes, tets.astype(np.uint32), *data, *laws)
    return run, lambda: -float(weights @ u[:, 2])


common.measure_blocks("numba, tetrahedra with J at nodes", make, [3, 4, 6, 8, 12, 16])
