//! The audit repeats a window of steps in f64 with a quarter of the substep and compares the two results.
//!
//! The tissue marks where a window begins and ends. Both are checkpoints of the guard, which are shared for
//! this, not copied. In between, the tissue records its tools' inputs. The slow work happens on copies, in any
//! thread: [`SharedCheckpoint::open`] copies the beginning and releases the checkpoint,
//! [`WindowOpening::close`] does this with the end, and [`Audit::work`] repeats the window in slices. The
//! repeating tissue is called the twin.
//!
//! The result is the error that the window added. Two errors stay unseen: that of the state in which the window
//! began, and the error that the twin shares with the tissue, which for a scheme of order p is 4^−p of the
//! error.
//!
//! An error is relative to the largest displacement and force of the window, or of earlier windows if those
//! were larger: in a tissue that comes to rest, the remains of a poke are measured relative to the poke.

use std::sync::Arc;

use glam::DVec3;

use crate::audit_window::Replay;
pub use crate::audit_window::{Mark, SharedCheckpoint, WindowInputs};
use crate::body::model::Model;
use crate::scene::Precision;
pub use crate::scene::record::AuditedError;
use crate::scheme::Relaxation;

/// How many substeps of the twin (the repetition in f64) usually replace one of the tissue: the argument
/// `finer` of [`Audit::work`].
pub const FINER: u32 = 4;

/// Longest window, s, before it is rounded up to the next checkpoint.
const LONGEST_S: f64 = 0.25;

/// The main source of an error that an audit measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The scheme with this substep.
    Substep,
    /// The rounding of the number format.
    Rounding,
    /// Tiles at rest, which were not computed.
    Sleep,
}

impl Origin {
    /// Returns a description for messages, in the middle of a sentence: "the length of the substep" and the
    /// like.
    pub fn describe(self) -> &'static str {
        match self {
            Origin::Substep => "the length of the substep",
            Origin::Rounding => "the rounding of the number format",
            Origin::Sleep => "regions at rest that are not computed",
        }
    }
}

/// The result of an audit of a window of steps, from [`Audit::work`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AuditFinding {
    /// Steps done at the end of the window.
    pub step: u64,
    /// The error that the window added, relative to `largest`.
    pub error: AuditedError,
    /// The main source of the error; `None` if the error is within the scene's tolerance, and no source was
    /// looked for.
    pub origin: Option<Origin>,
    /// Substeps per step at the beginning of the window, including the guard's halvings.
    pub substeps: u32,
    /// The largest displacement and force of this and earlier windows: pass it to the next window's
    /// [`Audit::work`].
    pub largest: ErrorExtent,
}

/// Largest components of displacement and force over the points of a tissue: along any axis, without sign.
/// `default()` is 0 for both, for the first window.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ErrorExtent {
    /// Largest component of a displacement, m.
    pub displacement_m: f64,
    /// Largest component of a force of the tissue on a tool, N.
    pub force_n: f64,
}

impl ErrorExtent {
    /// Returns the larger displacement and the larger force of the two.
    pub fn max(self, other: Self) -> Self {
        ErrorExtent {
            displacement_m: self.displacement_m.max(other.displacement_m),
            force_n: self.force_n.max(other.force_n),
        }
    }
}

impl ErrorExtent {
    /// Returns these differences relative to the largest values: max|Δu|/max|u| and max|Δf|/max|f|; 0 where
    /// nothing differs, and infinite where something differs and the largest value is 0.
    pub fn relative_to(self, largest: ErrorExtent) -> AuditedError {
        let part = |difference: f64, largest: f64| if difference == 0.0 { 0.0 } else { difference / largest };
        AuditedError {
            displacement: part(self.displacement_m, largest.displacement_m),
            force: part(self.force_n, largest.force_n),
        }
    }
}

/// A copy of the tissue at the beginning of a window, made by [`SharedCheckpoint::open`].
/// [`WindowOpening::close`] completes it.
#[derive(Debug)]
pub struct WindowOpening(Box<dyn Replay>);

/// A complete window, made by [`WindowOpening::close`]: everything needed to repeat it. It does not depend on
/// the tissue any more, so any thread can do the work.
#[derive(Debug)]
pub struct Audit {
    begin: Box<dyn Replay>,
    inputs: WindowInputs,
    end: Observed,
    until: u64,
}

/// The compared values: for each point the displacement, m, and the tissue's force on a tool, N.
#[derive(Debug)]
struct Observed(Vec<[DVec3; 2]>);

impl Observed {
    fn of(sheet: &dyn Replay) -> Self {
        Observed(sheet.observed())
    }

    fn extent(&self) -> ErrorExtent {
        self.over(|point| *point)
    }

    fn differences(&self, other: &Self) -> ErrorExtent {
        let mut others = other.0.iter();
        self.over(|point| others.next().map_or([DVec3::ZERO; 2], |other| [point[0] - other[0], point[1] - other[1]]))
    }

    fn over(&self, mut of: impl FnMut(&[DVec3; 2]) -> [DVec3; 2]) -> ErrorExtent {
        self.0.iter().fold(ErrorExtent::default(), |extent, point| {
            let [displacement_m, force_n] = of(point).map(|vector| vector.abs().max_element());
            extent.max(ErrorExtent { displacement_m, force_n })
        })
    }

    fn is_finite(&self) -> bool {
        self.0.iter().flatten().all(|vector| vector.is_finite())
    }
}

