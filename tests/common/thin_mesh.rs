//! Random meshes with thin parts, as files: threads, needles, tubes, shells, hairpins and folded slabs.
#![allow(dead_code, unreachable_pub, clippy::cast_possible_truncation)]

use std::f64::consts::{PI, TAU};

use glam::DVec3;

/// A triangle mesh, in metres, and what it is.
pub struct ThinMesh {
    pub kind: &'static str,
    pub places_m: Vec<DVec3>,
    /// Vertices from 0.
    pub triangles: Vec<[u32; 3]>,
    /// Half of the least thickness, m.
    pub thickness_m: f64,
}

/// The kinds, in the order of their numbers.
pub const KINDS: [&str; 6] = ["thread", "needle", "tube", "shell", "hairpin", "slab"];

/// A closed thread along z from 0.
pub fn thread(radius_m: f64, length_m: f64, around: u32, along: u32) -> ThinMesh {
    let mut mesh = ThinMesh { kind: "thread", places_m: Vec::new(), triangles: Vec::new(), thickness_m: radius_m };
    let line = |part: f64| (DVec3::new(0.0, 0.0, length_m * part), DVec3::X, DVec3::Y);
    mesh.tube(around, along, radius_m, &|_| 1.0, &line, true);
    mesh
}

/// A random mesh of a kind.
pub fn thin_mesh(dice: &mut fastrand::Rng, kind: usize) -> ThinMesh {
    let kind = KINDS[kind % KINDS.len()];
    let mut decades = |from: f64, to: f64| 10_f64.powf(from + (to - from) * dice.f64());
    let radius_m = decades(-3.5, -2.3);
    let length_m = radius_m * decades(0.8, 1.6);
    let around = dice.u32(5..17);
    let edge_m = TAU * radius_m / f64::from(around);
    let along = ((length_m / edge_m * (0.5 + dice.f64())) as u32).clamp(3, 60);
    let mut mesh = ThinMesh { kind, places_m: Vec::new(), triangles: Vec::new(), thickness_m: radius_m };
    let straight = |part: f64| (DVec3::new(0.0, 0.0, length_m * part), DVec3::X, DVec3::Y);
    match kind {
        "thread" => mesh.tube(around, along, radius_m, &|_| 1.0, &straight, true),
        "needle" => mesh.tube(around, along, radius_m, &|part| 1.0 - 0.95 * part, &straight, true),
        "tube" => mesh.tube(around, along, radius_m, &|_| 1.0, &straight, false),
        "shell" => mesh.dome(around, along.min(12), 3.0 * radius_m, 0.3 + 1.5 * dice.f64()),
        "hairpin" => {
            // Two limbs side by side, which almost meet.
            let (bend_m, limb_m) = (radius_m * (1.1 + dice.f64()), 0.5 * length_m);
            let whole_m = 2.0 * limb_m + PI * bend_m;
            let bent = move |part: f64| {
                let at_m = part * whole_m;
                let (place_m, ahead) = if at_m < limb_m {
                    (DVec3::new(-bend_m, 0.0, at_m), DVec3::Z)
                } else if at_m > whole_m - limb_m {
                    (DVec3::new(bend_m, 0.0, whole_m - at_m), -DVec3::Z)
                } else {
                    let angle = (at_m - limb_m) / bend_m;
                    let place = bend_m * DVec3::new(-angle.cos(), 0.0, angle.sin());
                    (place + limb_m * DVec3::Z, DVec3::new(angle.sin(), 0.0, angle.cos()))
                };
                (place_m, DVec3::Y.cross(ahead), DVec3::Y)
            };
            mesh.tube(around, (2 * along).min(90), radius_m, &|_| 1.0, &bent, true);
        }
        _ => mesh.slab(along.clamp(4, 30), dice.u32(4..10), length_m, 0.1 * radius_m + 0.4 * radius_m * dice.f64()),
    }
    let off_m = 0.1 * edge_m * dice.f64();
    for place_m in &mut mesh.places_m {
        *place_m += off_m * DVec3::from_array([(); 3].map(|()| 2.0 * dice.f64() - 1.0));
    }
    mesh
}

