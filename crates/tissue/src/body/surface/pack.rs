//! The springs of a mesh in the arrangement that the vectors of a width read.
//!
//! A spring has five coefficients: the three components of the rest vector D0, 1/L0², and the stiffness divided
//! by the relative mass of its own end. A row holds one spring for each lane, coefficient by coefficient; if a
//! lane has none, all are 0. There are two arrangements of rows:
//!
//! - [`Rows`], for any width: row k of a vector of slots has the k-th spring of each. The neighbours are loaded from
//!   their records, wherever these are.
//! - [`Halo`], for vectors as long as a block that can move lanes: the block's outside neighbours, its halo, are loaded
//!   once, and each row picks its neighbours among these and the block's own points. Points with more springs than most
//!   of the block would leave many lanes of the last rows empty. So the springs beyond the *plain* rows are *packed*:
//!   each lane of such a row has a spring of any point of the block, and its force is moved to that point's lane.

use glam::DVec3;
use palpate_geometry::work::spend;

use super::order::TABLES;
use super::slots::{HALO, HalfSpring, MeshSlots, part};
use crate::body::severed::NO_ANCHOR;
use crate::kernel::field::{BLOCK, Field};
use crate::kernel::lanes::{LaneShape, Names, record_place};
use crate::kernel::real::Real;
use crate::memory;

/// Number of coefficients of a spring.
pub(super) const COEFFICIENTS: usize = 5;

/// Which of them is the stiffness, the last.
const STIFFNESS: usize = 4;

/// The springs of a mesh for a number format and a width. Independent of substep and scheme.
#[derive(Debug)]
pub(crate) struct MeshSprings<T> {
    /// The shape of the vectors that they are arranged for.
    pub(super) shape: LaneShape,
    /// The number of slots.
    pub(super) slots: usize,
    pub(super) arrangement: Arrangement<T>,
    /// The relative mass of each slot. `None` if all are 1.
    pub(super) masses: Option<Field<T>>,
    /// The extra K″/m of each slot divided by the reference value. `None` if all are 0.
    pub(super) extra: Option<Field<T>>,
    /// Σ (k/m)·D0 of the severed springs of each slot, three planes of the layout: what a pretension leaves of them. `None` if
    /// nothing is severed.
    pub(super) loads: Option<Field<T>>,
}

#[derive(Debug)]
pub(super) enum Arrangement<T> {
    Rows(Rows<T>),
    Halo(Halo<T>),
}

/// The springs of each vector of slots: the k-th springs in row k.
#[derive(Debug)]
pub(super) struct Rows<T> {
    /// The first row of each vector of slots; then the number of all rows.
    pub(super) firsts: Vec<u32>,
    /// Where the record of the other end begins, for each row and lane.
    pub(super) places: Vec<u32>,
    pub(super) coefficients: Field<T>,
}

/// The springs of each block, in one or more parts.
#[derive(Debug)]
pub(super) struct Halo<T> {
    /// The first part of each block; then the number of all parts.
    pub(super) firsts: Vec<u32>,
    pub(super) parts: Vec<Part>,
    /// Where the records of the halos begin: each halo has whole vectors.
    pub(super) places: Vec<u32>,
    /// The other ends of each row: first the block's own points, then those of its halo.
    pub(super) others: Vec<Names>,
    pub(super) coefficients: Field<T>,
    /// The lanes of the springs' own ends in each packed row, and the number of passes that move its forces.
    pub(super) owners: Vec<Names>,
    pub(super) passes: Vec<u8>,
    /// For each pass, the lane whose force moves to each lane.
    pub(super) returns: Vec<Names>,
}

/// A part of a block's springs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    /// The first row.
    pub(super) row: u32,
    /// Number of plain rows, and of the packed rows after them.
    pub(super) plain: u32,
    pub(super) packed: u32,
    /// The first packed row among all packed rows, and the first pass.
    pub(super) first_packed: u32,
    pub(super) first_pass: u32,
    /// The first place of the halo.
    pub(super) place: u32,
    /// Half vectors of the halo: 1 to 6. With [`ONE_AND_A_HALF`], the second has only the lanes of
    /// [`Vector::half_of_records`](crate::kernel::lanes::Vector::half_of_records).
    pub(super) halves: u32,
}

