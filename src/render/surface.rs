//! The drawn surface of the tissue: vertices in space, refined as for viewers, with normals and texture coordinates.

use glam::{DVec2, DVec3};

use super::drawn_surface::{DrawnSurface, DrawnWound, Vertex};
use super::wound::{open_wound, show_cut_surface};
use palpate_session::surface::burns::VertexBurn;
use palpate_session::surface::{Encoding, Refinement, Skin, Snapshot, Wound, encode};
use palpate_tissue::shape::RestShape;

/// Factor over the median of texture per length above which a triangle is taken to cross a seam of the texture.
const SEAM: f64 = 6.0;

impl DrawnSurface {
    /// Computes the surface from the frame that a viewer would get of `snapshot`, as burnt as `burns` tell, and opens its wound.
    pub(super) fn new(
        shape: &dyn RestShape,
        skin: Option<&Skin>,
        snapshot: &Snapshot,
        of_surface: (Option<&Wound>, &[VertexBurn]),
        refinement: Refinement,
    ) -> Self {
        match skin {
            None => Self::of_grid(shape, snapshot, of_surface, refinement),
            Some(skin) => Self::of_skin(shape, skin, snapshot, of_surface, refinement),
        }
    }

    fn of_skin(
        shape: &dyn RestShape,
        skin: &Skin,
        snapshot: &Snapshot,
        (wound, burns): (Option<&Wound>, &[VertexBurn]),
        refinement: Refinement,
    ) -> Self {
        let moved_m = displacements(snapshot, skin.with_cut_surface(refinement));
        let (least_m, longest_m) = (shape.extent().least_m, shape.longest_side_m());
        let rest_m: Vec<DVec3> = skin.vertices().iter().map(|vertex| skin.rest_m(*vertex)).collect();
        let places_m: Vec<DVec3> = rest_m.iter().zip(&moved_m).map(|(rest_m, moved_m)| *rest_m + *moved_m).collect();
        let of_file = |vertex: u32| skin.places()[vertex as usize] as usize;
        let triangles: Vec<[usize; 3]> = skin.triangles().iter().map(|triangle| triangle.map(of_file)).collect();
        let normals = |places_m: &[DVec3]| {
            let mut normals = vec![DVec3::ZERO; places_m.len()];
            for triangle in &triangles {
                let [a, b, c] = triangle.map(|vertex| places_m[vertex]);
                triangle.iter().for_each(|vertex| normals[*vertex] += (b - a).cross(c - a));
            }
            normals.into_iter().map(|normal| normal.try_normalize().unwrap_or(DVec3::Z)).collect::<Vec<_>>()
        };
        let (at_rest, now) = (normals(&rest_m), normals(&places_m));
        let vertex = |place: usize| {
            let uv = skin.texture_at(skin.vertices()[place]);
            Vertex {
                at_m: places_m[place],
                normal: now[place],
                share: uv.map_or(DVec2::ZERO, |[u, v]| DVec2::new(f64::from(u), f64::from(v))),
                rest: (rest_m[place] - least_m) / longest_m,
                facing: if uv.is_some() { DVec3::ZERO } else { at_rest[place].abs() },
                open: 1.0,
                burn: burn_of(burns, place),
            }
        };
        let mut lines: Vec<[usize; 2]> = triangles
            .iter()
            .flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        lines.sort_unstable();
        lines.dedup();
        let along = (longest_m / skin.edge_m()).ceil() as usize;
        let vertices = (0..places_m.len()).map(vertex).collect();
        let mut surface = DrawnSurface { vertices, triangles, lines, along, wound: DrawnWound::default() };
        if let Some(wound) = wound {
            open_wound(&mut surface, wound, |place| rest_m[place], shape.edge_m());
        }
        let cut_surface = skin.cut_surface(snapshot.cuts());
        if !cut_surface.faces.is_empty() {
            show_cut_surface(&mut surface, &cut_surface, &moved_m[skin.first_cut_place()..], |at_m| {
                (at_m - least_m) / longest_m
            });
        }
        let facing = |place: usize| match wound.and_then(|wound| wound.vertices.get(place.checked_sub(rest_m.len())?)) {
            Some(lip) => at_rest[lip.host as usize].abs(),
            None => at_rest[place].abs(),
        };
        surface.part_at_seams(facing);
        surface
    }

    /// Separates triangles that cross a seam of the texture. A vertex at a seam has the texture coordinates of one
    /// side, so such a triangle would show much of the texture, squeezed. It gets vertices of its own, textured by
    /// the direction `facing`.
    fn part_at_seams(&mut self, facing: impl Fn(usize) -> DVec3) {
        let squeeze = |triangle: &[usize; 3]| {
            let [a, b, c] = triangle.map(|vertex| self.vertices[vertex]);
            let sides = [(a, b), (b, c), (c, a)];
            let longest = |of: &dyn Fn(&(Vertex, Vertex)) -> f64| sides.iter().map(of).fold(0.0, f64::max);
            longest(&|(a, b)| a.share.distance(b.share)) / longest(&|(a, b)| a.rest.distance(b.rest))
        };
        let squeezes: Vec<f64> = self.triangles.iter().map(squeeze).collect();
        let mut sorted = squeezes.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let Some(usual) = sorted.get(sorted.len() / 2).copied() else { return };
        for (triangle, squeeze) in self.triangles.iter_mut().zip(squeezes) {
            if squeeze > SEAM * usual {
                for corner in triangle {
                    let parted = Vertex { facing: facing(*corner), ..self.vertices[*corner] };
                    *corner = self.vertices.len();
                    self.vertices.push(parted);
                }
            }
        }
    }

