//! A survey of the tissue: energies, the largest displacement, and the error of predicted forces. It is a sweep
//! that advances nothing.
//!
//! Sums are separate for each of 16 columns, row by row, so that they too are the same at every vector width.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::cell::UnsafeCell;

use crate::body::force_field::{self, Pull, Term};
use crate::body::model::{Model, Plan};
use crate::body::tables::SweepTables;
use crate::interface::Energy;
use crate::kernel::field::{BLOCK, Layout, State};
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::stage::Stage;
use crate::scheme::Scheme;
use crate::scheme::arithmetic::MAX_KEPT;
use crate::scheme::observer::Observer;

/// The result of a survey, in the scheme's units (`scheme`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Survey {
    /// Σ w² (w is the velocity times the substep), each point weighted by its relative mass.
    pub(crate) speed_squared: f64,
    /// Σ w² in the form that the scheme's conserved energy uses.
    pub(crate) conserved_speed_squared: f64,
    /// Σ u², each point weighted by its relative K″.
    pub(crate) displacement_squared: f64,
    /// Energy of all springs.
    pub(crate) spring_energy: f64,
    /// The largest component of any displacement.
    pub(crate) largest: f64,
    /// The largest difference between a corrected displacement and the predicted one.
    pub(crate) prediction_error: f64,
    /// The largest component of any w.
    pub(crate) speed: f64,
    /// The largest component of the force imbalance of any free point divided by its relative mass: N − a·u +
    /// F.
    pub(crate) imbalance: f64,
    /// Σ F·d of the tools.
    pub(crate) power: f64,
    /// Work of the branches along the last increment.
    pub(crate) relaxing: f64,
}

/// The sums of w², u², spring energy, conserved w², F·d and the work of branches; and the maxima.
#[derive(Debug)]
struct Sums<T> {
    row: [[T; BLOCK]; 6],
    total: [[f64; BLOCK]; 6],
    largest: [[T; BLOCK]; 4],
}

/// The forces on a state besides those of the springs, and how to scale them to the springs' units.
#[derive(Clone, Copy)]
pub(crate) struct Forces<'a, T: Real> {
    /// The tools' forces.
    pub(crate) terms: &'a [Term<T>],
    /// The field of the terms to use.
    pub(crate) field: usize,
    /// The factor that converts that field to the springs' units.
    pub(crate) part: f64,
    /// a = K″·dt²/m of the anchor springs.
    pub(crate) pull: f64,
}

/// What a survey writes to the state.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Write {
    /// The state stays as it is.
    Nothing,
    /// A state of rest: no motion, and the present spring force as the whole history.
    Rest,
    /// Replaces the scheme's internal values by the observed u and w.
    Seen,
    /// Replaces the observed u and w by the scheme's internal values, as if the springs had always pulled as
    /// they do now. (In a two-step scheme, w is half a change ahead of d: d = w − (next − w)/2, and the scheme
    /// observes (d + next)/2 as w.)
    Begin,
}

/// u, d, and the largest number of kept fields.
const FIELDS: usize = 2 + MAX_KEPT;

struct SurveyStage<'a, T: Real> {
    layout: Layout,
    observer: Observer<T>,
    /// How many fields the scheme keeps.
    kept_fields: usize,
    /// d and the kept fields.
    d: *const T,
    kept: [*const T; MAX_KEPT],
    /// What to write, and where: u, d and the kept fields. Null if nothing is written.
    write: Write,
    to: [*mut T; 2],
    to_kept: [*mut T; MAX_KEPT],
    forces: Forces<'a, T>,
    /// The same forces in the form that the sweep uses.
    pulls: &'a [Pull<'a, T>],
    free: *const T,
    /// Relative mass and extra K″/m of each point; null if all masses are 1, or all extra values 0.
    masses: *const T,
    extra: *const T,
    sums: &'a UnsafeCell<Sums<T>>,
}

impl Survey {
    /// Surveys the awake part of a state in `over`.
    pub(crate) fn of<T: Real>(
        tables: &SweepTables<T>,
        scheme: &Scheme,
        state: &State<T>,
        forces: Forces<'_, T>,
        over: &Region,
    ) -> Survey {
        let mut fields = state.fields().map(|field| field.as_ptr());
        let from = std::array::from_fn(|_| fields.next().unwrap_or(std::ptr::null()));
        Survey::by(tables, scheme, (from, [std::ptr::null_mut(); FIELDS]), forces, over, Write::Nothing)
    }

