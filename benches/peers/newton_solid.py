"""Newton (on Warp) on the processor, f32: tetrahedra by three of its solvers, which differ in what they solve."""

import numpy as np
import warp

warp.config.quiet = True
import newton  # noqa: E402  (after the setting)

import common  # noqa: E402

ITERATIONS = {"VBD": 10, "XPBD": 2}


def maker(kind):
    def make(block, per_ms):
        nx, ny, nz = map(int, block.cells)
        builder = newton.ModelBuilder(gravity=warp.vec3(0.0, 0.0, 0.0))
        # Particles of the default radius would push each other.
        builder.default_particle_radius = 1e-5
        origin, still = warp.vec3(0.0, 0.0, 0.0), warp.vec3(0.0, 0.0, 0.0)
        builder.add_soft_grid(
            pos=origin, rot=warp.quat_identity(), vel=still, dim_x=nx, dim_y=ny, dim_z=nz, cell_x=block.cell_m,
            cell_y=block.cell_m, cell_z=block.cell_m, density=block.DENSITY, k_mu=block.shear_pa, k_lambda=block.lame_pa,
            k_damp=0.0, add_surface_mesh_edges=False)
        places_m = np.array(builder.particle_q, float).reshape(-1, 3)
        for held in np.flatnonzero(block.held(places_m)):
            builder.particle_mass[held] = 0.0
        if kind == "VBD":
            builder.color()
        model = builder.finalize(device="cpu")
        solver = {
            "VBD": lambda: newton.solvers.SolverVBD(model, iterations=ITERATIONS["VBD"]),
            "XPBD": lambda: newton.solvers.SolverXPBD(model, iterations=ITERATIONS["XPBD"]),
            "semi-implicit": lambda: newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False),
        }[kind]()
        states, control = [model.state(), model.state()], model.control()
        weights = block.weights(places_m)
        push = block.push_n(weights)
        damping = np.float32(block.DAMPING_PER_S) * model.particle_mass.numpy()[:, None]

        def run(steps):
            for _ in range(steps):
                states[0].particle_f.assign(push - damping * states[0].particle_qd.numpy())
                solver.step(states[0], states[1], control, None, 1e-3 / per_ms)
                states.reverse()

        return run, lambda: -float(weights @ (states[0].particle_q.numpy() - places_m)[:, 2])

    return make


kinds = {"VBD": [1, 2, 4], "XPBD": [1, 2, 5, 10], "semi-implicit": [2, 4, 8, 16]}
for kind, steps_per_ms in kinds.items():
    iterations = f", {ITERATIONS[kind]} iterations" if kind in ITERATIONS else ""
    common.measure_blocks(f"Newton, {kind}{iterations}", maker(kind), steps_per_ms)