/// The most common size of a halo: 17 to 24 points around a block.
pub(super) const ONE_AND_A_HALF: u32 = 3;

/// Returns the number of half vectors that hold a halo.
fn halves_of(around: &[u32]) -> usize {
    around.len().div_ceil(BLOCK / 2).max(1)
}

/// Returns the lane of a point of a halo, counted over its vectors.
fn halo_lane(number: usize, halves: usize) -> usize {
    let beyond = number.checked_sub(BLOCK).filter(|_| halves == ONE_AND_A_HALF as usize);
    beyond.map_or(number, |beyond| BLOCK + beyond / 2 * 4 + beyond % 2)
}

impl<T: Real> MeshSprings<T> {
    /// Returns the relative mass of each slot, and the extra K″/m of each; null if all masses are 1, or all
    /// extra values 0.
    pub(crate) fn masses_and_extra(&self) -> [*const T; 2] {
        [&self.masses, &self.extra].map(|field| field.as_ref().map_or(std::ptr::null(), |field| field.as_ptr()))
    }

    /// Arranges the springs of a mesh for vectors of a shape.
    pub(crate) fn new(slots: &MeshSlots, shape: LaneShape) -> Self {
        let of_slots = |values: &[f64]| {
            (!values.is_empty()).then(|| {
                let mut field = Field::of_length(values.len());
                field.iter_mut().zip(values).for_each(|(to, value)| *to = T::of(*value));
                field
            })
        };
        let arrangement = if shape.picks && shape.lanes == BLOCK {
            Arrangement::Halo(Halo::new(slots))
        } else {
            Arrangement::Rows(Rows::new(slots, shape.lanes))
        };
        let (masses, extra) = (of_slots(slots.masses()), of_slots(slots.extra()));
        MeshSprings { shape, slots: slots.vertex_of().len(), arrangement, masses, extra, loads: None }
    }
}

impl<T: Real> MeshSprings<T> {
    /// Sets what is left of the severed springs of a slot under a pretension; `is_severed` tells which of its springs are.
    pub(crate) fn set_load(&mut self, slots: &MeshSlots, slot: usize, is_severed: impl Fn(usize) -> bool) {
        let of = slots.springs(slot).iter().enumerate().filter(|(number, _)| is_severed(*number));
        let load: DVec3 = of.map(|(_, half)| half.stiffness * half.rest).sum();
        let plane = slots.layout::<T>().plane;
        let loads = self.loads.get_or_insert_with(|| Field::of_length(3 * plane));
        for c in 0..3 {
            loads[c * plane + slot] = T::of(load[c]);
        }
    }

    /// Severs or restores the anchor spring of a slot.
    pub(crate) fn set_anchor(&mut self, slots: &MeshSlots, slot: usize, is_severed: bool) {
        let count = self.slots;
        let extra = self.extra.get_or_insert_with(|| Field::of_length(count));
        extra[slot] = T::of(if is_severed { NO_ANCHOR } else { slots.extra_at(slot) });
    }

    /// Forgets that anchor springs were severed, once all are whole again.
    pub(crate) fn forget_anchors(&mut self, slots: &MeshSlots) {
        if slots.extra().is_empty() {
            self.extra = None;
        }
    }