    /// Surveys the awake part of a state in `over` and rewrites it.
    pub(crate) fn write<T: Real>(
        tables: &SweepTables<T>,
        scheme: &Scheme,
        state: &mut State<T>,
        forces: Forces<'_, T>,
        over: &Region,
        write: Write,
    ) {
        let mut fields = state.fields_mut().map(|field| field.as_mut_ptr());
        let to: [*mut T; FIELDS] = std::array::from_fn(|_| fields.next().unwrap_or(std::ptr::null_mut()));
        Survey::by(tables, scheme, (to.map(<*mut T>::cast_const), to), forces, over, write);
    }

    /// Reads u, d and the kept fields from one state and writes them to another.
    fn by<T: Real>(
        tables: &SweepTables<T>,
        scheme: &Scheme,
        ([u, d, kept @ ..], [to_u, to_d, to_kept @ ..]): ([*const T; FIELDS], [*mut T; FIELDS]),
        forces: Forces<'_, T>,
        over: &Region,
        write: Write,
    ) -> Survey {
        let observer = Observer::of(scheme);
        let kept_fields = observer.kept();
        let needed = 2 + kept_fields;
        debug_assert!([u, d].iter().chain(&kept).take(needed).all(|field| !field.is_null()));
        debug_assert!(
            write == Write::Nothing || [to_u, to_d].iter().chain(&to_kept).take(needed).all(|field| !field.is_null())
        );
        let zero = [T::default(); BLOCK];
        let sums = UnsafeCell::new(Sums { row: [zero; 6], total: [[0.0; BLOCK]; 6], largest: [zero; 4] });
        let pulls = forces.terms.iter().map(|term| term.pull(forces.field, tables.layout.stride));
        let pulls: Vec<Pull<'_, T>> = pulls.collect();
        let [masses, extra] = tables.masses_and_extra();
        let stage = SurveyStage {
            masses,
            extra,
            layout: tables.layout,
            observer,
            kept_fields,
            d,
            kept,
            write,
            to: [to_u, to_d],
            to_kept,
            forces,
            pulls: &pulls,
            free: tables.free.as_ref().map_or(std::ptr::null(), |free| free.as_ptr()),
            sums: &sums,
        };
        // SAFETY: a state has u, d and at least the fields that the scheme keeps, all of the tables's layout; u is
        // written behind what the sweep still reads.
        unsafe { tables.survey(u, over, stage) };
        let Sums { total, largest, .. } = sums.into_inner();
        let sum = |which: usize| total[which].iter().sum();
        let most = |which: usize| largest[which].iter().map(|value| value.wide()).fold(0.0, f64::max);
        Survey {
            speed_squared: sum(0),
            displacement_squared: sum(1),
            spring_energy: sum(2),
            conserved_speed_squared: sum(3),
            largest: most(0),
            prediction_error: most(1),
            speed: most(2),
            imbalance: most(3),
            power: sum(4),
            relaxing: sum(5),
        }
    }
}

impl<T: Real> SurveyStage<'_, T> {
    /// Adds to a sum of the row.
    #[inline(always)]
    unsafe fn add<V: Vector<Real = T>>(&self, which: usize, at: usize, value: V) {
        // SAFETY: one sweep runs at a time, and only its stage refers to the sums.
        unsafe {
            let sum = (&raw mut (*self.sums.get()).row[which]).cast::<T>().add(at % BLOCK);
            V::load(sum).add(value).store(sum);
        }
    }
}

