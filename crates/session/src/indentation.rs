//! Indentation: a tip goes straight into the tissue and back, and its force over its depth is told as papers print it.

use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::TipShape;
use palpate_refusal::Result;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::record::Summary;
use palpate_tissue::scene::script::Script;

use super::press::{on_surface, touching_m};
use super::run::{RunEvent, RunOptions, run_with};
use super::simulation::SimulationFailure;

/// Distance from the tissue at which the tip begins and ends, divided by its radius.
const CLEARANCE: f64 = 0.1;

/// Time for which the tip stays at its depth, s.
const REST_S: f64 = 0.2;

/// Time between two samples, s.
const SAMPLE_S: f64 = 0.005;

/// Number of depths of a curve, the first (0) left out.
const DEPTHS: usize = 20;

/// A tip that goes straight into the tissue and back.
#[derive(Debug, Clone, Copy)]
pub struct Indentation {
    /// Where it goes in, m: the nearest place of the rest surface. `None` for the place that stands for the tissue.
    pub place_m: Option<DVec3>,
    /// The body that goes in.
    pub shape: TipShape,
    /// Radius of the tip, m.
    pub radius_m: f64,
    /// Largest depth, m: of a disc of even pressure the mean over it, of a sphere that of its lowest place, of a rigid disc that beneath
    /// the highest place under it.
    pub depth_m: f64,
    /// Mean speed on the way in and back, m/s.
    pub speed_m_per_s: f64,
}

/// Force at one depth of an indentation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthForce {
    /// Depth of the tip, m.
    pub depth_m: f64,
    /// Outward force of the tissue on the tip on the way in, N.
    pub loading_n: f64,
    /// The same on the way back, N.
    pub unloading_n: f64,
}

/// The result of an indentation.
#[derive(Debug, Clone)]
pub struct Indented {
    /// The place of the rest surface where the tip went in, m.
    pub place_m: DVec3,
    /// Force at 21 depths, evenly from 0 to the largest that was reached.
    pub curve: Vec<DepthForce>,
    /// Force divided by depth over the first tenth of the way in, N/m.
    pub stiffness_n_per_m: f64,
    /// The summary of the run.
    pub summary: Summary,
}

/// The force of a tip that goes in falls by this part of its largest where the tissue gives way.
const GIVES_WAY: f64 = 0.02;

impl Indented {
    /// Returns the depth at which the tissue gives way, m: the first at which the force on the way in has fallen. Under an even
    /// pressure a solid has no equilibrium from there on, until it has found another shape.
    pub fn gives_way_at_m(&self) -> Option<f64> {
        let mut largest_n = 0.0_f64;
        let fallen = self.curve.iter().find(|row| {
            largest_n = largest_n.max(row.loading_n);
            row.loading_n < (1.0 - GIVES_WAY) * largest_n
        });
        fallen.map(|row| row.depth_m)
    }
}

impl Indentation {
    /// Returns Young's modulus of the half space that would resist this tip with the same force at the same depth, Pa. With k the
    /// force over the depth d: E = 16·(1 − ν²)·k/(3π²·a) for an even pressure (Timoshenko and Goodier, Theory of Elasticity,
    /// section 139), (1 − ν²)·k/(2a) for a rigid disc (Boussinesq), and 3·(1 − ν²)·k/(4·√(a·d)) for a sphere (Hertz).
    pub fn apparent_modulus_pa(&self, row: &DepthForce, poissons_ratio: f64) -> f64 {
        let compliance = 1.0 - poissons_ratio * poissons_ratio;
        let (radius_m, stiffness) = (self.radius_m, row.loading_n / row.depth_m);
        compliance
            * stiffness
            * match self.shape {
                TipShape::Disc => 16.0 / (3.0 * std::f64::consts::PI.powi(2) * radius_m),
                TipShape::RigidDisc | TipShape::Blade => 0.5 / radius_m,
                TipShape::Sphere => 0.75 / (radius_m * row.depth_m).sqrt(),
            }
    }

    /// Returns the script of an indentation from `touching_m`, the place of the tip that touches the tissue, m: its only tool is the tip.
    ///
    /// # Errors
    /// Refuses a tip that does not suit the tissue, with the fields of a script.
    fn script(&self, model: &Model, touching_m: DVec3, outward: DVec3, limits: &Limits) -> Result<Script> {
        let away_m = CLEARANCE * self.radius_m;
        let at = |out_m: f64| (touching_m + out_m * outward).to_array();
        let [down_s, rest_s, up_s] = self.times_s();
        let mut text = format!("name = \"indent\"\nduration_s = {up_s:?}\nsample_every_s = {SAMPLE_S}\n\n[[tool]]\n");
        let (shape, radius_m) = (self.shape.name(), self.radius_m);
        let _ = write!(text, "tip = {{ shape = {shape:?}, radius_m = {radius_m:?}, friction = 0.0 }}\nposes = [\n");
        for (at_s, out_m) in [(0.0, away_m), (down_s, -self.depth_m), (rest_s, -self.depth_m), (up_s, away_m)] {
            let _ = writeln!(text, "    {{ at_s = {at_s:?}, place_m = {:?} }},", at(out_m));
        }
        text += "]\n";
        Script::parse("indent", &text, Path::new(""), &model.scene, limits)
    }

