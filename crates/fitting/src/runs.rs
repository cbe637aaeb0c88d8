//! The runs of a fit: the forces of all curves with other values of the parameters.

use std::sync::Arc;

use palpate_refusal::{Reason, Refusal};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;

use super::curve_file::MeasuredCurve;
use super::options::{FitOptions, FitProgress};
use super::parallel::in_parallel;
use super::residual::{differences, rms};

/// How many times the substeps of the given scene a run may have: a stiffer or more viscous tissue is not looked at. A scene of few
/// substeps counts as one of so many: it may be the softest and least viscous of all that are looked at.
const MAX_SLOWER: u32 = 32;
const FEW: u32 = 8;

/// The presses of all curves, which are run on tissues like a model.
pub(crate) struct Runs<'f> {
    pub(crate) model: &'f Arc<Model>,
    pub(crate) curves: &'f [MeasuredCurve],
    pub(crate) options: &'f FitOptions<'f>,
    /// The forces of all curves, one after the other, N.
    pub(crate) measured: Vec<f64>,
    pub(crate) progress: &'f mut dyn FnMut(FitProgress),
    /// Curves that were run so far.
    pub(crate) count: u64,
    /// The smallest residual so far, N (root of the mean square); `None` before the first.
    pub(crate) rms_n: Option<f64>,
    /// Why the last scene without forces has none, as a sentence.
    pub(crate) no_forces: Option<String>,
}

/// Returns whether a refusal says that no tissue has such values, or that it takes too many substeps. Such a scene has no forces; every
/// other refusal ends the fit.
fn has_no_forces(refusal: &Refusal) -> bool {
    [Reason::TooLarge, Reason::OutOfRange].contains(&refusal.reason)
}

fn no_threads() -> Refusal {
    Refusal::new(Reason::NotAvailable, "", "no thread could be started")
}

impl Runs<'_> {
    /// Runs all curves on each scene, with at least the substeps that `at` needs: differences between scenes near `at` are then not those
    /// of their substeps. `None` where no tissue has such values, the tissue can't be stepped, or does not bear the presses.
    ///
    /// # Errors
    /// Returns every refusal that says something else, above all that `stop` is set.
    pub(crate) fn forces(
        &mut self,
        at: &Result<Scene, Refusal>,
        scenes: Vec<Result<Scene, Refusal>>,
    ) -> Result<Vec<Option<Vec<f64>>>, SimulationFailure> {
        let (model, limits) = (self.model, self.narrower(1));
        let least = at.as_ref().ok().and_then(|at| model.substeps_alike(at, &limits).ok()).unwrap_or(1);
        let compile =
            |number: usize| scenes[number].clone().and_then(|scene| model.compile_alike(&scene, least, &limits));
        let models = in_parallel(self.options.threads, scenes.len(), compile, || {});
        let models = models.into_iter().map(|model| model.unwrap_or_else(|| Err(no_threads()))).collect();
        self.of(models)
    }

    /// Runs all curves on the tissue of a scene with a smaller error of the runs ([`Model::compile_finer`]).
    ///
    /// # Errors
    /// As [`Runs::forces`].
    pub(crate) fn finer(&mut self, scene: &Scene) -> Result<Option<Vec<f64>>, SimulationFailure> {
        let model = self.model.compile_alike(scene, 1, &self.narrower(1));
        let finer = model.and_then(|model| model.compile_finer(&self.narrower(2)));
        Ok(self.of(vec![finer])?.pop().flatten())
    }

    /// Returns the limits of a run that may have so many times the substeps of one of the search.
    fn narrower(&self, times: u32) -> Limits {
        let most = self.model.plan.substeps.max(FEW).saturating_mul(MAX_SLOWER * times);
        Limits { substeps: most.min(self.options.limits.substeps), ..self.options.limits.clone() }
    }

    fn of(&mut self, models: Vec<Result<Arc<Model>, Refusal>>) -> Result<Vec<Option<Vec<f64>>>, SimulationFailure> {
        let mut borne = Vec::with_capacity(models.len());
        for model in models {
            match model {
                Ok(model) => borne.push(Some(model)),
                Err(refusal) if has_no_forces(&refusal) => {
                    self.no_forces = Some(refusal.to_string());
                    borne.push(None);
                }
                Err(refusal) => return Err(refusal.into()),
            }
        }
        let FitOptions { threads, limits, stop, .. } = *self.options;
        let (curves, rms_n) = (self.curves, self.rms_n);
        let run = |job: usize| {
            let model = borne[job / curves.len()].as_ref();
            model.map(|model| curves[job % curves.len()].press.forces_n(model, limits, stop))
        };
        let (count, progress) = (&mut self.count, &mut self.progress);
        let forces = in_parallel(threads, borne.len() * curves.len(), run, || {
            *count += 1;
            progress(FitProgress { runs: *count, rms_n });
        });
        let mut forces = forces.into_iter();
        let mut predicted = Vec::with_capacity(borne.len());
        for _ in &borne {
            let mut joined = Some(Vec::with_capacity(self.measured.len()));
            for of_curve in forces.by_ref().take(curves.len()) {
                match of_curve.ok_or_else(no_threads)? {
                    Some(Ok(forces_n)) => joined.iter_mut().for_each(|joined| joined.extend_from_slice(&forces_n)),
                    None => joined = None,
                    Some(Err(SimulationFailure::Held(reason))) => {
                        self.no_forces = Some(reason);
                        joined = None;
                    }
                    Some(Err(failure)) => return Err(failure),
                }
            }
            if let Some(joined) = &joined {
                let rms_n = rms(&differences(joined, &self.measured));
                self.rms_n = Some(self.rms_n.map_or(rms_n, |before| before.min(rms_n)));
            }
            predicted.push(joined);
        }
        Ok(predicted)
    }

    /// Returns that a tissue has no forces, and why.
    pub(crate) fn held(&self, what: &str) -> SimulationFailure {
        let why = self.no_forces.as_ref().map_or_else(String::new, |reason| format!(" ({reason})"));
        SimulationFailure::Held(format!("{what}{why}"))
    }
}
