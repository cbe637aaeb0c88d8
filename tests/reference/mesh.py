"""Solves a small closed mesh by other means than Palpate's: dense arrays and the classical Runge-Kutta scheme in NumPy, with
half the step until nothing changes. Writes icosphere.obj, icosphere.json and filled.json beside itself: python mesh.py

The model is that of the paper (README, docs/paper.md): mass points at the vertices, springs along the edges (force
k (L - L0) along the spring), a spring of zero rest length from each point to its rest, damping, and forces
F exp(-c r + c'), r the distance at rest from the control point. One vertex is moved by a tool. In filled.json the sphere
encloses a volume V0 that resists: a pressure -kappa/V0 (a u), with a the slope of the volume at rest, pushes each vertex by its a.
"""

import json
import pathlib

import numpy as np

HERE = pathlib.Path(__file__).parent


def icosphere(divisions, radius):
    """An icosahedron whose triangles are divided so often, with its vertices on a sphere."""
    golden = (1 + 5**0.5) / 2
    corners = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    vertices = [np.array(corner[-turn:] + corner[:-turn], float) for turn in range(3) for corner in corners]
    vertices = [vertex / np.linalg.norm(vertex) for vertex in vertices]
    edge = min(np.linalg.norm(vertices[0] - other) for other in vertices[1:])
    near = lambda a, b: abs(np.linalg.norm(vertices[a] - vertices[b]) - edge) < 1e-9
    triangles = [
        (a, b, c)
        for a in range(12) for b in range(a + 1, 12) for c in range(b + 1, 12)
        if near(a, b) and near(b, c) and near(a, c)
    ]
    outward = lambda a, b, c: np.dot(np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a]), vertices[a]) > 0
    triangles = [(a, b, c) if outward(a, b, c) else (a, c, b) for a, b, c in triangles]
    for _ in range(divisions):
        middles = {}

        def middle(a, b):
            key = (min(a, b), max(a, b))
            if key not in middles:
                middles[key] = len(vertices)
                vertices.append((vertices[a] + vertices[b]) / np.linalg.norm(vertices[a] + vertices[b]))
            return middles[key]

        finer = []
        for a, b, c in triangles:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            finer += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = finer
    return radius * np.array(vertices), triangles


def smooth(move, t):
    """Displacement, velocity and acceleration of a smooth move."""
    span = move["t1"] - move["t0"]
    x = min(max((t - move["t0"]) / span, 0.0), 1.0)
    by = np.array(move["by"])
    return (
        by * (x * x * x * (10 + x * (6 * x - 15))),
        by * (30 * x * x * (1 - x) ** 2 / span),
        by * (60 * x * (1 - x) * (1 - 2 * x) / span**2),
    )


class Tissue:
    def __init__(self, scene, rest, edges, triangles):
        self.scene, self.rest = scene, rest
        self.a, self.b = np.array(edges).T
        self.length = np.linalg.norm(rest[self.b] - rest[self.a], axis=1)
        # The volume is a sum of x0 (x1 x x2)/6 over the triangles, and its slope that of each corner.
        self.volume, self.slopes = 0.0, np.zeros_like(rest)
        for corners in triangles:
            for a, b, c in (corners, corners[1:] + corners[:1], corners[2:] + corners[:2]):
                self.slopes[a] += np.cross(rest[b], rest[c]) / 6
            self.volume += np.dot(rest[a], np.cross(rest[b], rest[c])) / 6
        self.fields = []
        for force in scene["forces"]:
            away = np.linalg.norm(rest - rest[force["point"]], axis=1)
            self.fields.append(np.outer(np.exp(-force["c"] * away + force["c_prime"]), force["vector"]))

    def springs(self, u):
        along = self.rest[self.b] + u[self.b] - self.rest[self.a] - u[self.a]
        now = np.linalg.norm(along, axis=1)
        pull = (self.scene["k"] * (now - self.length) / now)[:, None] * along
        force = np.zeros_like(u)
        np.add.at(force, self.a, pull)
        np.add.at(force, self.b, -pull)
        growth = float((self.slopes * u).sum())
        return force - self.scene.get("kappa", 0.0) * growth / self.volume * self.slopes

    def applied(self, t, before):
        total = np.zeros_like(self.rest)
        for force, field in zip(self.scene["forces"], self.fields):
            profile = force["profile"]
            if profile["type"] == "constant":
                total += field
            else:
                on, off = profile["t_on"], profile["t_off"]
                is_on = on < t <= off if before else on <= t < off
                total += field * is_on
        return total

    def slope(self, t, state, applied):
        u, v = state
        scene = self.scene
        force = self.springs(u) - scene["K"] * u - scene["C"] * v + applied
        acceleration = force / scene["mass"]
        acceleration[scene["tool"]["point"]] = self.tool(t)[2]
        return np.array([v, acceleration])

    def tool(self, t):
        parts = [smooth(move, t) for move in self.scene["tool"]["moves"]]
        return [sum(part[which] for part in parts) for which in range(3)]

    def advance(self, state, begin, end, steps):
        # Nothing jumps within an interval.
        applied = self.applied((begin + end) / 2, False)
        dt = (end - begin) / steps
        for n in range(steps):
            t = begin + n * dt
            k1 = self.slope(t, state, applied)
            k2 = self.slope(t + dt / 2, state + dt / 2 * k1, applied)
            k3 = self.slope(t + dt / 2, state + dt / 2 * k2, applied)
            k4 = self.slope(t + dt, state + dt * k3, applied)
            state = state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            point = self.scene["tool"]["point"]
            state[0][point], state[1][point], _ = self.tool(t + dt)
        return state

    def course(self, steps):
        times = self.scene["times"]
        states = [np.zeros((2, *self.rest.shape))]
        for begin, end in zip(times, times[1:]):
            states.append(self.advance(states[-1], begin, end, steps))
        return states

    def frame(self, t, state):
        u, v = state
        scene, applied = self.scene, self.applied(t, t > 0)
        spring, virtual, damping = self.springs(u), -scene["K"] * u, -scene["C"] * v
        now = np.linalg.norm(self.rest[self.b] + u[self.b] - self.rest[self.a] - u[self.a], axis=1)
        watch = []
        for point in scene["watch"]:
            forces = {"spring": spring, "virtual": virtual, "damping": damping, "surgical": applied,
                      "reaction": spring + virtual}
            if point == scene["tool"]["point"]:
                forces["constraint"] = scene["mass"] * self.tool(t)[2] - spring - virtual - damping - applied
            watch.append({name: force[point].tolist() for name, force in forces.items()})
        return {
            "t": t,
            "u": u[scene["samples"]].tolist(),
            "v": v[scene["samples"]].tolist(),
            "watch": watch,
            "energy": {
                "kinetic": 0.5 * scene["mass"] * float((v * v).sum()),
                "spring": 0.5 * scene["k"] * float(((now - self.length) ** 2).sum())
                + 0.5 * scene.get("kappa", 0.0) * float((self.slopes * u).sum()) ** 2 / self.volume,
                "virtual": 0.5 * scene["K"] * float((u * u).sum()),
            },
        }


