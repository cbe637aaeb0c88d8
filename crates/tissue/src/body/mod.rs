//! The kinds of tissue, with one folder each: `sheet`, `surface` (meshes) and `solid`. Each has its layout, its sweep, and
//! the contact of a disc with it.

mod advance;
pub(crate) mod burnt_stiffness;
pub(crate) mod disc;
pub(crate) mod elements;
pub(crate) mod footprint;
pub(crate) mod force_field;
pub mod model;
pub(crate) mod severed;
pub(crate) mod sheet;
pub(crate) mod solid;
pub(crate) mod spring_ends;
pub(crate) mod spring_search;
pub mod surface;
pub(crate) mod tables;
pub(crate) mod tile_graph;
pub(crate) mod tile_links;
pub mod window;

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;

use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::Width;
use crate::kernel::real::Real;
use crate::scene::graph::GraphFault;
use crate::scene::profile::Poke;
use crate::scene::{Body, Scene, Sheet};
use crate::shape::{self, PointId};
use disc::TissueDisc;
use sheet::falloff::SheetPoints;
use sheet::footprint::GridDisc;
use solid::SolidPlaces;
use solid::corner_copies::CornerCopies;
use solid::footprint::SolidDisc;
use surface::footprint::MeshDisc;
use surface::{MeshPlaces, VolumePlaces};
use tile_links::TileLinks;

/// Returns a disc of `radius_m` (m) on a tissue, at an arbitrary place: the list of the kinds' discs.
pub(crate) fn disc_on(body: &Body, radius_m: f64) -> Box<dyn TissueDisc> {
    match body {
        Body::Sheet(sheet) => Box::new(GridDisc::new(sheet, radius_m)),
        Body::Mesh(mesh) => Box::new(MeshDisc::new(&mesh.shape, radius_m)),
        Body::Solid(solid) => Box::new(SolidDisc::new(&solid.shape, radius_m)),
    }
}

/// The points of a scene in memory.
pub(crate) struct MemoryLayout {
    /// Rows and columns: those of a sheet, or the slots of a mesh in rows of [`BLOCK`].
    pub(crate) points: [usize; 2],
    /// Row-major places of the fixed points, ascending.
    pub(crate) fixed: Vec<usize>,
    pub(crate) places: Places,
}

/// Where each point of a tissue is in memory, and how it differs from the others. A place is a row-major index.
#[derive(Debug, Clone)]
pub(crate) enum Places {
    /// The points of a sheet are in memory in their order, and alike.
    Sheet(SheetPoints),
    /// Points in any arrangement, as of a mesh, and their springs.
    Surface(Arc<MeshPlaces>),
    /// The corners of the cubes of a solid, and spare places.
    Solid(Arc<SolidPlaces>),
}

impl MemoryLayout {
    /// Lays out the points of a scene.
    ///
    /// # Errors
    /// Returns the fault of springs that can't be laid out.
    pub(crate) fn of(scene: &Scene) -> Result<Self, GraphFault> {
        if let Body::Sheet(sheet) = &scene.body {
            let Sheet { points, spacing_m, .. } = *sheet;
            let places = Places::Sheet(SheetPoints { points, spacing_m });
            return Ok(MemoryLayout { points, fixed: sheet.fixed_indices(), places });
        }
        if let Body::Solid(solid) = &scene.body {
            let places = SolidPlaces::of(solid);
            return Ok(MemoryLayout {
                points: places.size(),
                fixed: places.fixed(),
                places: Places::Solid(Arc::new(places)),
            });
        }
        let (kind, shape) = (scene.body.kind(), scene.shape());
        let places = MeshPlaces::of(kind, &kind.graph())?;
        let points = shape::points(shape).filter(|point| shape.is_fixed(*point));
        let mut fixed: Vec<usize> = points.map(|point| places.slot_of(point)).collect();
        fixed.sort_unstable();
        Ok(MemoryLayout { points: [places.rows(), BLOCK], fixed, places: Places::Surface(Arc::new(places)) })
    }
}

impl Places {
    /// Returns whether gravity moves a tissue that no tool touches.
    pub(crate) fn is_pulled(&self) -> bool {
        matches!(self, Places::Solid(places) if places.pull_m_per_s2 != DVec3::ZERO)
    }

    /// Returns what a mesh has, if the tissue is one.
    fn surface(&self) -> Option<&MeshPlaces> {
        match self {
            Places::Surface(places) => Some(places),
            Places::Sheet(_) | Places::Solid(_) => None,
        }
    }

    /// Returns what a solid has, if the tissue is one.
    pub(crate) fn solid(&self) -> Option<&Arc<SolidPlaces>> {
        if let Places::Solid(places) = self { Some(places) } else { None }
    }

    /// Returns which tiles are joined, but for a sheet, whose tiles are joined to those around them.
    pub(crate) fn links(&self) -> Option<&TileLinks> {
        match self {
            Places::Sheet(_) => None,
            Places::Surface(places) => Some(&places.links),
            Places::Solid(places) => Some(&places.links),
        }
    }

    /// Returns the place of a point.
    pub(crate) fn place_of(&self, point: PointId) -> usize {
        match self {
            Places::Sheet(_) => point.index(),
            Places::Surface(places) => places.slot_of(point),
            Places::Solid(places) => places.place_of(point),
        }
    }