    /// Changes the factor of the stiffness of the spring of a slot that has this number, at this end, from one value to another; 0: it is severed. The
    /// others stay as they are.
    pub(crate) fn set(&mut self, slots: &MeshSlots, slot: usize, number: usize, factors: [f64; 2]) {
        let half = &slots.springs(slot)[number];
        let values = coefficients::<T>(half);
        let stiffness = STIFFNESS * self.shape.lanes;
        let [from, to] = factors.map(|factor| T::of(factor * half.stiffness));
        let set = |row: &mut [T], lane: usize| {
            let lanes = row.len() / COEFFICIENTS;
            let is_this = (0..STIFFNESS).all(|which| row[which * lanes + lane] == values[which]);
            // Several springs may join the same points: one that is as stiff as this one is now.
            let is_found = is_this && row[stiffness + lane] == from;
            if is_found {
                row[stiffness + lane] = to;
            }
            is_found
        };
        let length = COEFFICIENTS * self.shape.lanes;
        match &mut self.arrangement {
            Arrangement::Rows(rows) => {
                let row = rows.firsts[slot / self.shape.lanes] as usize + number;
                set(&mut rows.coefficients[row * length..][..length], slot % self.shape.lanes);
            }
            Arrangement::Halo(halo) => {
                let Halo { firsts, parts, coefficients, owners, others, .. } = halo;
                let [from, to] = [0, 1].map(|next| firsts[slot / BLOCK + next] as usize);
                let (lane, other, outside) = (slot % BLOCK, half.to as usize, slots.outside(slot / BLOCK));
                for (number, part) in parts[from..to].iter().enumerate() {
                    let around = outside.chunks(HALO).nth(number).unwrap_or_default();
                    // The lane of the other end, as `Packing::push_row` names it.
                    let named = match around.binary_search(&half.to) {
                        _ if other / BLOCK == slot / BLOCK => other % BLOCK,
                        Ok(at) => BLOCK + halo_lane(at, part.halves as usize),
                        Err(_) => continue,
                    };
                    let first = part.row as usize;
                    for row in 0..(part.plain + part.packed) as usize {
                        let values = &mut coefficients[(first + row) * length..][..length];
                        let packed = row.checked_sub(part.plain as usize);
                        let ends = &others[first + row];
                        let is_found = match packed.map(|packed| &owners[part.first_packed as usize + packed]) {
                            None => ends.lane(lane) == named && set(values, lane),
                            Some(owners) => {
                                (0..BLOCK).any(|n| owners.lane(n) == lane && ends.lane(n) == named && set(values, n))
                            }
                        };
                        if is_found {
                            return;
                        }
                    }
                }
            }
        }
    }
}

/// Returns the coefficients of a spring.
pub(super) fn coefficients<T: Real>(half: &HalfSpring) -> [T; COEFFICIENTS] {
    // A component below the normal range of squares would be slow, and changes nothing.
    let rest =
        half.rest.to_array().map(T::of).map(|c| if c.magnitude() < T::of(T::MIN_MAGNITUDE) { T::default() } else { c });
    let squared: f64 = rest.iter().map(|c| c.wide() * c.wide()).sum();
    [rest[0], rest[1], rest[2], T::of(squared.recip()), T::of(half.stiffness)]
}

/// Writes a spring to a lane of a row.
fn write<T: Real>(row: &mut [T], lane: usize, half: &HalfSpring) {
    let lanes = row.len() / COEFFICIENTS;
    for (which, value) in coefficients(half).into_iter().enumerate() {
        row[which * lanes + lane] = value;
    }
}

#[allow(clippy::cast_possible_truncation)]
impl<T: Real> Rows<T> {
    fn new(slots: &MeshSlots, lanes: usize) -> Self {
        let count = slots.vertex_of().len();
        let mut firsts = memory::with_room(count / lanes + 1, TABLES);
        let mut rows = 0_usize;
        for first in (0..count).step_by(lanes) {
            firsts.push(rows as u32);
            rows += (first..first + lanes).map(|slot| slots.springs(slot).len()).max().unwrap_or(0);
        }
        firsts.push(rows as u32);
        let mut places: Vec<u32> = memory::zeroed(rows * lanes, TABLES);
        let mut coefficients = Field::of_length(rows * lanes * COEFFICIENTS);
        for (vector, rows) in firsts.windows(2).enumerate() {
            spend(1 + lanes * (rows[1] - rows[0]) as usize);
            for (k, row) in (rows[0] as usize..rows[1] as usize).enumerate() {
                let into = &mut coefficients[row * lanes * COEFFICIENTS..][..lanes * COEFFICIENTS];
                for lane in 0..lanes {
                    let slot = vector * lanes + lane;
                    let half = slots.springs(slot).get(k);
                    half.into_iter().for_each(|half| write(into, lane, half));
                    places[row * lanes + lane] = record_place(half.map_or(slot, |half| half.to as usize)) as u32;
                }
            }
        }
        Rows { firsts, places, coefficients }
    }
}

