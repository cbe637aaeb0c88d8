//! The audit: a window of steps is done again in f64 with a quarter of the substep, and the two ends are compared.
//!
//! The sheet marks where a window begins and where it ends. Both are checkpoints of the guard, which are shared for this,
//! not copied. Between them the sheet writes down what the tools were told. What takes time happens to copies, in any
//! thread: [`Look::open`] copies the beginning and gives the checkpoint back, [`Opening::close`] does the same with the end,
//! and [`Audit::work`] repeats the window in slices.
//!
//! The result is the error that the window added. Two errors stay unseen: that of the state in which the window began, and
//! what the twin shares with the sheet, which for a scheme of order p is 4^−p of the error.
//!
//! An error is relative to the largest displacement and force of the window, or of earlier windows if those were larger:
//! in a sheet that comes to rest, what is left of a poke is measured by the poke.

use std::sync::Arc;

use glam::DVec3;

use super::applied::Applied;
use super::field::State;
use super::guard::{Checkpoint, Input, convert};
use super::integrate::Oscillator;
use super::model::Model;
use super::real::Real;
use super::{Sheet, Tissue, springs_of};
use crate::scene::Precision;
pub use crate::scene::record::AuditedError;

/// The twin's substep is this part of the sheet's.
pub const FINER: u32 = 4;

/// Longest window, s, before it is rounded up to the next checkpoint.
const LONGEST_S: f64 = 0.25;

/// Inputs that a window may have; with more it ends without a result.
const MOST_INPUTS: usize = 4096;

/// Points times substeps of a slice of an audit: some milliseconds.
const SLICE: u64 = 1 << 20;

/// What most of an error comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The scheme with this substep.
    Substep,
    /// The rounding of the number format.
    Rounding,
    /// Tiles at rest, which are not computed.
    Sleep,
}

impl Origin {
    /// In words.
    pub fn describe(self) -> &'static str {
        match self {
            Origin::Substep => "the length of the substep",
            Origin::Rounding => "the rounding of the number format",
            Origin::Sleep => "regions at rest that are not computed",
        }
    }
}

/// What an audit of a window found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finding {
    /// Steps done at the end of the window.
    pub step: u64,
    /// The error that the window added.
    pub error: AuditedError,
    /// Where it comes from, if it is above the tolerance of the scene.
    pub origin: Option<Origin>,
    /// Substeps a step in the window, after what the guard has halved.
    pub substeps: u32,
    /// The largest of this and earlier windows, by which the next one's error is measured.
    pub largest: Extent,
}

/// Largest components over the points of a sheet.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Extent {
    /// Of displacements, m.
    pub displacement_m: f64,
    /// Of the tissue's forces on tools, N.
    pub force_n: f64,
}

impl Extent {
    /// The larger of each.
    pub fn max(self, other: Self) -> Self {
        Extent {
            displacement_m: self.displacement_m.max(other.displacement_m),
            force_n: self.force_n.max(other.force_n),
        }
    }
}

impl Extent {
    /// These as differences, relative to the largest values; 0 where nothing differs.
    pub fn relative_to(self, largest: Extent) -> AuditedError {
        let part = |difference: f64, largest: f64| if difference == 0.0 { 0.0 } else { difference / largest };
        AuditedError {
            displacement: part(self.displacement_m, largest.displacement_m),
            force: part(self.force_n, largest.force_n),
        }
    }
}

/// What the tools were told in a window: before which step, which tool. It has its room from the beginning, so that the
/// sheet need not make any.
#[derive(Debug)]
pub struct Inputs(Vec<(u64, usize, Input)>);

impl Default for Inputs {
    fn default() -> Self {
        Inputs(Vec::with_capacity(MOST_INPUTS))
    }
}

/// What a sheet tells of the window that it was asked for.
#[derive(Debug)]
pub enum Mark {
    /// It begins.
    Begin(Look),
    /// It is over.
    End(Look, Inputs),
    /// It can't be audited: the guard went back, the tissue changed, all came to rest, or too much was told to the tools.
    Dropped,
}

/// A sheet as it was at a checkpoint, shared with the sheet.
#[derive(Debug)]
pub struct Look {
    model: Arc<Model>,
    checkpoint: SharedCheckpoint,
}

