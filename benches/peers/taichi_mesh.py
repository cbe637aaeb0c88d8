"""The step on a mesh in Taichi: fields of vectors, springs in compressed rows, a kernel that gathers the springs of a
vertex, one that moves the vertices."""

import numpy as np
import taichi as ti

import common

ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f32, fast_math=True, offline_cache=False, log_level=ti.ERROR)

TURN, PULL = float(common.Mesh.TURN), float(common.Mesh.PULL)


def make(mesh):
    count, ends = len(mesh.rest), mesh.to.size
    u = ti.Vector.field(3, ti.f32, shape=count)
    d = ti.Vector.field(3, ti.f32, shape=count)
    starts = ti.field(ti.i32, shape=count + 1)
    to = ti.field(ti.i32, shape=ends)
    rest = ti.Vector.field(3, ti.f32, shape=ends)
    u.from_numpy(mesh.displaced())
    starts.from_numpy(mesh.starts)
    to.from_numpy(mesh.to)
    rest.from_numpy(np.ascontiguousarray(mesh.spans()))

    @ti.kernel
    def accelerate():
        for i in u:
            force = -TURN * u[i]
            for s in range(starts[i], starts[i + 1]):
                apart = u[to[s]] - u[i]
                span = rest[s] + apart
                q = apart.dot(rest[s] + span) / rest[s].norm_sqr()
                root = ti.sqrt(1.0 + q)
                force += PULL * q / (root * (1.0 + root)) * span
            d[i] += force

    @ti.kernel
    def move():
        for i in u:
            u[i] += d[i]

    def run(steps):
        for _ in range(steps):
            accelerate()
            move()
        ti.sync()

    return run


common.measure_meshes("Taichi", make)