/// The spring of each lane in a row, if it has one, and the lane of its own end.
type Lanes<'a> = [Option<(usize, &'a HalfSpring)>; BLOCK];

/// A halo under construction.
struct Packing<T> {
    halo: Halo<T>,
    coefficients: Vec<T>,
}

#[allow(clippy::cast_possible_truncation)]
impl<T: Real> Halo<T> {
    fn new(slots: &MeshSlots) -> Self {
        // Approximate memory. (A third of the lanes may be empty.)
        let bytes = slots.count() * (COEFFICIENTS * size_of::<T>() + 4) * 3 / 2;
        memory::require(bytes as u64, TABLES);
        let halo = Halo {
            firsts: Vec::new(),
            parts: Vec::new(),
            places: Vec::new(),
            others: Vec::new(),
            coefficients: Field::of_length(0),
            owners: Vec::new(),
            passes: Vec::new(),
            returns: Vec::new(),
        };
        let mut packing = Packing { halo, coefficients: Vec::new() };
        for block in 0..slots.blocks() {
            packing.halo.firsts.push(packing.halo.parts.len() as u32);
            let outside = slots.outside(block);
            spend(64 + 8 * outside.len());
            let mut later: [&[HalfSpring]; BLOCK] = std::array::from_fn(|lane| slots.springs(block * BLOCK + lane));
            for number in 0..outside.len().div_ceil(HALO).max(1) {
                let springs: [&[HalfSpring]; BLOCK] = std::array::from_fn(|lane| {
                    let count = later[lane].partition_point(|half| part(&outside, block, half.to) <= number);
                    let (springs, others) = later[lane].split_at(count);
                    later[lane] = others;
                    springs
                });
                let from = (number * HALO).min(outside.len());
                packing.push_part(block, &outside[from..(from + HALO).min(outside.len())], &springs);
            }
        }
        let Packing { mut halo, coefficients } = packing;
        halo.firsts.push(halo.parts.len() as u32);
        halo.coefficients = Field::of_length(coefficients.len());
        halo.coefficients.copy_from_slice(&coefficients);
        halo
    }
}

#[allow(clippy::cast_possible_truncation)]
impl<T: Real> Packing<T> {
    /// Adds the springs of a block that end in it or in `around`.
    fn push_part(&mut self, block: usize, around: &[u32], springs: &[&[HalfSpring]; BLOCK]) {
        let plain = plain_rows(springs);
        let packed = beyond(springs, plain);
        let halves = halves_of(around);
        let halo = &mut self.halo;
        halo.parts.push(Part {
            row: halo.others.len() as u32,
            plain: plain as u32,
            packed: packed.len().div_ceil(BLOCK) as u32,
            first_packed: halo.owners.len() as u32,
            first_pass: halo.returns.len() as u32,
            place: halo.places.len() as u32,
            halves: halves as u32,
        });
        let from = halo.places.len();
        halo.places.resize(from + halves.div_ceil(2) * BLOCK, record_place(block * BLOCK) as u32);
        for (number, slot) in around.iter().enumerate() {
            halo.places[from + halo_lane(number, halves)] = record_place(*slot as usize) as u32;
        }
        for k in 0..plain {
            self.push_row(block, around, &std::array::from_fn(|lane| Some(lane).zip(springs[lane].get(k))));
        }
        for row in packed.chunks(BLOCK) {
            let lanes: Lanes<'_> = std::array::from_fn(|n| row.get(n).map(|&(lane, k)| (lane, &springs[lane][k])));
            self.push_row(block, around, &lanes);
            let halo = &mut self.halo;
            let owners = std::array::from_fn(|n| row.get(n).map_or(n, |(lane, _)| *lane) as u8);
            halo.owners.push(Names::of(owners, BLOCK));
            let passes = passes(row);
            halo.passes.push(passes as u8);
            for pass in 0..passes {
                halo.returns.push(Names::of_some(std::array::from_fn(|lane| {
                    let mut own = row.iter().enumerate().filter(|(_, spring)| spring.0 == lane);
                    own.nth(pass).map(|(n, _)| n as u8)
                })));
            }
        }
    }

