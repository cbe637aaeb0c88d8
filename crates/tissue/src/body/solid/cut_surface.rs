//! The surface within the cuts of a solid, for viewers: both sides of each severed face, smoothed along the way of the blade.
//!
//! A severed face was crossed at one place of the line between the middles of its cubes. Each corner of severed faces gets a vertex: the
//! corner, moved along one axis to the plane that fits the crossings around it best. So the faces, which are steps of the lattice, become a
//! smooth surface through the places that were crossed; a straight cut is plane up to its edges. (A surface net moves vertices to the mean of the
//! crossings: Gibson, Constrained elastic surface nets, MICCAI 1998. Its edges would be half a cube too far inside.) A face is
//! shown twice, once for each of its cubes. A vertex moves with a cube on its own side. Where a cut ends, corners are not
//! doubled, and both sides have the same vertices.
//!
//! The lattice reaches beyond the surface of the tissue: vertices outside are moved to the nearest place of it.

use std::collections::BTreeMap;

use glam::DVec3;

use crate::body::model::Model;
use crate::body::severed::Cuts;
use crate::body::solid::corner_copies::{CornerCopies, corners_of};
use crate::body::solid::cut_plane::{self, Crossings, is_outside};
use crate::body::solid::places::SolidPlaces;
use crate::scene::trilinear;
use crate::shape::CellPlace;

/// A vertex of the surface within a cut.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutVertex {
    /// Its rest position, m, in the tissue's frame.
    pub rest_m: DVec3,
    /// The cell that it moves with, the points by their places in
    /// [`Tissue::shown_displacements_m`](crate::Tissue::shown_displacements_m). The vertex may be outside it: then some weights are negative.
    pub cell: CellPlace,
    /// The version of the topology since which it has this rest position.
    pub version: u32,
}

/// One side of a severed face.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutFace {
    /// Its number: 2n and 2n + 1 for the n-th severed face.
    pub number: u32,
    /// Its vertices, counter-clockwise seen from within the cut.
    pub corners: [u32; 4],
    /// The version of the topology since which it has these.
    pub version: u32,
}

/// The surface within the cuts of a solid. While cuts only grow, vertices and faces keep their numbers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CutSurface {
    /// The vertices, in the order of the versions in which they appeared.
    pub vertices: Vec<CutVertex>,
    /// The faces, ascending by number; those outside the tissue, and those for which there are too many vertices, are left out.
    pub faces: Vec<CutFace>,
}

impl Model {
    /// Returns the largest number of vertices of a [`CutSurface`]: two for each spare place of a solid, 0 for other tissues.
    pub fn max_cut_vertices(&self) -> usize {
        self.places.solid().map_or(0, |places| VERTICES_PER_SPARE * places.spare().len())
    }
}

/// A doubled corner has its own vertex and that of its copy.
const VERTICES_PER_SPARE: usize = 2;

/// A severed face as the search for vertices sees it.
struct SeveredFace {
    /// Its corners in the lattice, counter-clockwise seen from its higher cube.
    corners: [u32; 4],
    /// The places of these corners for the lower and the higher cube.
    places: [[u32; 4]; 2],
    cubes: [u32; 2],
    version: u32,
}

