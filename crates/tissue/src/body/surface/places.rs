//! The rest positions of a mesh's points by slots (places in memory), and the neighbours of its tiles: for
//! forces and sleep.

use std::ops::Range;

use glam::DVec3;

use super::order::{TABLES, TILE_SLOTS};
use super::slots::{MeshSlots, NO_VERTEX};
use crate::body::tile_links::TileLinks;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::real::Real;
use crate::memory;
use crate::scene::BodyKind;
use crate::scene::graph::{GraphFault, MeshGraph};
use crate::scene::profile::Poke;
use crate::shape::{Extent, PointId};

/// The slots of a mesh, and their positions in space.
#[derive(Debug)]
pub(crate) struct MeshPlaces {
    pub(crate) slots: MeshSlots,
    /// Rest position of the point of each slot, m; NaN for an empty slot.
    rest_m: Vec<DVec3>,
    /// The middle of each row's points, m, and the radius of the ball around them.
    balls: Vec<(DVec3, f64)>,
    /// The ends of the box around each tile's points, m.
    boxes: Vec<[[f64; 2]; 3]>,
    pub(crate) links: TileLinks,
    /// The smallest K″ of an anchored point of each tile divided by the reference value. Empty if all are 1.
    least_pulls: Vec<f64>,
    /// The smallest extra K″/m of any point, at most 0; and the largest relative mass.
    pub(crate) least_extra: f64,
    pub(crate) largest_mass: f64,
    /// The enclosed volume, if it resists changes.
    pub(crate) volume: Option<VolumePlaces>,
}

/// An enclosed volume, by slots.
#[derive(Debug)]
pub(crate) struct VolumePlaces {
    /// a of each slot, in squares of the unit of length.
    pub(crate) areas: Vec<DVec3>,
    /// The fourth power of the unit of length divided by the volume, m. Times κ, it is the stiffness of the
    /// volume's growth.
    pub(crate) stretch_m: f64,
    /// For each tile, the largest a of a movable point divided by its relative K″, if it has an anchor.
    pub(crate) reaches: Vec<f64>,
}

impl VolumePlaces {
    fn of(kind: &dyn BodyKind, slots: &MeshSlots) -> Option<Self> {
        let (volume, shape) = (kind.volume()?, kind.shape());
        let unit_m = shape.edge_m();
        let vertices = slots.vertex_of();
        let area = |vertex: &u32| {
            if *vertex == NO_VERTEX { DVec3::ZERO } else { volume.areas_m2[*vertex as usize] / (unit_m * unit_m) }
        };
        let areas: Vec<DVec3> = memory::collected(vertices.iter().map(area), TABLES);
        let reach = |slot: usize| {
            let moves = vertices[slot] != NO_VERTEX && !shape.is_fixed(PointId::new(vertices[slot] as usize));
            if moves { areas[slot].length() / pull_of(slots, slot).unwrap_or(1.0) } else { 0.0 }
        };
        let of_tile = |tile: usize| tile * TILE_SLOTS..((tile + 1) * TILE_SLOTS).min(areas.len());
        let reaches = (0..slots.tiles()).map(|tile| of_tile(tile).map(reach).fold(0.0, f64::max)).collect();
        Some(VolumePlaces { stretch_m: unit_m.powi(4) / volume.volume_m3, reaches, areas })
    }

    /// Returns a of a slot divided by its relative mass, in squares of the unit of length.
    pub(crate) fn over_mass(&self, slots: &MeshSlots, slot: usize) -> DVec3 {
        let area = self.areas[slot];
        if area == DVec3::ZERO { area } else { area / slots.mass(slot) }
    }
}

/// Returns K″ of a slot's point divided by the reference value; `None` for a point without an anchor. A tissue with such
/// points does not sleep before it is still (`scheme::relaxation`), so what is divided by K″ does not matter for them.
fn pull_of(slots: &MeshSlots, slot: usize) -> Option<f64> {
    let pull = slots.mass(slot) * (1.0 + slots.extra_at(slot));
    (pull > 0.0).then_some(pull)
}

