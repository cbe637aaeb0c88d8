//! Measured curves beside those of a session's tissue.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use palpate_fitting::curve_file::{MeasuredCurve, UsualTip, read_curves};
use palpate_fitting::residual::Residual;
use palpate_haptics::{Tip, TipShape};
use palpate_proto::{pb, touch};
use palpate_refusal::{Reason, Refusal, Result, positive};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;

use super::meshes::name_of;

/// Samples of all curves of a call: the answer stays below a MiB.
const MAX_SAMPLES: usize = 20_000;

/// The tip of a table and a request without one, as that of `palpate fit`.
const USUAL: UsualTip = UsualTip { shape: TipShape::Disc, radius_m: 0.005 };

/// Presses into a tissue at rest as the curves of a request say, one after another, and returns the forces beside the measured ones.
///
/// # Errors
/// Refuses a table that [`read_curves`] refuses, with its line, more than 20,000 samples, presses that take more than `limits.press_work`
/// or that the tissue does not bear, a tip that does not suit the tissue, and ends with [`Reason::TimedOut`] when `stop` is set.
pub(super) fn compare(
    request: &pb::CompareCurvesRequest,
    model: &Arc<Model>,
    limits: &Limits,
    stop: &AtomicBool,
) -> Result<pb::CompareCurvesResponse> {
    let usual = match touch::from_tip("tip", request.tip.as_ref())? {
        _ if request.tip.is_none() => USUAL,
        Tip { shape, radius_m, .. } => UsualTip { shape, radius_m: positive("tip.radius_m", radius_m)? },
    };
    let curves = read_curves(&name_of(&request.file_name, "the table"), &request.table, usual)?;
    let samples: usize = curves.iter().map(|curve| curve.force_n.len()).sum();
    if samples > MAX_SAMPLES {
        let message = format!("has {samples} samples, more than {MAX_SAMPLES}: leave some out");
        return Err(Refusal::new(Reason::TooLarge, "table", message));
    }
    let step_work = (model.swept_points() as u64).saturating_mul(u64::from(model.plan.substeps));
    let steps: u64 = curves.iter().map(|curve| curve.press.steps(model)).sum();
    let (work, most) = (steps.saturating_mul(step_work), limits.press_work);
    if work > most {
        let message = format!(
            "has presses of {steps} steps, {work} points times substeps, above the limit of {most} (limits.press_work): \
             send fewer or shorter curves"
        );
        return Err(Refusal::new(Reason::TooLarge, "table", message));
    }
    let computed = curves.iter().map(|curve| pressed(curve, model, limits, stop)).collect::<Result<Vec<_>>>()?;
    let residual = Residual::of(&curves, &computed);
    let compared = curves.into_iter().zip(computed).zip(&residual.rms_of_curves_n);
    Ok(pb::CompareCurvesResponse {
        curves: compared.map(|((curve, computed_n), rms_n)| message(curve, computed_n, *rms_n)).collect(),
        rms_n: residual.rms_n,
        relative_rms: residual.relative_rms,
        r_squared: residual.r_squared,
    })
}

/// Returns the forces of the tissue in the press of a curve, N.
fn pressed(curve: &MeasuredCurve, model: &Arc<Model>, limits: &Limits, stop: &AtomicBool) -> Result<Vec<f64>> {
    curve.press.forces_n(model, limits, stop).map_err(|failure| match failure {
        SimulationFailure::Refused(refusal) if refusal.reason == Reason::TimedOut => refusal,
        failure => {
            let reason =
                if let SimulationFailure::Refused(refusal) = &failure { refusal.reason } else { Reason::OutOfRange };
            Refusal::new(
                reason,
                "table",
                format!("the curve `{}` can't be pressed into this tissue: {failure}", curve.name),
            )
        }
    })
}

fn message(
    MeasuredCurve { name, press, force_n }: MeasuredCurve,
    computed_n: Vec<f64>,
    rms_n: f64,
) -> pb::ComparedCurve {
    let tip = Tip { shape: press.shape, radius_m: press.radius_m, friction: 0.0, ..Tip::default() };
    pb::ComparedCurve {
        name,
        tip: Some(touch::tip(&tip)),
        time_s: press.time_s,
        depth_m: press.depth_m,
        measured_n: force_n,
        computed_n,
        rms_n,
    }
}