/// In either format.
#[derive(Debug)]
pub(super) enum SharedCheckpoint {
    Single(Arc<Checkpoint<f32>>),
    Double(Arc<Checkpoint<f64>>),
}

/// The beginning of a window, copied.
#[derive(Debug)]
pub struct Opening(Copy);

/// A sheet that is done with being shared. Nothing of it sleeps.
#[derive(Debug)]
enum Copy {
    Single(Box<Sheet<f32>>),
    Double(Box<Sheet<f64>>),
}

/// A window that is over: all that it takes to do it again.
#[derive(Debug)]
pub struct Audit {
    begin: Copy,
    inputs: Inputs,
    end: Observed,
    until: u64,
}

/// What is compared: of every point the displacement, m, and the tissue's force on a tool, N.
#[derive(Debug)]
struct Observed(Vec<[DVec3; 2]>);

impl Observed {
    fn extent(&self) -> Extent {
        self.over(|point| *point)
    }

    fn differences(&self, other: &Self) -> Extent {
        let mut others = other.0.iter();
        self.over(|point| others.next().map_or([DVec3::ZERO; 2], |other| [point[0] - other[0], point[1] - other[1]]))
    }

    fn over(&self, mut of: impl FnMut(&[DVec3; 2]) -> [DVec3; 2]) -> Extent {
        self.0.iter().fold(Extent::default(), |extent, point| {
            let [displacement_m, force_n] = of(point).map(|vector| vector.abs().max_element());
            extent.max(Extent { displacement_m, force_n })
        })
    }

    fn is_finite(&self) -> bool {
        self.0.iter().flatten().all(|vector| vector.is_finite())
    }
}

/// How far a sheet is with a window that it was asked for.
#[derive(Debug, Default)]
pub(super) enum Watch {
    /// Nobody has asked.
    #[default]
    Off,
    /// It begins at the next checkpoint.
    Wanted(Inputs),
    /// It ends at the first checkpoint from this step on.
    Open(u64, Inputs),
    /// Its end is to be told.
    Closed(Inputs),
    /// It is to be told that there is no result.
    Dropped,
}

impl Watch {
    /// A tool is told something.
    pub(super) fn input(&mut self, step: u64, tool: usize, input: &Input) {
        let Watch::Open(_, inputs) = self else { return };
        if inputs.0.len() < MOST_INPUTS {
            inputs.0.push((step, tool, input.clone()));
        } else {
            self.give_up();
        }
    }

    /// Something happened that a twin can't repeat.
    pub(super) fn give_up(&mut self) {
        if matches!(self, Watch::Open(..) | Watch::Closed(_)) {
            *self = Watch::Dropped;
        }
    }
}

impl Model {
    /// The same tissue in another format with `by` times the substeps, and nothing sleeps.
    pub fn twin(&self, by: u32, precision: Precision) -> Arc<Self> {
        let mut model = self.clone();
        model.plan = self.plan.divided(&self.scene, by);
        model.precision = precision;
        (model.sleep_tolerance, model.scene.sleep_tolerance) = (0.0, Some(0.0));
        Arc::new(model)
    }

    /// Steps of a window: until the slowest vibration has lost half its amplitude, at most [`LONGEST_S`] s.
    ///
    /// The amplitude of m·ü + C·u̇ + K·u = 0 falls as e^(−γt), γ = C/2m, or in the overdamped case
    /// γ = (C − √(C² − 4mK))/2m of the slower part. K is that of the virtual springs alone: the slowest vibration of a
    /// sheet bends it least.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn window_steps(&self) -> u64 {
        let Oscillator { mass_kg, damping_n_s_per_m: c, virtual_stiffness_n_per_m: k, .. } =
            Oscillator::of(&self.scene);
        // The difference without cancellation.
        let root = (c * c - 4.0 * mass_kg * k).max(0.0).sqrt();
        let decay_per_s = if root > 0.0 { 2.0 * k / (c + root) } else { c / (2.0 * mass_kg) };
        let window_s = (std::f64::consts::LN_2 / decay_per_s).min(LONGEST_S);
        (window_s * self.scene.stepping.rate_hz).ceil().max(1.0) as u64
    }
}

