//! How long each stage of a step takes. The clock is an argument; without one, a stage costs a comparison.

use crate::scene::record::StageTime;

/// A stage of a step, in the order in which a step does them; waking and sleeping count as one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum StepStage {
    /// Decides which tiles wake and which sleep.
    Sleep,
    /// Computes the pressure of an enclosed volume.
    Pressure,
    /// Evaluates the forces of force-controlled tools.
    Force,
    /// Sums the springs and advances the points.
    Sweep,
    /// Moves grasped points.
    Grasp,
    /// Solves the contact of position-controlled tools.
    Contact,
    /// Checks the motion, takes checkpoints, and goes back to one.
    Guard,
}

impl StepStage {
    /// All stages, with their names in records.
    const NAMES: [(StepStage, &'static str); 7] = [
        (StepStage::Sleep, "sleep"),
        (StepStage::Pressure, "pressure"),
        (StepStage::Force, "force"),
        (StepStage::Sweep, "sweep"),
        (StepStage::Grasp, "grasp"),
        (StepStage::Contact, "contact"),
        (StepStage::Guard, "guard"),
    ];
}

/// The time that each stage of a tissue's steps has taken, since it is measured
/// ([`Tissue::time_stages`](crate::Tissue::time_stages)).
#[derive(Debug, Clone)]
pub struct StageTimes {
    /// A clock that never goes back, ns.
    now_ns: fn() -> u64,
    last_ns: u64,
    stages_ns: [u64; StepStage::NAMES.len()],
}

impl StageTimes {
    pub(super) fn new(now_ns: fn() -> u64) -> Self {
        StageTimes { now_ns, last_ns: now_ns(), stages_ns: [0; StepStage::NAMES.len()] }
    }

    /// Begins a step: the time since the last stage belongs to none.
    pub(super) fn begin(&mut self) {
        self.last_ns = (self.now_ns)();
    }

    /// Ends a stage, which began when the one before it ended.
    pub(super) fn end(&mut self, stage: StepStage) {
        let now_ns = (self.now_ns)();
        self.stages_ns[stage as usize] += now_ns.saturating_sub(self.last_ns);
        self.last_ns = now_ns;
    }

    /// Returns the time of each stage, in the order of a step.
    #[allow(clippy::cast_precision_loss)]
    pub fn list(&self) -> Vec<StageTime> {
        let time_s = |stage| self.stages_ns[stage as usize] as f64 * 1e-9;
        StepStage::NAMES.iter().map(|(stage, name)| StageTime { stage: name, time_s: time_s(*stage) }).collect()
    }
}