impl CutSurface {
    /// Returns the surface within the cuts of a tissue; empty for one that is no solid. `model` is that of the tissue.
    #[allow(clippy::cast_possible_truncation)]
    pub fn of(model: &Model, cuts: &Cuts) -> Self {
        let (Some(places), Some(copies)) = (model.places.solid(), cuts.copies()) else { return CutSurface::default() };
        let mut corners: BTreeMap<u32, Crossings> = BTreeMap::new();
        let faces: Vec<SeveredFace> = cuts
            .springs()
            .iter()
            .map(|spring| {
                let axis = spring.number as usize / 2;
                let face = SeveredFace::of(places, copies, spring.ends, axis, spring.version);
                let crossing = places.coordinates(spring.ends[0] as usize) + 0.5 + spring.part * DVec3::AXES[axis];
                for corner in face.corners {
                    let known = corners.entry(corner).or_insert_with(|| Crossings::none(face.version));
                    known.add_face(axis, crossing, face.version);
                }
                face
            })
            .collect();
        let around = cut_plane::around(&corners, faces.iter().map(|face| face.corners));
        // A vertex for each place of a corner, by the version since which it is one.
        let since = |corner: u32, place: u32| match copies.since(place as usize) {
            Some(version) => version,
            None => corners[&corner].versions[0],
        };
        let mut uses: BTreeMap<[u32; 2], (u32, u32)> = BTreeMap::new();
        for face in &faces {
            for (places, cube) in face.places.iter().zip(face.cubes) {
                for (place, corner) in places.iter().zip(face.corners) {
                    uses.entry([since(corner, *place), *place]).or_insert((corner, cube));
                }
            }
        }
        let rest_m = |(corner, crossings): (&u32, &Crossings)| (*corner, crossings.vertex_m(places, *corner as usize));
        let rest_m: BTreeMap<u32, DVec3> = around.iter().map(rest_m).collect();
        let max = model.max_cut_vertices();
        let vertices = uses.iter().take(max).map(|([since, _], (corner, cube))| CutVertex {
            version: (*since).max(around[corner].versions[1]),
            ..vertex_in(places, copies, *cube as usize, rest_m[corner])
        });
        let vertices = vertices.collect();
        let number_of: BTreeMap<u32, (u32, u32)> =
            uses.keys().take(max).zip(0..).map(|([since, place], number)| (*place, (number, *since))).collect();
        let mut shown = Vec::new();
        for (face, number) in faces.iter().zip(0..) {
            // By what does not change with further cuts: a client keeps the faces that it was sent.
            if face.corners.iter().all(|corner| is_outside(places, *corner as usize)) {
                continue;
            }
            for side in 0..2_u32 {
                // Beyond the last number, a copy is shown with what it came from: together.
                let numbered = |place: u32| {
                    let origins = std::iter::successors(Some(place), |place| copies.origin_of(*place as usize));
                    origins.into_iter().find_map(|place| number_of.get(&place))
                };
                let found = face.places[side as usize].map(numbered);
                let [Some(a), Some(b), Some(c), Some(d)] = found else { continue };
                let version = [a.1, b.1, c.1, d.1].into_iter().fold(face.version, u32::max);
                // Seen from within the cut, from the other cube.
                let corners = if side == 0 { [a.0, b.0, c.0, d.0] } else { [d.0, c.0, b.0, a.0] };
                shown.push(CutFace { number: 2 * number + side, corners, version });
            }
        }
        CutSurface { vertices, faces: shown }
    }

    /// Returns the vertices that are new or have moved since a version of the topology, with their numbers.
    pub fn vertices_since(&self, version: u32) -> impl Iterator<Item = (u32, &CutVertex)> {
        (0..).zip(&self.vertices).filter(move |(_, vertex)| vertex.version > version)
    }

    /// Returns the faces that are new or have other vertices since a version of the topology.
    pub fn faces_since(&self, version: u32) -> impl Iterator<Item = &CutFace> {
        self.faces.iter().filter(move |face| face.version > version)
    }
}

impl SeveredFace {
    /// Describes the face between two cubes, the second of which is beyond the first along an axis.
    #[allow(clippy::cast_possible_truncation)]
    fn of(places: &SolidPlaces, copies: &CornerCopies, cubes: [u32; 2], axis: usize, version: u32) -> Self {
        let [second, third] = [(axis + 1) % 3, (axis + 2) % 3].map(|axis| 1 << axis);
        let around = [0, second, second | third, third];
        let bits = [1 << axis, 0];
        let [lower, higher] = cubes.map(|cube| cube as usize);
        let in_lattice = places.corners_of(higher);
        let of_side = |cube: usize, bit: usize| {
            let corners = corners_of(places, Some(copies), cube);
            around.map(|number| corners[number | bit] as u32)
        };
        SeveredFace {
            corners: around.map(|number| in_lattice[number] as u32),
            places: [of_side(lower, bits[0]), of_side(higher, bits[1])],
            cubes,
            version,
        }
    }
}

/// How far outside its cube a vertex counts as, in edges: farther out, a sheared cube would throw it away.
const MAX_OUTSIDE: f64 = 0.5;

/// Returns a vertex at a rest position, m, that moves with a cube.
#[allow(clippy::cast_possible_truncation)]
fn vertex_in(places: &SolidPlaces, copies: &CornerCopies, cube: usize, rest_m: DVec3) -> CutVertex {
    let part = ((rest_m - places.rest_m(cube)) / places.edge_m())
        .clamp(DVec3::splat(-MAX_OUTSIDE), DVec3::splat(1.0 + MAX_OUTSIDE));
    let points = corners_of(places, Some(copies), cube).map(|place| place as u32);
    CutVertex { rest_m, cell: CellPlace { points, weights: trilinear(part) }, version: 0 }
}