    /// Adds a row.
    fn push_row(&mut self, block: usize, around: &[u32], lanes: &Lanes<'_>) {
        let halves = halves_of(around);
        let from = self.coefficients.len();
        self.coefficients.resize(from + BLOCK * COEFFICIENTS, T::default());
        let mut others = [0; BLOCK];
        for (n, spring) in lanes.iter().enumerate() {
            others[n] = n as u8;
            if let Some((_, half)) = spring {
                write(&mut self.coefficients[from..], n, half);
                let to = half.to as usize;
                let number = || around.partition_point(|slot| *slot < half.to);
                let lane = if to / BLOCK == block { to % BLOCK } else { BLOCK + halo_lane(number(), halves) };
                others[n] = lane as u8;
            }
        }
        self.halo.others.push(Names::of(others, BLOCK));
    }
}

/// Returns (lane, number) of the springs beyond the first `plain` ones of each lane, in the order of their
/// numbers.
fn beyond(springs: &[&[HalfSpring]; BLOCK], plain: usize) -> Vec<(usize, usize)> {
    let most = springs.iter().map(|springs| springs.len()).max().unwrap_or(0);
    let of = |k: usize| (0..BLOCK).filter(move |lane| k < springs[*lane].len()).map(move |lane| (lane, k));
    (plain..most).flat_map(of).collect()
}

/// Returns the number of passes that move the forces of a packed row: the most springs that any lane has there.
fn passes(row: &[(usize, usize)]) -> usize {
    (0..BLOCK).map(|lane| row.iter().filter(|spring| spring.0 == lane).count()).max().unwrap_or(0)
}

/// Returns the cheapest number of plain rows, if a packed row takes 1.5 times as long as a plain one and a
/// quarter more for each pass. (Estimates; with 1.1 or 2.2 a step takes equally long.)
#[allow(clippy::cast_precision_loss)]
fn plain_rows(springs: &[&[HalfSpring]; BLOCK]) -> usize {
    let most = springs.iter().map(|springs| springs.len()).max().unwrap_or(0);
    let of_row = |row: &[(usize, usize)]| 1.5 + 0.25 * passes(row) as f64;
    let cost = |plain: usize| plain as f64 + beyond(springs, plain).chunks(BLOCK).map(of_row).sum::<f64>();
    (0..=most).min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the number of plain rows of a block in which `filled[k]` lanes have a k-th spring.
    fn plain_rows_of(filled: &[usize]) -> usize {
        let half = HalfSpring { to: 0, rest: DVec3::X, stiffness: 1.0 };
        let lanes: [Vec<HalfSpring>; BLOCK] =
            std::array::from_fn(|lane| vec![half; filled.iter().filter(|count| lane < **count).count()]);
        plain_rows(&std::array::from_fn(|lane| &lanes[lane][..]))
    }

    #[test]
    fn rows_that_most_lanes_fill_are_plain_and_the_springs_that_one_lane_has_beyond_are_packed() {
        assert_eq!(plain_rows_of(&[16, 16, 16]), 3);
        // Two springs more: moving them into other rows costs more than a row for them.
        assert_eq!(plain_rows_of(&[15, 15, 2]), 3);
        assert_eq!(plain_rows_of(&[16, 16, 1, 1, 1, 1, 1, 1, 1, 1, 1]), 2);
        assert_eq!(plain_rows_of(&[]), 0);
    }
}
