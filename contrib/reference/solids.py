"""Computes the stiffness of solids under a disc with finite elements that fit the body, by another code than Palpate: meshes of
Gmsh, quadratic tetrahedra of scikit-fem, small strain. The table in docs/solids.md compares Palpate with these numbers.

    pip install scikit-fem gmsh meshio pypardiso    # without pypardiso SciPy solves, much more slowly
    palpate organ prostate --edge-mm 2.5 --seed 1 --output prostate.obj
    python solids.py sphere block lumps prostate.obj        # or some of them

A disc of 5 mm presses evenly along the normal of the surface. The stiffness is its force over the mean depth in it; the disc
is what is within 5 mm of its middle along the surface. Three meshes are each about 0.7 times as coarse as the one before. The
converged value is what they tend to if the error falls as the square of the size of the elements; its uncertainty is how far it
is from the finest mesh, or from the same of the two coarser meshes if that is more. All cases take about 10 minutes on a core.

Prints a line for each mesh: size at the rim of the disc, unknowns, area of the disc, N/m; then the converged value.

  sphere        radius 30 mm, 8 kPa, nu 0.45, fixed at and below z = -18 mm, pressed at the top; a quarter of it.
                sphere:-19.5 fixes it at and below z = -19.5 mm
  block         60 x 60 x 30 mm, 8 kPa, nu 0.45 and 0.49, fixed below, pressed in the middle of the top; a quarter of it
  lumps         the block of nu 0.49 with a ball of radius 5 mm, 5 times as stiff, 8, 10 and 15 mm below the middle of the top,
                divided by the block without: both on one mesh
  prostate.obj  the built-in scene `prostate` with its nodules, fixed at the vertices of the group `front`, pressed over the
                nodule of the left lobe, and in the middle
"""

import contextlib
import io
import logging
import pathlib
import sys
import tempfile
import time

import gmsh
import numpy as np
import scipy.sparse as sparse
import skfem
from scipy.spatial import cKDTree

RADIUS = 5.0  # of the disc; all lengths are mm
SCALES = (1.0, 0.7, 0.5)
RIM = 0.4  # size of the elements at the rim of the disc, times a scale
START = time.monotonic()


def tell(text):
    print(f"{time.monotonic() - START:6.0f} s  {text}", flush=True)


def solve(matrix, load):
    """Solves a symmetric positive system."""
    try:
        from pypardiso import PyPardisoSolver
    except ImportError:
        from scipy.sparse.linalg import splu

        return splu(matrix.tocsc()).solve(load)
    solver = PyPardisoSolver(mtype=2)
    upper = sparse.triu(matrix, format="csr")
    solver.factorize(upper)
    solution = solver.solve(upper, load)
    solver.free_memory(everything=True)
    return solution


class Press:
    """A disc around a place of the surface, that presses against the direction `out`."""

    def __init__(self, place, out):
        self.place, self.out = np.asarray(place, float), np.asarray(out, float)

    def covers(self, x):
        """Whether places of the surface are in the disc: x is 3 x any shape. A chord d that ends h off the tangent plane belongs
        to an arc of d + h²/6d."""
        away = x - self.place.reshape((3,) + (1,) * (x.ndim - 1))
        chord = np.maximum(np.sqrt((away**2).sum(axis=0)), 1e-9)
        off = np.einsum("i,i...->...", self.out, away)
        return chord + off**2 / (6 * chord) <= RADIUS

    def from_rim(self, x):
        """The distance of places from the rim of the disc."""
        away = x - self.place[:, None]
        off = self.out @ away
        along = np.sqrt(np.maximum((away**2).sum(axis=0) - off**2, 0.0))
        return np.hypot(along - RADIUS, off)