    /// Returns the times at which the tip has arrived at its depth, leaves it, and is back, s.
    fn times_s(&self) -> [f64; 3] {
        // The tissue takes a while to come to rest around a tip that has stopped.
        let way_s = (self.depth_m + CLEARANCE * self.radius_m) / self.speed_m_per_s;
        [way_s, way_s + REST_S, 2.0 * way_s + REST_S]
    }

    /// Returns the number of steps at a rate (Hz).
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn steps(&self, rate_hz: f64) -> u64 {
        (self.times_s()[2] * rate_hz).round() as u64
    }

    /// Runs the indentation on `model` from rest, as fast as possible. `clock_s` returns a monotonic time, s; `progress` is
    /// called with the number of steps done.
    ///
    /// # Errors
    /// Returns the errors of [`run`](super::run::run), and refuses a tip that does not suit the tissue.
    #[allow(clippy::cast_precision_loss)]
    pub fn run(
        &self,
        model: &Arc<Model>,
        limits: &Limits,
        clock_s: &dyn Fn() -> f64,
        progress: &mut dyn FnMut(u64),
    ) -> std::result::Result<Indented, SimulationFailure> {
        let (place_m, outward) = on_surface(model, self.place_m, self.radius_m);
        let touching_m = touching_m(model, self.shape, self.radius_m, (place_m, outward));
        let script = self.script(model, touching_m, outward, limits)?;
        let mut samples: Vec<(f64, f64)> = Vec::new();
        let options = RunOptions::default();
        let summary = run_with(model, &script, options, limits, clock_s, &mut |event| {
            match event {
                RunEvent::Record(record) => {
                    let sample = record.tools.first().map(|tool| {
                        let depth_m = outward.dot(touching_m - DVec3::from_array(tool.place_m));
                        (depth_m, outward.dot(DVec3::from_array(tool.force_on_tool_n)))
                    });
                    samples.extend(sample);
                }
                RunEvent::Steps(steps) => progress(steps),
                RunEvent::Run(_) | RunEvent::Summary(_) => {}
            }
            Ok(())
        })?;
        let deepest = (0..samples.len()).max_by(|a, b| samples[*a].0.total_cmp(&samples[*b].0)).unwrap_or(0);
        let last_deepest =
            samples.iter().rposition(|sample| sample.0 >= samples[deepest].0 * (1.0 - 1e-6)).unwrap_or(0);
        let (loading, unloading) = (samples.get(..=deepest).unwrap_or_default(), &samples[last_deepest..]);
        let largest_m = samples.get(deepest).map_or(0.0, |sample| sample.0.max(0.0));
        let curve: Vec<DepthForce> = (0..=DEPTHS)
            .map(|k| {
                let depth_m = largest_m * k as f64 / DEPTHS as f64;
                DepthForce {
                    depth_m,
                    loading_n: at_depth(loading.iter(), depth_m),
                    unloading_n: at_depth(unloading.iter().rev(), depth_m),
                }
            })
            .collect();
        let tenth = curve[DEPTHS / 10];
        let stiffness_n_per_m = if tenth.depth_m > 0.0 { tenth.loading_n / tenth.depth_m } else { 0.0 };
        Ok(Indented { place_m, curve, stiffness_n_per_m, summary })
    }
}

/// Returns the force at a depth, between samples of ascending depth.
fn at_depth<'s>(samples: impl Iterator<Item = &'s (f64, f64)>, depth_m: f64) -> f64 {
    let mut before: Option<(f64, f64)> = None;
    for (at_m, force_n) in samples.copied() {
        if at_m >= depth_m {
            return match before {
                Some((below_m, below_n)) if at_m > below_m => {
                    below_n + (force_n - below_n) * (depth_m - below_m) / (at_m - below_m)
                }
                _ => force_n,
            };
        }
        before = Some((at_m, force_n));
    }
    before.map_or(0.0, |(_, force_n)| force_n)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A plate that reaches beyond a face on all sides presses as one that just covers it does.
    #[test]
    fn a_plate_that_is_wider_than_the_specimen_meets_no_force_before_it_touches() {
        let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.005, seed = 1 }\ncell_m = 0.02\nfixed = [{ plane_m = [0, 0, 0], \
                    normal = [0, 0, 1], within_m = 0.001 }]\n[material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.4\n";
        let model = Model::parse("block", text, &[]).unwrap();
        let press = |radius_m| {
            let indentation = Indentation {
                place_m: None,
                shape: TipShape::RigidDisc,
                radius_m,
                depth_m: 0.002,
                speed_m_per_s: 0.005,
            };
            indentation.run(&model, &Limits::default(), &|| 0.0, &mut |_| {}).unwrap()
        };
        let (covers, wider) = (press(0.071), press(0.09));
        let (first, last) = (wider.curve[0], wider.curve[DEPTHS]);
        assert!(first.loading_n.abs() < 0.05 * last.loading_n, "{:?}", wider.curve);
        assert!((last.loading_n / covers.curve[DEPTHS].loading_n - 1.0).abs() < 0.05, "{covers:?} {wider:?}");
    }
}