impl ThinMesh {
    /// Rings around a middle line, which gives its place and two directions across, closed by a pole at each end or
    /// open.
    fn tube(
        &mut self,
        around: u32,
        along: u32,
        radius_m: f64,
        taper: &dyn Fn(f64) -> f64,
        line: &dyn Fn(f64) -> (DVec3, DVec3, DVec3),
        closed: bool,
    ) {
        for ring in 0..=along {
            let part = f64::from(ring) / f64::from(along);
            let (middle_m, x, y) = line(part);
            for k in 0..around {
                let turn = TAU * (f64::from(k) + 0.5 * f64::from(ring % 2)) / f64::from(around);
                self.places_m.push(middle_m + radius_m * taper(part) * (turn.cos() * x + turn.sin() * y));
            }
        }
        for ring in 0..along {
            for k in 0..around {
                let next = (k + 1) % around;
                let [a, b, c, d] =
                    [ring * around + k, ring * around + next, (ring + 1) * around + k, (ring + 1) * around + next];
                self.triangles.extend(if ring % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] });
            }
        }
        if closed {
            let first = self.places_m.len() as u32;
            for (part, sign) in [(0.0, -1.0), (1.0, 1.0)] {
                let (middle_m, x, y) = line(part);
                self.places_m.push(middle_m + sign * 0.6 * radius_m * taper(part) * x.cross(y));
            }
            for k in 0..around {
                let (next, last) = ((k + 1) % around, along * around);
                self.triangles.extend([[first, next, k], [first + 1, last + k, last + next]]);
            }
        }
    }

    /// A part of a sphere, open.
    fn dome(&mut self, around: u32, along: u32, radius_m: f64, opening: f64) {
        self.places_m.push(radius_m * DVec3::Z);
        for ring in 1..=along {
            let down = opening * f64::from(ring) / f64::from(along);
            for k in 0..around {
                let turn = TAU * f64::from(k) / f64::from(around);
                self.places_m.push(radius_m * DVec3::new(down.sin() * turn.cos(), down.sin() * turn.sin(), down.cos()));
            }
        }
        for k in 0..around {
            let next = (k + 1) % around;
            self.triangles.push([0, 1 + k, 1 + next]);
            for ring in 1..along {
                let [above, below] = [1 + (ring - 1) * around, 1 + ring * around];
                self.triangles.extend([[above + k, below + k, below + next], [above + k, below + next, above + next]]);
            }
        }
    }

    /// A closed slab whose two faces are `2 half_m` apart, bent so that it folds onto itself.
    fn slab(&mut self, rows: u32, columns: u32, length_m: f64, half_m: f64) {
        let (bend_m, width_m) = (1.5 * half_m + 0.1 * length_m, 0.5 * length_m);
        self.thickness_m = half_m;
        let at = |row: u32, column: u32, side: u32| {
            let at_m = length_m * f64::from(row) / f64::from(rows);
            let straight_m = 0.5 * (length_m - PI * bend_m).max(0.0);
            let (place_m, normal) = if at_m < straight_m {
                (DVec3::new(at_m, 0.0, 0.0), DVec3::Z)
            } else {
                let angle = ((at_m - straight_m) / bend_m).min(PI);
                let rest_m = (at_m - straight_m - PI * bend_m).max(0.0);
                let place_m =
                    DVec3::new(straight_m + bend_m * angle.sin() - rest_m, 0.0, -bend_m * (1.0 - angle.cos()));
                (place_m, DVec3::new(angle.sin(), 0.0, angle.cos()))
            };
            let across_m = width_m * f64::from(column) / f64::from(columns) * DVec3::Y;
            place_m + across_m + half_m * if side == 0 { normal } else { -normal }
        };
        let number = |row: u32, column: u32, side: u32| (side * (rows + 1) + row) * (columns + 1) + column;
        for side in 0..2 {
            for row in 0..=rows {
                for column in 0..=columns {
                    self.places_m.push(at(row, column, side));
                }
            }
        }
        for row in 0..rows {
            for column in 0..columns {
                for side in 0..2 {
                    let [a, b, c, d] = [
                        number(row, column, side),
                        number(row + 1, column, side),
                        number(row, column + 1, side),
                        number(row + 1, column + 1, side),
                    ];
                    self.triangles.extend(if side == 0 { [[a, b, c], [b, d, c]] } else { [[a, c, b], [b, c, d]] });
                }
            }
        }
        let mut rim: Vec<[u32; 2]> = Vec::new();
        rim.extend((0..rows).map(|row| [row, 0]));
        rim.extend((0..columns).map(|column| [rows, column]));
        rim.extend((0..rows).map(|row| [rows - row, columns]));
        rim.extend((0..columns).map(|column| [0, columns - column]));
        for k in 0..rim.len() {
            let [[i, j], [m, n]] = [rim[k], rim[(k + 1) % rim.len()]];
            let [a, b, c, d] = [number(i, j, 0), number(m, n, 0), number(i, j, 1), number(m, n, 1)];
            self.triangles.extend([[a, c, b], [b, c, d]]);
        }
    }

    /// As an OBJ file, in metres.
    pub fn obj(&self) -> String {
        let vertices = self.places_m.iter().map(|place_m| format!("v {} {} {}\n", place_m.x, place_m.y, place_m.z));
        let triangles = self.triangles.iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1));
        vertices.chain(triangles).collect()
    }
}