def assembled(basis, factor, nu):
    """The stiffness matrix for E = `factor` of each tetrahedron. Unknown 3k + i is the displacement of node k along axis i."""
    shear, lame = 1 / (2 * (1 + nu)), nu / ((1 + nu) * (1 - 2 * nu))
    size, nodes = 3 * basis.N, basis.Nbfun
    matrix = sparse.csr_matrix((size, size))
    for some in np.array_split(np.arange(basis.nelems), basis.nelems // 15000 + 1):
        slopes = np.stack([basis.basis[k][0].grad[:, some] for k in range(nodes)])  # node, axis, tetrahedron, place
        slopes = np.ascontiguousarray(slopes.transpose(2, 3, 0, 1)).reshape(len(some), -1, 3 * nodes)
        weights = (basis.dx[some] * factor[some, None])[:, :, None]
        products = np.matmul((weights * slopes).transpose(0, 2, 1), slopes).reshape(-1, nodes, 3, nodes, 3)
        turned = products.transpose(0, 1, 4, 3, 2)
        own = lame * products + shear * turned
        own += shear * np.einsum("eakbk->eab", products)[:, :, None, :, None] * np.eye(3)[:, None, :]
        unknowns = (3 * basis.element_dofs[:, some].T[:, :, None] + np.arange(3)).reshape(len(some), -1)
        rows = np.repeat(unknowns, 3 * nodes, axis=1).ravel()
        columns = np.tile(unknowns, (1, 3 * nodes)).ravel()
        matrix += sparse.coo_matrix((own.ravel(), (rows, columns)), (size, size)).tocsr()
    return matrix


def middles_of_parts(parts):
    """The middles and areas of parts² equal parts of the triangle (0, 0), (1, 0), (0, 1)."""
    middles = [
        ((i + by) / parts, (j + by) / parts)
        for by, end in ((1 / 3, 0), (2 / 3, 1)) for i in range(parts) for j in range(parts - i - end)
    ]
    return np.array(middles).T, np.full(len(middles), 0.5 / parts**2)


def stiffness(mesh, factors, nu, young, press, fixed, mirrors, parts):
    """The force over the mean depth, N/m; the number of unknowns, and the area of the disc, mm². `factors`: E of each
    tetrahedron / `young` (Pa), one list for each result. `fixed`: facets; `mirrors`: axes x with u_x = 0 at x = 0. The mesh is
    one of `parts` equal parts."""
    basis = skfem.Basis(mesh, skfem.ElementTetP2(), intorder=4 if isinstance(mesh, skfem.MeshTet2) else 2)
    middles = mesh.p[:, mesh.facets].mean(axis=1)
    boundary = mesh.boundary_facets()
    is_surface = np.all([middles[axis, boundary] > 1e-6 for axis in mirrors], axis=0) if mirrors else True
    corners = mesh.p[:, mesh.facets[:, boundary]]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=0).max(axis=0)
    away = np.linalg.norm(middles[:, boundary] - press.place[:, None], axis=0) - RADIUS
    whole, cut = is_surface & (away <= -edge), is_surface & (np.abs(away) < edge)
    shares = 0.0
    for facets, places in ((boundary[whole], None), (boundary[cut], middles_of_parts(32))):
        surface = skfem.FacetBasis(mesh, skfem.ElementTetP2(), facets=facets, intorder=4, quadrature=places)
        shares = shares + skfem.LinearForm(lambda v, w: press.covers(w.x) * v).assemble(surface)
    load, disc = np.outer(shares, press.out).ravel(), shares.sum()
    held = [3 * basis.get_dofs(fixed).all()[:, None] + np.arange(3)]
    for axis in mirrors:
        held.append(3 * basis.get_dofs(boundary[np.abs(middles[axis, boundary]) < 1e-6]).all() + axis)
    free = np.setdiff1d(np.arange(len(load)), np.concatenate([each.ravel() for each in held]))
    found = []
    for factor in factors:
        moved = solve(assembled(basis, factor, nu)[free][:, free], load[free])
        # For a pressure of 1: force = area, mean depth = load . moved / area / young. mm and Pa give 1e-3 N/m.
        found.append(parts * disc**2 / (load[free] @ moved) * young * 1e-3)
    return np.array(found), len(free), parts * disc