impl Model {
    /// Returns the model in another number format, with `by` times the substeps (1 leaves them, 0 panics) and
    /// without sleep: for the repetition of a window. Warnings and the expected error stay those of this model;
    /// no limits are checked.
    pub fn twin(&self, by: u32, precision: Precision) -> Arc<Self> {
        let mut model = self.clone();
        model.plan = self.plan.divided(&self.scene, by);
        model.precision = precision;
        (model.sleep_tolerance, model.scene.sleep_tolerance) = (0.0, Some(0.0));
        Arc::new(model)
    }

    /// Returns the steps in a window: until the slowest vibration has lost half its amplitude, at most 0.25 s,
    /// at least 1 step. The window then lasts until the next checkpoint of the guard.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn window_steps(&self) -> u64 {
        let decay_per_s = Relaxation::of(&self.scene).decay_per_s();
        let window_s = (std::f64::consts::LN_2 / decay_per_s).min(LONGEST_S);
        (window_s * self.scene.stepping.rate_hz).ceil().max(1.0) as u64
    }
}

impl SharedCheckpoint {
    /// Copies the tissue at this checkpoint, the beginning of a window, awake and with its own substep, and
    /// releases the checkpoint. The copy takes about one [`Model::state_bytes`], and time in proportion: call
    /// it in any thread, soon after [`Mark::Begin`]. Without memory for it, it unwinds with a refusal, which
    /// [`attempt`](crate::memory::attempt) returns.
    pub fn open(self) -> WindowOpening {
        WindowOpening(self.checkpoint.resume(&self.model))
    }
}

/// Returns an extent at least as large as the one to which the sleep of `sheet` is relative: the recent largest
/// displacement, and a force in proportion.
fn since_rest(sheet: &dyn Replay, extent: ErrorExtent) -> ErrorExtent {
    let ratio = (sheet.largest() * sheet.model().unit_m / extent.displacement_m).max(1.0);
    let ratio = if ratio.is_finite() { ratio } else { 1.0 };
    ErrorExtent { displacement_m: ratio * extent.displacement_m, force_n: ratio * extent.force_n }
}

impl WindowOpening {
    /// Ends the window at `end`, whose shared checkpoint it releases. `end` and `inputs` are those of the
    /// [`Mark::End`] that followed the [`Mark::Begin`] of this opening, of the same tissue. It copies the state
    /// at the end; without memory for that, it unwinds with a refusal, as [`SharedCheckpoint::open`] does.
    pub fn close(self, end: SharedCheckpoint, inputs: WindowInputs) -> Audit {
        let WindowOpening(end) = end.open();
        Audit { begin: self.0, inputs, end: Observed::of(&*end), until: end.steps() }
    }
}

impl Audit {
    /// Returns the memory of an audit besides the copy of its beginning ([`Model::session_bytes`]), bytes: two
    /// repetitions in f64, and what is compared of at most six states.
    pub fn bytes(model: &Model) -> u64 {
        let observed = 6 * model.len() * size_of::<[DVec3; 2]>();
        2 * model.twin(1, Precision::F64).state_bytes() + observed as u64
    }

    /// Repeats the window in f64 with `finer` times the substeps ([`FINER`]) and returns the error that the
    /// window added; if this is above the scene's tolerance, it repeats the window twice more to find the main
    /// source. `largest` is that of earlier windows' findings ([`AuditFinding::largest`]), or
    /// `ErrorExtent::default()`. It blocks, and calls `go_on` between slices of some milliseconds.
    ///
    /// Returns `None` if `go_on` returned false, if the state at the end equals that at the beginning, or if
    /// the repetition did not stay finite. Without memory it unwinds with a refusal, as
    /// [`SharedCheckpoint::open`] does.
    pub fn work(self, finer: u32, largest: ErrorExtent, go_on: &mut dyn FnMut() -> bool) -> Option<AuditFinding> {
        let Audit { mut begin, inputs, end, until } = self;
        let first = Observed::of(&*begin);
        if first.differences(&end) == ErrorExtent::default() {
            return None;
        }
        let mut twin = begin.twin(finer);
        // A movement may begin and end within the window.
        let middle = begin.steps().midpoint(until);
        if !twin.repeat(&inputs, middle, go_on) {
            return None;
        }
        let extent = Observed::of(&*twin).extent();
        let rest = WindowInputs(inputs.0.iter().filter(|(step, ..)| *step >= middle).cloned().collect());
        if !twin.repeat(&rest, until, go_on) {
            return None;
        }
        let truth = Observed::of(&*twin);
        if !truth.is_finite() {
            return None;
        }
        let largest = [first.extent(), extent, truth.extent()].into_iter().fold(largest, ErrorExtent::max);
        let largest = since_rest(&*begin, largest);
        let error = |a: &Observed, b: &Observed| a.differences(b).relative_to(largest);
        let found = error(&end, &truth);
        let (tolerance, substeps) = (begin.model().scene.stepping.tolerance, begin.model().plan.substeps);
        let mut finding = AuditFinding { step: until, error: found, origin: None, substeps, largest };
        if found.largest() <= tolerance {
            return Some(finding);
        }
        // From the tissue to the twin, one change at a time: awake, then f64, then the shorter substep.
        let mut wide = begin.twin(1);
        if !begin.repeat(&inputs, until, go_on) || !wide.repeat(&inputs, until, go_on) {
            return None;
        }
        let (same, wide) = (Observed::of(&*begin), Observed::of(&*wide));
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
mod tests;