impl MeshPlaces {
    /// Lays out the points and springs of a kind of tissue. The k of a spring is relative to the reference k.
    ///
    /// # Errors
    /// Returns the fault of its springs.
    pub(crate) fn of(kind: &dyn BodyKind, graph: &MeshGraph) -> Result<Self, GraphFault> {
        let slots = MeshSlots::new(graph)?;
        let place_m = |vertex: &u32| if *vertex == NO_VERTEX { DVec3::NAN } else { graph.rest_m[*vertex as usize] };
        let rest_m = memory::collected(slots.vertex_of().iter().map(place_m), TABLES);
        let within =
            |range: Range<usize>| rest_m[range.start..range.end.min(rest_m.len())].iter().filter(|m| m.is_finite());
        #[allow(clippy::cast_precision_loss)]
        let ball = |row: usize| {
            let places = || within(row * BLOCK..(row + 1) * BLOCK);
            let centre_m = places().sum::<DVec3>() / places().count() as f64;
            (centre_m, places().map(|place_m| place_m.distance(centre_m)).fold(0.0, f64::max))
        };
        let box_of = |tile: usize| {
            let places = || within(tile * TILE_SLOTS..(tile + 1) * TILE_SLOTS).copied();
            let Extent { least_m, most_m } = Extent::around(places());
            std::array::from_fn(|axis| [least_m[axis], most_m[axis]])
        };
        let joined = |slot: usize| slots.springs(slot).iter().map(|half| half.to as usize).collect();
        let links = TileLinks::of([slots.blocks(), BLOCK], joined);
        let pulled = |tile: usize| {
            let own = tile * TILE_SLOTS..((tile + 1) * TILE_SLOTS).min(rest_m.len());
            let own = own.filter(|slot| slots.vertex_of()[*slot] != NO_VERTEX);
            own.filter_map(|slot| pull_of(&slots, slot)).reduce(f64::min).unwrap_or(1.0)
        };
        let is_even = slots.masses().is_empty() && slots.extra().is_empty();
        let least_pulls = if is_even { Vec::new() } else { (0..slots.tiles()).map(pulled).collect() };
        let least_extra = slots.extra().iter().copied().fold(0.0, f64::min);
        let largest_mass = slots.masses().iter().copied().reduce(f64::max).unwrap_or(1.0);
        let (balls, boxes) = ((0..slots.blocks()).map(ball).collect(), (0..slots.tiles()).map(box_of).collect());
        let volume = VolumePlaces::of(kind, &slots);
        Ok(MeshPlaces { volume, balls, boxes, links, least_pulls, least_extra, largest_mass, slots, rest_m })
    }

    /// Returns the number of rows in memory.
    pub(crate) fn rows(&self) -> usize {
        self.slots.blocks()
    }

    /// Returns the slot of a point.
    pub(crate) fn slot_of(&self, point: PointId) -> usize {
        self.slots.slot_of()[point.index()] as usize
    }

    /// Returns the point in a slot; for an empty slot, the first point.
    pub(crate) fn point_in(&self, slot: usize) -> PointId {
        let vertex = self.slots.vertex_of()[slot];
        PointId::new(if vertex == NO_VERTEX { 0 } else { vertex as usize })
    }

    /// Returns the springs of a slot: the slot of the other end, the vector to it at rest in units of length,
    /// and k divided by the reference k.
    pub(crate) fn joined(&self, slot: usize) -> impl Iterator<Item = (usize, DVec3, f64)> + '_ {
        let mass = self.slots.mass(slot);
        self.slots.springs(slot).iter().map(move |half| (half.to as usize, half.rest, half.stiffness * mass))
    }

    /// Returns the rest position of a slot's point, m.
    pub(crate) fn rest_m(&self, slot: usize) -> DVec3 {
        self.rest_m[slot]
    }

    /// Returns the rest positions of a row's points, m.
    pub(crate) fn rest_in_row(&self, row: usize) -> &[DVec3] {
        &self.rest_m[row * BLOCK..(row + 1) * BLOCK]
    }

    /// Returns the rows from the first to the last that may have a point within a ball.
    pub(crate) fn rows_within(&self, centre_m: DVec3, radius_m: f64) -> Range<usize> {
        let is_near = |(middle_m, ball_m): &(DVec3, f64)| middle_m.distance(centre_m) - ball_m <= radius_m;
        match (self.balls.iter().position(is_near), self.balls.iter().rposition(is_near)) {
            (Some(first), Some(last)) => first..last + 1,
            _ => 0..0,
        }
    }

    /// Returns the ends of the box around the points of a tile along each axis, m.
    pub(crate) fn box_of(&self, tile: usize) -> &[[f64; 2]; 3] {
        &self.boxes[tile]
    }

    /// Returns the smallest K″ of a tile's anchored points divided by the reference value.
    pub(crate) fn least_pull(&self, tile: usize) -> f64 {
        self.least_pulls.get(tile).copied().unwrap_or(1.0)
    }

    /// Writes the falloff of `poke`, e^(−c·r) divided by the relative mass, over some rows, and which of them are not 0.
    pub(crate) fn fall_off<T: Real>(
        &self,
        poke: &Poke,
        layout: &Layout,
        rows: Range<usize>,
        factors: &mut Field<T>,
        spans: &mut Vec<Range<usize>>,
    ) {
        spans.clear();
        for (factors, row) in factors.chunks_exact_mut(layout.stride).zip(rows) {
            let mut any = false;
            for ((factor, place_m), slot) in factors.iter_mut().zip(self.rest_in_row(row)).zip(row * BLOCK..) {
                let exponent = -poke.falloff_per_m * place_m.distance(poke.centre_m);
                // An empty slot has no place.
                let reaches = exponent >= T::NEGLIGIBLE_EXPONENT && place_m.is_finite();
                let moves = || libm::exp(exponent) / self.slots.mass(slot);
                *factor = if reaches { T::of(moves()) } else { T::default() };
                any |= *factor != T::default();
            }
            spans.push(if any { 0..BLOCK } else { 0..0 });
        }
    }
}