    /// Returns the point at a place; for an empty place, any point.
    pub(crate) fn point_at(&self, place: usize) -> PointId {
        match self {
            Places::Sheet(_) => PointId::new(place),
            Places::Surface(places) => places.point_in(place),
            Places::Solid(places) => places.point_at(place),
        }
    }

    /// Returns the point at each place and the place of each of `points` points; `None` if their order is that of the
    /// points.
    pub(crate) fn order(&self, points: usize) -> Option<[&[u32]; 2]> {
        if let Places::Solid(places) = self {
            return Some(places.order());
        }
        let slots = &self.surface()?.slots;
        // Empty places are at the end.
        Some([&slots.vertex_of()[..points], slots.slot_of()])
    }

    /// Returns whether points may differ in mass and anchor stiffness.
    pub(crate) fn differ(&self) -> bool {
        !matches!(self, Places::Sheet(_))
    }

    /// Returns the mass at a place divided by the reference mass.
    pub(crate) fn relative_mass(&self, place: usize) -> f64 {
        match self {
            Places::Sheet(_) => 1.0,
            Places::Surface(places) => places.slots.mass(place),
            Places::Solid(places) => places.mass(place),
        }
    }

    /// Returns the largest relative mass.
    pub(crate) fn largest_mass(&self) -> f64 {
        match self {
            Places::Sheet(_) => 1.0,
            Places::Surface(places) => places.largest_mass,
            Places::Solid(places) => places.largest_mass,
        }
    }

    /// Returns K″/m at a place divided by the reference value, minus 1.
    pub(crate) fn extra_anchor(&self, place: usize) -> f64 {
        self.surface().map_or(0.0, |places| places.slots.extra_at(place))
    }

    /// Returns the smallest K″/m divided by the reference value, minus 1; at most 0.
    pub(crate) fn least_extra_anchor(&self) -> f64 {
        self.surface().map_or(0.0, |places| places.least_extra)
    }

    /// Returns the springs of a mesh at a place: the place of the other end, the vector to it at rest in units of length,
    /// and k divided by the reference k. A sheet has none of its own: its springs are the same everywhere.
    pub(crate) fn joined(&self, place: usize) -> impl Iterator<Item = (usize, DVec3, f64)> + '_ {
        self.surface().into_iter().flat_map(move |places| places.joined(place))
    }

    /// Returns the enclosed volume by places, if it resists changes.
    pub(crate) fn volume(&self) -> Option<&VolumePlaces> {
        self.surface()?.volume.as_ref()
    }

    /// Returns the first and the end of the rows and of the columns of points that a force reaches. Beyond them its
    /// factor is 0 in the format `T`.
    pub(crate) fn reached<T: Real>(&self, poke: &Poke) -> [[usize; 2]; 2] {
        let reach_m = -T::NEGLIGIBLE_EXPONENT / poke.falloff_per_m;
        match self {
            Places::Sheet(points) => points.reached(poke.centre_m, reach_m),
            Places::Surface(places) => {
                let rows = places.rows_within(poke.centre_m, reach_m);
                [[rows.start, rows.end], [0, if rows.is_empty() { 0 } else { BLOCK }]]
            }
            Places::Solid(places) => places.reached(poke.centre_m, reach_m),
        }
    }

    /// Writes the falloff of `poke`, e^(−c·r) divided by the relative mass, over some rows and columns, with whole rows
    /// in `factors`, and which part of each row is not 0. `copies` are those of a solid with cuts.
    pub(crate) fn fall_off<T: Real>(
        &self,
        width: Width,
        (poke, copies): (&Poke, Option<&CornerCopies>),
        layout: &Layout,
        [rows, columns]: [Range<usize>; 2],
        factors: &mut Field<T>,
        spans: &mut Vec<Range<usize>>,
    ) {
        match self {
            Places::Sheet(points) => points.fall_off(width, poke, layout, [rows, columns], factors, spans),
            Places::Surface(places) => places.fall_off(poke, layout, rows, factors, spans),
            Places::Solid(places) => {
                let corner_of = |place: usize| copies.map_or(place, |copies| copies.corner_of(place));
                places.fall_off(poke, corner_of, layout, [rows, columns], factors, spans);
            }
        }
    }

    /// Returns the distance at rest of the point at a place from a control point, m.
    pub(crate) fn away_m(&self, place: usize, centre_m: DVec3) -> f64 {
        match self {
            Places::Sheet(points) => points.away_m(place, centre_m),
            Places::Surface(places) => places.rest_m(place).distance(centre_m),
            Places::Solid(places) => places.rest_m(place).distance(centre_m),
        }
    }

    /// Adds what tells the tissue of `scene` from another with the same coefficients to the bytes of its identity.
    pub(crate) fn identify(&self, scene: &Scene, add: &mut impl FnMut(&[u8])) {
        let order = self.surface().map_or(&[][..], |places| places.slots.vertex_of());
        scene.body.kind().identify(order, add);
        // Which faces can be severed depends on it.
        self.solid().iter().for_each(|places| add(&(places.spare().len() as u64).to_le_bytes()));
    }
}