impl<T: Real> Sheet<T> {
    /// Asks for a window: it begins at the next checkpoint.
    pub(super) fn watch(&mut self, mut inputs: Inputs) {
        inputs.0.clear();
        (self.watch, self.is_marked) = (Watch::Wanted(inputs), false);
    }

    /// There is a new checkpoint, at which a window may begin or end.
    pub(super) fn mark(&mut self) {
        self.watch = match std::mem::take(&mut self.watch) {
            Watch::Wanted(inputs) => {
                self.is_marked = true;
                Watch::Open(self.steps + self.model.window_steps(), inputs)
            }
            // The beginning was not told yet, and that checkpoint is gone.
            Watch::Open(_, mut inputs) if self.is_marked => {
                inputs.0.clear();
                Watch::Open(self.steps + self.model.window_steps(), inputs)
            }
            Watch::Open(until, inputs) if self.steps >= until => Watch::Closed(inputs),
            Watch::Closed(_) => Watch::Dropped,
            other => other,
        };
    }

    /// What there is to tell of the window, once.
    pub(super) fn take_mark(&mut self) -> Option<Mark> {
        let look = |sheet: &Self| {
            let checkpoint = sheet.checkpoint.clone()?;
            Some(Look { model: sheet.model.clone(), checkpoint: T::shared(checkpoint) })
        };
        match &self.watch {
            Watch::Open(..) if std::mem::take(&mut self.is_marked) => look(self).map(Mark::Begin),
            Watch::Closed(_) => {
                let look = look(self);
                let Watch::Closed(inputs) = std::mem::take(&mut self.watch) else { return None };
                Some(look.map_or(Mark::Dropped, |look| Mark::End(look, inputs)))
            }
            Watch::Dropped => {
                self.watch = Watch::Off;
                Some(Mark::Dropped)
            }
            _ => None,
        }
    }

    /// A sheet as it was at a checkpoint of one with `model`.
    fn resumed(model: &Model, checkpoint: &Checkpoint<T>) -> Box<Self> {
        let mut sheet = Box::new(Sheet::new(&model.twin(1 << checkpoint.halvings, model.precision)));
        sheet.steps = checkpoint.steps;
        sheet.state.copy_from(&checkpoint.state);
        sheet.applied.clone_from(&checkpoint.applied);
        sheet.prescribed.clone_from(&checkpoint.prescribed);
        sheet.contacts.clone_from(&checkpoint.contacts);
        sheet.tiles.largest = checkpoint.largest;
        sheet
    }

    /// The same state in f64. `model` is this one's, but for the format and what may sleep.
    pub(super) fn widened(&self, model: &Arc<Model>) -> Sheet<f64> {
        let mut sheet = Sheet::<f64>::new(model);
        sheet.steps = self.steps;
        let lost = (self.model.precision == Precision::Compensated).then(|| self.state.kept.last()).flatten();
        let State { u, d, kept } = &mut sheet.state;
        let pairs = [(u, &self.state.u), (d, &self.state.d)].into_iter();
        let kept = kept.iter_mut().zip(&self.state.kept).map(|(to, from)| (Arc::make_mut(to), &**from));
        let (from, to) = (self.bench.layout, sheet.bench.layout);
        for (number, (wide, narrow)) in pairs.chain(kept).enumerate() {
            for index in 0..self.model.len() {
                for c in 0..3 {
                    let at = c * from.plane + from.place(index);
                    // What a compensated displacement has lost belongs to it.
                    let lost = lost.filter(|_| number == 0).map_or(0.0, |lost| lost[at].wide());
                    wide[c * to.plane + to.place(index)] = narrow[at].wide() + lost;
                }
            }
        }
        sheet.applied = Applied::like(&self.applied);
        sheet.prescribed.clone_from(&self.prescribed);
        sheet.contacts.clone_from(&self.contacts);
        sheet
    }