def told(name, unit, found):
    """Tells the converged value of `found`, pairs of unknowns and value. Elements are as large as 1/unknowns^(1/3)."""
    sizes = np.array([unknowns ** (-1 / 3) for unknowns, _ in found])
    values = np.array([value for _, value in found])
    before, last = values[1:] + np.diff(values) / ((sizes[:-1] / sizes[1:]) ** 2 - 1)
    within = max(abs(last - values[-1]), abs(last - before))
    tell(f"{name}: {last:.5g} ± {within:.2g} {unit}   (meshes: {', '.join(f'{each:.5g}' for each in values)})")


def near(press, away):
    """The size of elements in a field of Gmsh: `RIM` at the rim of a disc around the axis z, growing away from it."""
    return f"{RIM} + {away} * Sqrt((Sqrt(x*x + y*y) - {RADIUS})^2 + (z - {press.place[2]})^2)"


def meshed(build, scale, sizes):
    """A mesh of curved tetrahedra of what `build` makes. Its edges are about as long as the least of `sizes` times `scale`."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.NumThreads", 1)
    build(gmsh.model.occ)
    gmsh.model.occ.synchronize()
    for dimension, tag in gmsh.model.getEntities(3):
        gmsh.model.addPhysicalGroup(dimension, [tag])
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber("Mesh.MeshSize" + option, 0)
    fields = gmsh.model.mesh.field
    of = []
    for size in [*sizes, "5"]:
        of.append(fields.add("MathEval"))
        fields.setString(of[-1], "F", f"{scale} * ({size})")
    least = fields.add("Min")
    fields.setNumbers(least, "FieldsList", of)
    fields.setAsBackgroundMesh(least)
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(2)
    return read_mesh(skfem.MeshTet2)


def read_mesh(kind):
    """Takes the mesh over from Gmsh."""
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "mesh.msh"
        gmsh.write(str(file))
        gmsh.finalize()
        logging.getLogger("skfem").setLevel(logging.ERROR)
        with contextlib.redirect_stdout(io.StringIO()):
            return kind.load(file)


def facets_where(mesh, holds):
    boundary = mesh.boundary_facets()
    return boundary[holds(mesh.p[:, mesh.facets[:, boundary]]).all(axis=0)]


def sphere(cut=-18.0):
    radius, press = 30.0, Press((0, 0, 30.0), (0, 0, 1))
    held = (radius**2 - cut**2) ** 0.5
    found = []
    for scale in SCALES:
        def build(occ):
            ball, box = occ.addSphere(0, 0, 0, radius), occ.addBox(0, 0, cut, radius + 1, radius + 1, 2 * radius)
            occ.intersect([(3, ball)], [(3, box)])

        at_edge = f"1 + 0.3 * Sqrt((Sqrt(x*x + y*y) - {held})^2 + (z - ({cut}))^2)"
        mesh = meshed(build, scale, [near(press, 0.25), at_edge])
        fixed = facets_where(mesh, lambda x: np.abs(x[2] - cut) < 1e-6)
        ones = np.ones(mesh.t.shape[1])
        [value], unknowns, disc = stiffness(mesh, [ones], 0.45, 8e3, press, fixed, (0, 1), 4)
        tell(f"sphere, {RIM * scale:.2f} mm, {unknowns} unknowns, disc of {disc:.3f} mm²: {value:.3f} N/m")
        found.append((unknowns, value))
    told(f"sphere held at {cut:g} mm", "N/m", found)


def block_mesh(scale, depth=None):
    press = Press((0, 0, 30.0), (0, 0, 1))
    sizes = [near(press, 0.25 if depth is None else 0.35)]
    if depth is not None:
        sizes.append(f"0.9 + 0.35 * Abs(Sqrt(x*x + y*y + (z - {30 - depth})^2) - 5)")

    def build(occ):
        box = occ.addBox(0, 0, 0, 30, 30, 30)
        if depth is not None:
            lump = occ.addSphere(0, 0, 30 - depth, 5.0)
            quarter, _ = occ.intersect([(3, lump)], [(3, box)], removeTool=False)
            occ.fragment([(3, box)], quarter)

    mesh = meshed(build, scale, sizes)
    return mesh, press, facets_where(mesh, lambda x: np.abs(x[2]) < 1e-6)


def block():
    for nu in (0.45, 0.49):
        found = []
        for scale in SCALES:
            mesh, press, fixed = block_mesh(scale)
            ones = np.ones(mesh.t.shape[1])
            [value], unknowns, disc = stiffness(mesh, [ones], nu, 8e3, press, fixed, (0, 1), 4)
            tell(f"block, nu {nu}, {RIM * scale:.2f} mm, {unknowns} unknowns, disc of {disc:.3f} mm²: {value:.3f} N/m")
            found.append((unknowns, value))
        told(f"block, nu {nu}", "N/m", found)


def lumps():
    for depth in (8.0, 10.0, 15.0):
        found = []
        for scale in SCALES:
            mesh, press, fixed = block_mesh(scale, depth)
            middles = mesh.p[:, mesh.t[:4]].mean(axis=1)
            inside = np.linalg.norm(middles - np.array([[0], [0], [30 - depth]]), axis=0) < 5.0
            factors = [np.where(inside, 5.0, 1.0), np.ones(len(inside))]
            (lump, none), unknowns, _ = stiffness(mesh, factors, 0.49, 8e3, press, fixed, (0, 1), 4)
            ratio = f"{lump:.3f} / {none:.3f} N/m = {lump / none:.4f}"
            tell(f"lump at {depth:g} mm, {RIM * scale:.2f} mm, {unknowns} unknowns: {ratio}")
            found.append((unknowns, lump / none))
        told(f"lump at {depth:g} mm", "times", found)


# Of the scene `prostate`: Pa, nodules (middle, radius) and their factor.
YOUNG, NODULES, FACTOR = 17e3, (((12, 4, 8), 5.0), ((-11, -6, 6), 3.5)), 4.0
# Above which places it is pressed.
PRESSED = {"over the left nodule": (12, 4), "in the middle": (0, 0)}


def read_organ(file):
    """The vertices (mm), triangles, and triangles of the group `front` of an OBJ file in metres."""
    vertices, triangles, front, group = [], [], [], ""
    for line in pathlib.Path(file).read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([1e3 * float(word) for word in rest[:3]])
        elif kind == "g":
            group = rest
        elif kind == "f":
            triangles.append([int(word.split("/")[0]) - 1 for word in rest])
            if "front" in group:
                front.append(triangles[-1])
    return np.array(vertices), np.array(triangles), np.array(front)


def ball_surface(centre, radius):
    """A polyhedron near a ball, of the same volume."""
    corners = skfem.MeshTet.init_ball(2)
    facets = corners.facets[:, corners.boundary_facets()].T
    used, triangles = np.unique(facets, return_inverse=True)
    vertices, triangles = corners.p[:, used].T, triangles.reshape(facets.shape)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    turned = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
    triangles[turned] = triangles[turned][:, ::-1]
    volume = np.abs(np.einsum("ij,ij->i", np.cross(a, b), c)).sum() / 6
    vertices *= (4 / 3 * np.pi / volume) ** (1 / 3)
    return radius * vertices + np.array(centre), triangles


def is_in(x, vertices, triangles):
    """Whether places (3 x n) are in a convex polyhedron."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    out = np.cross(b - a, c - a)
    return np.all(out @ x <= np.einsum("ij,ij->i", out, a)[:, None], axis=0)