    fn of_grid(
        shape: &dyn RestShape,
        snapshot: &Snapshot,
        (wound, burns): (Option<&Wound>, &[VertexBurn]),
        refinement: Refinement,
    ) -> Self {
        let points = refinement.coarsest();
        // Normals are interpolated between the points, so that shading is smooth: a bilinear patch has creases of its
        // own.
        let places_m = places(snapshot, points);
        let grid = points.vertices();
        let (normals, open) = (normals(grid, &places_m), openness(points, &places_m));
        let count = refinement.vertices();
        let part = refinement.between() + 1;
        let vertices = places(snapshot, refinement)
            .into_iter()
            .enumerate()
            .map(|(index, at_m)| {
                let [a, b] = [index / count[1], index % count[1]];
                let normal = bilinear(grid, &normals, [a, b], part).try_normalize().unwrap_or(DVec3::Z);
                let share = refinement.texture_at(index);
                let (open, burn) = (bilinear(grid, &open, [a, b], part).x, burn_of(burns, index));
                Vertex { at_m, normal, share, open, burn, ..Vertex::default() }
            })
            .collect();
        let halves = |[a, b, c, d, e, f]: [usize; 6]| [[a, b, c], [d, e, f]];
        let [nx, ny] = count;
        let beyond =
            |index: usize| [(index / ny + 1 < nx).then_some(index + ny), (index % ny + 1 < ny).then_some(index + 1)];
        let mut surface = DrawnSurface {
            vertices,
            triangles: (0..refinement.cell_count()).flat_map(|cell| halves(refinement.triangles(cell))).collect(),
            lines: (0..nx * ny)
                .flat_map(|index| beyond(index).into_iter().flatten().map(move |other| [index, other]))
                .collect(),
            along: nx.max(ny),
            wound: DrawnWound::default(),
        };
        if let Some(wound) = wound {
            open_wound(&mut surface, wound, |vertex| refinement.rest_m(vertex), shape.edge_m());
        }
        surface
    }
}

/// Returns how burnt a vertex is; `burns` are by ascending vertex.
fn burn_of(burns: &[VertexBurn], vertex: usize) -> f64 {
    burns.binary_search_by_key(&vertex, |of| of.vertex as usize).map_or(0.0, |at| f64::from(burns[at].burn))
}

/// Returns the positions of the vertices, m, from the data that a viewer gets.
fn places(snapshot: &Snapshot, refinement: Refinement) -> Vec<DVec3> {
    let rest = |(vertex, moved_m)| refinement.rest_m(vertex) + moved_m;
    displacements(snapshot, refinement).into_iter().enumerate().map(rest).collect()
}

/// Returns the displacements of the vertices, m, from the data that a viewer gets.
fn displacements(snapshot: &Snapshot, refinement: Refinement) -> Vec<DVec3> {
    let [_, ny] = refinement.vertices();
    let mut displacements = vec![DVec3::ZERO; refinement.vertex_count()];
    for patch in encode(snapshot, refinement, Encoding::F32).patches {
        for (k, bytes) in patch.bytes.chunks_exact(12).enumerate() {
            let (a, b) = (patch.first[0] + k / patch.count[1], patch.first[1] + k % patch.count[1]);
            let component = |c: usize| {
                let four = [bytes[4 * c], bytes[4 * c + 1], bytes[4 * c + 2], bytes[4 * c + 3]];
                f64::from(f32::from_le_bytes(four))
            };
            displacements[a * ny + b] = DVec3::new(component(0), component(1), component(2));
        }
    }
    displacements
}

fn normals([nx, ny]: [usize; 2], places: &[DVec3]) -> Vec<DVec3> {
    let at = |i: usize, j: usize| places[i * ny + j];
    (0..nx * ny)
        .map(|index| {
            let (i, j) = (index / ny, index % ny);
            let along_x = at((i + 1).min(nx - 1), j) - at(i.saturating_sub(1), j);
            let along_y = at(i, (j + 1).min(ny - 1)) - at(i, j.saturating_sub(1));
            along_x.cross(along_y).try_normalize().unwrap_or(DVec3::Z)
        })
        .collect()
}

/// Returns in x the fraction of ambient light that reaches each point, from the height of its surroundings at several
/// distances.
fn openness(points: Refinement, places_m: &[DVec3]) -> Vec<DVec3> {
    let [nx, ny] = points.vertices();
    let of = |index: usize| {
        let (i, j) = (index / ny, index % ny);
        let mut slopes = 0.0;
        for reach in [1, 2, 4] {
            let (mut rise_m, mut count) = (0.0, 0.0);
            for [di, dj] in [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1_isize]] {
                let (Some(i), Some(j)) = (i.checked_add_signed(reach * di), j.checked_add_signed(reach * dj)) else {
                    continue;
                };
                if i < nx && j < ny {
                    rise_m += places_m[i * ny + j].z - places_m[index].z;
                    count += 1.0;
                }
            }
            slopes += (rise_m / f64::max(count, 1.0)).max(0.0) / (reach as f64 * points.spacing_m());
        }
        DVec3::splat(1.0 / (1.0 + 0.5 * slopes))
    };
    (0..nx * ny).map(of).collect()
}

/// Interpolates `values`, one per point, at vertex `[a, b]`; there are `part` vertices per spacing.
fn bilinear([nx, ny]: [usize; 2], values: &[DVec3], [a, b]: [usize; 2], part: usize) -> DVec3 {
    let (i, j) = (a / part, b / part);
    let (s, t) = ((a % part) as f64 / part as f64, (b % part) as f64 / part as f64);
    let at = |i: usize, j: usize| values[i.min(nx - 1) * ny + j.min(ny - 1)];
    at(i, j).lerp(at(i + 1, j), s).lerp(at(i, j + 1).lerp(at(i + 1, j + 1), s), t)
}