    /// The same sheet under `model`, if that is in f64 and this is not.
    pub(super) fn changed(&self, model: &Arc<Model>) -> Option<Box<Sheet<f64>>> {
        if self.model.precision == Precision::F64 || model.precision != Precision::F64 {
            return None;
        }
        let mut same = Model::clone(&self.model);
        (same.plan, same.precision) = (self.plan.clone(), Precision::F64);
        let mut sheet = Box::new(self.widened(&Arc::new(same)));
        sheet.tiles.largest = self.tiles.largest;
        sheet.guard_events = self.guard_events;
        (sheet.substeps_done, sheet.points_done) = (self.substeps_done, self.points_done);
        if !matches!(self.watch, Watch::Off) {
            sheet.watch = Watch::Dropped;
        }
        sheet.change(model);
        Some(sheet)
    }

    /// Goes on with another substep of the same scheme. The tissue stays, and all that the scheme keeps of its past.
    pub(super) fn resample(&mut self, model: &Arc<Model>) {
        let (was, plan) = (self.plan.clone(), model.plan.clone());
        // What acts now, as an acceleration; the scheme's own terms may be the mean of both sides of a jump.
        self.applied.terms = self.present_terms();
        let springs = springs_of(&self.model, &was);
        convert(&self.bench.layout, &springs, &was, &plan, &self.applied, &mut self.state);
        self.applied.forget();
        self.model = model.clone();
        self.bench.springs = springs_of(model, &plan);
        self.plan = plan;
    }

    /// What is compared.
    fn observed(&self) -> Observed {
        let points = (0..self.model.len()).map(|index| {
            let point = self.point(index);
            [point.displacement_m, point.reaction_n()]
        });
        Observed(points.collect())
    }

    /// Repeats what the tools were told, to `until`, in slices. `go_on` is asked between them; false if it said no.
    fn repeat(&mut self, inputs: &Inputs, until: u64, go_on: &mut dyn FnMut() -> bool) -> bool {
        let work = self.model.len() as u64 * u64::from(self.plan.substeps);
        let slice = (SLICE / work).max(1);
        let mut waiting = inputs.0.iter().peekable();
        while self.steps < until {
            while let Some((_, tool, input)) = waiting.next_if(|(step, ..)| *step <= self.steps) {
                self.tell(*tool, input.clone());
            }
            self.do_step();
            if self.steps.is_multiple_of(slice) && !go_on() {
                return false;
            }
        }
        true
    }
}

impl Look {
    /// The tissue in the window.
    pub fn model(&self) -> &Arc<Model> {
        &self.model
    }

    /// Copies it, and gives back what was shared.
    pub fn open(self) -> Opening {
        Opening(match &self.checkpoint {
            SharedCheckpoint::Single(checkpoint) => Copy::Single(Sheet::resumed(&self.model, checkpoint)),
            SharedCheckpoint::Double(checkpoint) => Copy::Double(Sheet::resumed(&self.model, checkpoint)),
        })
    }
}

impl Copy {
    fn observed(&self) -> Observed {
        match self {
            Copy::Single(sheet) => sheet.observed(),
            Copy::Double(sheet) => sheet.observed(),
        }
    }

    fn steps(&self) -> u64 {
        match self {
            Copy::Single(sheet) => sheet.steps,
            Copy::Double(sheet) => sheet.steps,
        }
    }

    /// In f64, with a part of the substep.
    fn twin(&self, by: u32) -> Sheet<f64> {
        let wide = match self {
            Copy::Single(sheet) => sheet.widened(&sheet.model.twin(1, Precision::F64)),
            Copy::Double(sheet) => sheet.widened(&sheet.model.twin(1, Precision::F64)),
        };
        if by == 1 {
            return wide;
        }
        let mut wide = wide;
        let model = wide.model.twin(by, Precision::F64);
        wide.resample(&model);
        wide
    }

    /// Extents at least as large as what sleep is measured by: the largest displacement of late, and a force in proportion.
    fn since_rest(&self, extent: Extent) -> Extent {
        let largest = match self {
            Copy::Single(sheet) => sheet.tiles.largest,
            Copy::Double(sheet) => sheet.tiles.largest,
        };
        let ratio = (largest * self.model().scene.sheet.spacing_m / extent.displacement_m).max(1.0);
        let ratio = if ratio.is_finite() { ratio } else { 1.0 };
        Extent { displacement_m: ratio * extent.displacement_m, force_n: ratio * extent.force_n }
    }