def main():
    rest, triangles = icosphere(2, 0.05)
    edges = sorted({(min(pair), max(pair)) for a, b, c in triangles for pair in ((a, b), (b, c), (c, a))})
    lines = ["v " + " ".join(repr(float(x)) for x in vertex) for vertex in rest]
    lines += ["f " + " ".join(str(vertex + 1) for vertex in triangle) for triangle in triangles]
    (HERE / "icosphere.obj").write_text("\n".join(lines) + "\n")
    scene = {
        "name": "icosphere",
        "about": "a sphere of 162 vertices: a pulse and a constant push from two sides, and a vertex moved in, aside and back",
        "mesh": "icosphere.obj", "mass": 0.01, "k": 10.0, "K": 5.0, "C": 0.1,
        "forces": [
            {"point": 3, "vector": [0.005, -0.09, 0.025], "c": 40.0, "c_prime": 0.2,
             "profile": {"type": "pulse", "t_on": 0.05, "t_off": 0.25}},
            {"point": 100, "vector": [-0.05, 0.01, 0.07], "c": 80.0, "c_prime": 0.0, "profile": {"type": "constant"}},
        ],
        "tool": {"point": 47, "moves": [
            {"t0": 0.0, "t1": 0.15, "by": [0.0, -0.012, 0.004]},
            {"t0": 0.2, "t1": 0.3, "by": [0.006, 0.0, 0.0]},
            {"t0": 0.3, "t1": 0.45, "by": [-0.006, 0.012, -0.004]},
        ]},
        "t_end": 0.6, "times": [n * 0.05 for n in range(13)],
        "samples": [0, 3, 12, 47, 77, 100, 161], "watch": [3, 47, 100],
    }
    scene["times"] = [round(time, 2) for time in scene["times"]]
    solve(scene, rest, edges, triangles)
    about = "the same sphere, which encloses a volume that resists more than anything else"
    solve({**scene, "name": "filled", "about": about, "kappa": 20000.0}, rest, edges, triangles)


def solve(scene, rest, edges, triangles):
    tissue = Tissue(scene, rest, edges, triangles)
    steps, before = 100, None
    while True:
        states = tissue.course(steps)
        if before is not None:
            largest = max(abs(state[0]).max() for state in states)
            # Of fourth order: the error of the finer one is a fifteenth of the difference.
            error = max(abs(now[0] - then[0]).max() for now, then in zip(states, before)) / largest / 15
            print(f"{steps} steps an interval: error {error:.1e} of the largest displacement, {largest:.4f} m")
            if error < 2e-14:
                break
        before, steps = states, 2 * steps
    frames = [tissue.frame(t, state) for t, state in zip(scene["times"], states)]
    checks = {"steps_an_interval": steps, "error": error, "largest_displacement": largest}
    (HERE / f"{scene['name']}.json").write_text(json.dumps({"scene": scene, "frames": frames, "checks": checks}) + "\n")


if __name__ == "__main__":
    main()
