//! What a caller tells a fit, and what it tells its caller on the way.

use std::sync::atomic::AtomicBool;

use palpate_tissue::limits::Limits;
use palpate_tissue::scene::tissue_parameter::TissueParameter;

/// What to fit, and how.
pub struct FitOptions<'o> {
    /// The parameters; empty for those that the scene has, above 0, and the data can tell.
    pub parameters: &'o [TissueParameter],
    /// Threads of runs, at least 1. Without effect on the result.
    pub threads: usize,
    /// Limits of the runs.
    pub limits: &'o Limits,
    /// Ends the fit soon after another thread sets it.
    pub stop: &'o AtomicBool,
}

/// How far a fit is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitProgress {
    /// Curves that were run so far.
    pub runs: u64,
    /// The smallest residual so far, N (root of the mean square); `None` before the first.
    pub rms_n: Option<f64>,
}
