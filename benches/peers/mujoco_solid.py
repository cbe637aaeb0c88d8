"""MuJoCo's flex of three dimensions: tetrahedra by Saint Venant and Kirchhoff's law, forces explicit, f64, one thread."""

import mujoco
import numpy as np

import common


def make(block, per_ms):
    nx, ny, nz = block.cells
    cell = block.cell_m
    mass_kg = block.DENSITY * block.SIZE_M.prod()
    xml = f"""<mujoco>
      <option timestep="{1e-3 / per_ms}" gravity="0 0 0" solver="CG"><flag contact="disable" constraint="disable"/></option>
      <size memory="2G"/>
      <worldbody>
        <flexcomp name="block" type="grid" dim="3" count="{nx + 1} {ny + 1} {nz + 1}" spacing="{cell} {cell} {cell}"
            radius="0.0005" mass="{mass_kg}">
          <edge equality="false"/>
          <elasticity young="{block.YOUNGS_PA}" poisson="{block.POISSON}"/>
          <contact selfcollide="none"/>
          <pin gridrange="0 0 0 {nx} {ny} 0"/>
        </flexcomp>
      </worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places_m = data.flexvert_xpos.copy()
    weights = block.weights(places_m)
    model.dof_damping[:] = block.DAMPING_PER_S * model.body_mass[model.dof_bodyid]
    for vertex in np.flatnonzero(weights):
        data.qfrc_applied[model.body_dofadr[model.flex_vertbodyid[vertex]] + 2] = -block.FORCE_N * weights[vertex]

    def run(steps):
        for _ in range(steps):
            mujoco.mj_step(model, data)

    def depth_m():
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            return np.nan
        return -float(weights @ (data.flexvert_xpos - places_m)[:, 2])

    return run, depth_m


common.measure_blocks("MuJoCo, flex", make, [1, 2, 3, 4, 6, 8, 12, 16])