    fn model(&self) -> &Arc<Model> {
        match self {
            Copy::Single(sheet) => &sheet.model,
            Copy::Double(sheet) => &sheet.model,
        }
    }
}

impl Opening {
    /// The window ended at `end`: gives back what of that was shared.
    pub fn close(self, end: Look, inputs: Inputs) -> Audit {
        let Opening(end) = end.open();
        Audit { begin: self.0, inputs, end: end.observed(), until: end.steps() }
    }
}

impl Audit {
    /// Repeats the window with `finer` times the substeps ([`FINER`]). `largest` is what earlier windows told; `go_on` is
    /// asked between slices of some milliseconds. `None` if it said no, if nothing moved, or if the twin left the numbers.
    pub fn work(self, finer: u32, largest: Extent, go_on: &mut dyn FnMut() -> bool) -> Option<Finding> {
        let Audit { begin, inputs, end, until } = self;
        let first = begin.observed();
        if first.differences(&end) == Extent::default() {
            return None;
        }
        let mut twin = begin.twin(finer);
        // Something may have come and gone within the window.
        let middle = begin.steps().midpoint(until);
        if !twin.repeat(&inputs, middle, go_on) {
            return None;
        }
        let extent = twin.observed().extent();
        let rest = Inputs(inputs.0.iter().filter(|(step, ..)| *step >= middle).cloned().collect());
        if !twin.repeat(&rest, until, go_on) {
            return None;
        }
        let truth = twin.observed();
        if !truth.is_finite() {
            return None;
        }
        let largest = [first.extent(), extent, truth.extent()].into_iter().fold(largest, Extent::max);
        let largest = begin.since_rest(largest);
        let error = |a: &Observed, b: &Observed| a.differences(b).relative_to(largest);
        let found = error(&end, &truth);
        let (tolerance, substeps) = (begin.model().scene.stepping.tolerance, begin.model().plan.substeps);
        let mut finding = Finding { step: until, error: found, origin: None, substeps, largest };
        if found.largest() <= tolerance {
            return Some(finding);
        }
        // From the sheet to the twin, one change at a time: awake, in f64, with the shorter substep.
        let mut wide = begin.twin(1);
        let (woken, same) = match begin {
            Copy::Single(mut sheet) => (sheet.repeat(&inputs, until, go_on), sheet.observed()),
            Copy::Double(mut sheet) => (sheet.repeat(&inputs, until, go_on), sheet.observed()),
        };
        if !woken || !wide.repeat(&inputs, until, go_on) {
            return None;
        }
        let wide = wide.observed();
        let parts = [
            (Origin::Substep, error(&wide, &truth)),
            (Origin::Rounding, error(&same, &wide)),
            (Origin::Sleep, error(&end, &same)),
        ];
        let most = parts.into_iter().max_by(|a, b| a.1.largest().total_cmp(&b.1.largest()));
        finding.origin = most.map(|part| part.0);
        Some(finding)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_lasts_until_the_slowest_vibration_has_lost_half() {
        // m = 0.01 kg; γ = C/2m, overdamped (C − √(C² − 4mK))/2m.
        for (damping, stiffness, window_s) in [
            (0.5, 50.0, 2.0_f64.ln() / 25.0),
            (0.2, 1.0, 2.0_f64.ln() / 10.0),
            (1.0, 5.0, 2.0_f64.ln() / (50.0 - 2000.0_f64.sqrt())),
            (1.0, 0.0, LONGEST_S),
            (0.0, 5.0, LONGEST_S),
            (1e-3, 5.0, LONGEST_S),
        ] {
            let damped = format!("damping.coefficient_n_s_per_m={damping}");
            let held = format!("virtual_springs.stiffness_n_per_m={stiffness}");
            let stepping = ["stepping.rate_hz=2000", "stepping.integrator=exponential3", "stepping.precision=f64"];
            let sets = [&damped, &held, "sheet.points=[3, 3]"];
            let steps = Model::paper(&[&sets[..], &stepping].concat()).window_steps();
            let expected = (2000.0 * window_s.min(LONGEST_S)).ceil();
            assert!((steps as f64 - expected).abs() <= 1.0, "{damping} {stiffness}: {steps}, not {expected}");
        }
    }
}
