//! How long each stage of a step takes. The clock is an argument; without one, a stage costs a comparison.

/// A stage of a step, in the order in which a step does them; waking and sleeping count as one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepStage {
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
    /// All stages, with their names as people read them.
    pub const NAMES: [(StepStage, &'static str); 7] = [
        (StepStage::Sleep, "sleep"),
        (StepStage::Pressure, "pressure"),
        (StepStage::Force, "force"),
        (StepStage::Sweep, "sweep"),
        (StepStage::Grasp, "grasp"),
        (StepStage::Contact, "contact"),
        (StepStage::Guard, "guard"),
    ];
}

/// The time that each stage of a tissue's steps has taken since the profile began
/// ([`Tissue::profile`](crate::Tissue::profile)).
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

    /// Returns the time of a stage, ns, summed over all steps since the profile began.
    pub fn stage_ns(&self, stage: StepStage) -> u64 {
        self.stages_ns[stage as usize]
    }

    /// Returns the time of all stages together, ns.
    pub fn total_ns(&self) -> u64 {
        self.stages_ns.iter().sum()
    }
}