impl<T: Real> Stage<T> for SurveyStage<'_, T> {
    const ENERGY: bool = true;

    #[inline(always)]
    unsafe fn finish<V: Vector<Real = T>, const DUTY: u8>(
        &self,
        row: usize,
        at: usize,
        x: [V; 3],
        n: [V; 3],
        _: &mut [V; 2],
    ) {
        // SAFETY: the fields have the layout; the sums as above.
        unsafe {
            let stride = self.layout.stride;
            debug_assert!(self.layout.holds(at, V::LANES) && V::LANES <= BLOCK);
            let column = at - row * stride;
            let Forces { terms, part, pull, .. } = self.forces;
            let force = force_field::force_on::<V, 1>(self.pulls, row, at);
            let free = if self.free.is_null() { None } else { Some(V::load(self.free.add(at))) };
            let (part, pull) = (V::of(T::of(part)), V::of(T::of(pull)));
            let zero = V::of(T::default());
            let (mut speed, mut displacement, mut conserved, mut power, mut relaxing) = (zero, zero, zero, zero, zero);
            let mut most = [zero; 4];
            for c in 0..3 {
                let at = at + c * self.layout.plane;
                let d = V::load(self.d.add(at));
                let mut kept = [d; MAX_KEPT];
                for k in 0..self.kept_fields {
                    kept[k] = if self.write == Write::Begin { n[c] } else { V::load(self.kept[k].add(at)) };
                }
                let pushed = part.mul(force[c][0]);
                let force = if terms.is_empty() { None } else { Some(pushed) };
                let [u, w, conserved_w_squared] = self.observer.observe(x[c], d, n[c], &kept, force);
                speed = w.mul_add(w, speed);
                conserved = conserved.add(conserved_w_squared);
                displacement = u.mul_add(u, displacement);
                power = pushed.mul_add(d, power);
                if let Some(force) = self.observer.relaxing(n[c], &kept) {
                    relaxing = force.mul_add(d, relaxing);
                }
                let mut short = n[c].minus(pull, u).add(pushed);
                let (mut seen, mut speed_seen) = (u, w);
                if let Some(free) = free {
                    (short, seen, speed_seen) = (short.mul(free), u.mul(free), w.mul(free));
                }
                match self.write {
                    Write::Nothing => {}
                    Write::Rest => {
                        seen.store(self.to[0].add(at));
                        zero.store(self.to[1].add(at));
                    }
                    Write::Seen => {
                        seen.store(self.to[0].add(at));
                        speed_seen.store(self.to[1].add(at));
                    }
                    Write::Begin => d.add(d.sub(speed_seen)).store(self.to[1].add(at)),
                }
                if matches!(self.write, Write::Rest | Write::Begin) {
                    for k in 0..self.kept_fields {
                        n[c].store(self.to_kept[k].add(at));
                    }
                }
                most = [
                    most[0].farther(u),
                    most[1].farther(u.sub(x[c])),
                    most[2].farther(speed_seen),
                    most[3].farther(short),
                ];
            }
            if !self.masses.is_null() {
                let mass = V::load(self.masses.add(at));
                [speed, displacement] = [speed.mul(mass), displacement.mul(mass)];
                [conserved, power, relaxing] = [conserved.mul(mass), power.mul(mass), relaxing.mul(mass)];
            }
            if !self.extra.is_null() {
                displacement = displacement.mul_add(V::load(self.extra.add(at)), displacement);
            }
            self.add(0, column, speed);
            self.add(1, column, displacement);
            self.add(3, column, conserved);
            self.add(4, column, power);
            self.add(5, column, relaxing);
            for (which, most) in most.into_iter().enumerate() {
                let largest = (&raw mut (*self.sums.get()).largest[which]).cast::<T>().add(column % BLOCK);
                V::load(largest).farther(most).store(largest);
            }
        }
    }

    #[inline(always)]
    unsafe fn energy<V: Vector<Real = T>>(&self, column: usize, energy: V) {
        // SAFETY: as above.
        unsafe { self.add(2, column, energy) }
    }

    #[inline(always)]
    unsafe fn end_row(&self) {
        // SAFETY: as above.
        let sums = unsafe { &mut *self.sums.get() };
        for (row, total) in sums.row.iter_mut().zip(&mut sums.total) {
            total.iter_mut().zip(row.iter()).for_each(|(total, value)| *total += value.wide());
            *row = [T::default(); BLOCK];
        }
    }
}

/// Returns the energies of a survey, and the energy that the scheme conserves.
pub(crate) fn energy_of(model: &Model, plan: &Plan, survey: &Survey) -> (Energy, f64) {
    // Twice the energy of a point that moves by a spacing in a substep.
    let unit_j = model.scene.point_mass_kg() * (model.unit_m / plan.substep_s).powi(2);
    let stiffness = model.scene.anchor_stiffness_n_per_m * model.unit_m * model.unit_m;
    let energy = Energy {
        kinetic_j: 0.5 * unit_j * survey.speed_squared,
        spring_j: unit_j / plan.scheme.spring_scale() * survey.spring_energy,
        anchor_j: 0.5 * stiffness * survey.displacement_squared,
    };
    (energy, 0.5 * unit_j * survey.conserved_speed_squared + energy.spring_j + energy.anchor_j)
}

/// Returns the energy of the pressure of a volume, J, from its growth in cubes of the unit of length.
pub(crate) fn pressure_j(model: &Model, volume_change: f64) -> f64 {
    let Some(volume) = model.places.volume() else { return 0.0 };
    let unit_m = model.unit_m;
    0.5 * model.scene.volume_stiffness_pa * volume.stretch_m * (volume_change * unit_m).powi(2)
}