def lies_on(x, corners, slack=1e-6):
    """For places (n x 3), whether they are on one of the triangles of corners m x 3 x 3."""
    a, b, c = (corners[:, k] for k in range(3))
    out = np.cross(b - a, c - a)
    twice = np.linalg.norm(out, axis=1)
    out /= twice[:, None]
    off = np.abs(x @ out.T - np.einsum("ij,ij->i", out, a)) < slack
    for p, q in ((a, b), (b, c), (c, a)):
        inward = np.cross(out, q - p)
        off &= x @ inward.T - np.einsum("ij,ij->i", inward, p) > -slack * twice
    return off.any(axis=1)


def ends_of(vertices, triangles):
    """Places on the edges that belong to one triangle only."""
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    sides, times = np.unique(sides, axis=0, return_counts=True)
    a, b = (vertices[sides[times == 1, end]] for end in (0, 1))
    return np.concatenate([a + by * (b - a) for by in np.arange(10) / 10])


def prostate(file):
    vertices, triangles, front = read_organ(file)
    corners = vertices[triangles]
    balls = [ball_surface(*nodule) for nodule in NODULES]
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.NumThreads", 1)
    first = 1
    for tag, (of_vertices, of_triangles) in enumerate([(vertices, triangles), *balls], 1):
        gmsh.model.addDiscreteEntity(2, tag)
        gmsh.model.mesh.addNodes(2, tag, np.arange(len(of_vertices)) + first, of_vertices.ravel())
        gmsh.model.mesh.addElementsByType(tag, 2, [], (of_triangles + first).ravel())
        gmsh.model.geo.addSurfaceLoop([tag], tag)
        first += len(of_vertices)
    gmsh.model.geo.addVolume([1, *(tag + 2 for tag in range(len(balls)))], 1)
    for tag in range(len(balls)):
        gmsh.model.geo.addVolume([tag + 2], tag + 2)
    gmsh.model.geo.synchronize()
    gmsh.model.addPhysicalGroup(3, list(range(1, len(balls) + 2)))
    gmsh.model.mesh.generate(3)
    first_mesh = read_mesh(skfem.MeshTet)
    edge_of_held = cKDTree(ends_of(vertices, front))
    for name, (x, y) in PRESSED.items():
        press = press_above(corners, x, y)
        tell(f"prostate {name}: at {np.round(press.place, 4)} mm, out {np.round(press.out, 4)}")
        found = []
        for scale in SCALES:
            mesh = first_mesh
            while True:
                middles = mesh.p[:, mesh.t].mean(axis=1)
                sides = mesh.p[:, mesh.t[[0, 0, 0, 1, 1, 2]]] - mesh.p[:, mesh.t[[1, 2, 3, 2, 3, 3]]]
                longest = np.sqrt((sides**2).sum(axis=0)).max(axis=0)
                size = np.minimum(3 * RIM + 0.3 * press.from_rim(middles), 1 + 0.4 * edge_of_held.query(middles.T)[0])
                size = scale * np.minimum(size, 4.5)
                large = np.nonzero(longest > 1.5 * size)[0]
                if len(large) == 0:
                    break
                mesh = mesh.refined(large)
            boundary = mesh.boundary_facets()
            held = lies_on(mesh.p[:, mesh.facets[:, boundary]].mean(axis=1).T, vertices[front])
            factor = np.ones(mesh.t.shape[1])
            for ball in balls:
                factor[is_in(middles, *ball)] = FACTOR
            [value], unknowns, disc = stiffness(mesh, [factor], 0.45, YOUNG, press, boundary[held], (), 1)
            tell(f"prostate, {3 * RIM * scale:.2f} mm, {unknowns} unknowns, disc of {disc:.3f} mm²: {value:.3f} N/m")
            found.append((unknowns, value))
        told(f"prostate {name}", "N/m", found)


def press_above(corners, x, y):
    """The disc around the highest place of the surface above x, y; it presses along the mean normal in it."""
    a, b, c = (corners[:, k] for k in range(3))
    out = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = np.einsum("ij,ij->i", out, a - np.array([x, y, 0.0])) / out[:, 2]
    places = np.stack([np.full_like(height, x), np.full_like(height, y), height], axis=1)
    above = [k for k in np.nonzero(np.isfinite(height))[0] if lies_on(places[k : k + 1], corners[k : k + 1])[0]]
    best = max(above, key=lambda k: height[k])
    press = Press(places[best], out[best] / np.linalg.norm(out[best]))
    for _ in range(3):
        sums = np.zeros(3)
        for i, j in middles_of_parts(16)[0].T:
            sums += out[press.covers((a + i * (b - a) + j * (c - a)).T)].sum(axis=0)
        press.out = sums / np.linalg.norm(sums)
    return press


def main(names):
    cases = {"sphere": sphere, "block": block, "lumps": lumps}
    for name in names:
        case, *numbers = name.split(":")
        if case in cases:
            cases[case](*map(float, numbers))
        else:
            prostate(name)


if __name__ == "__main__":
    main(sys.argv[1:])
