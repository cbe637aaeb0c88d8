"""The step in Taichi: fields of vectors, a kernel that gathers the springs of a point, one that moves the points."""

import taichi as ti

import common

ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f32, fast_math=True, offline_cache=False, log_level=ti.ERROR)

K, VIRTUAL, H, P, Q = map(float, (common.K, common.VIRTUAL, common.H, common.P, common.Q))


def make(side):
    u = ti.Vector.field(3, ti.f32, shape=(side, side))
    d = ti.Vector.field(3, ti.f32, shape=(side, side))
    applied = ti.Vector.field(3, ti.f32, shape=(side, side))
    applied.from_numpy(common.forces(side).transpose(1, 2, 0).copy())

    @ti.kernel
    def accelerate():
        for i, j in u:
            force = applied[i, j] - VIRTUAL * u[i, j]
            for a, b in ti.static(common.NEIGHBOURS):
                if 0 <= i + a < side and 0 <= j + b < side:
                    apart = u[i + a, j + b] - u[i, j] + ti.Vector([a * H, b * H, 0.0])
                    force += K * (1.0 - (a * a + b * b) ** 0.5 * H / apart.norm()) * apart
            d[i, j] = P * d[i, j] + Q * force

    @ti.kernel
    def move():
        for i, j in u:
            u[i, j] += d[i, j]

    def run(steps):
        for _ in range(steps):
            accelerate()
            move()
        ti.sync()

    return run


common.measure("Taichi", make)
