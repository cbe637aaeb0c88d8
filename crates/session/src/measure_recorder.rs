//! The rows of a session's tools after each step, for the measures of what somebody did with them.

use glam::DVec3;

use crate::{Session, Tool};
use palpate_exercise::{MeasureOptions, Measures, PressedDisc, ToolRow};
use palpate_haptics::{ContactState, Tip, TipShape};
use palpate_refusal::Result;
use palpate_tissue::scene::profile::{Moment, Poke};
use palpate_tissue::scene::script::Script;
use palpate_tissue::shape::{PointId, RestShape};
use palpate_tissue::{Model, ToolContact};

/// Measures what the tools of a session do. Show it the session after each step; the same steps give the same figures,
/// whether the session runs, plays a script or is replayed.
///
/// Tools with a tip have a row while they are led, forces while they push, and grasped points while they are held.
#[derive(Debug, Clone)]
pub struct MeasureRecorder {
    measures: Measures,
    /// A script whose forces and moves are played as functions of time, so that the session has no commands of them.
    continuous: Option<Script>,
    newest: u64,
    rows: Vec<ToolRow>,
    /// Memory for the rows that are being collected.
    collected: Vec<ToolRow>,
}

impl MeasureRecorder {
    /// Begins at step `begin_step` of a session of this tissue. `continuous` is the script that the session plays as
    /// functions of time ([`Session::play_script`]), if it does.
    ///
    /// # Errors
    /// Returns the refusals of [`MeasureOptions::check`].
    pub fn new(model: &Model, begin_step: u64, options: MeasureOptions, continuous: Option<&Script>) -> Result<Self> {
        options.check()?;
        let seen_along = options.seen_along;
        let rate_hz = model.scene.stepping.rate_hz;
        let measures = Measures::new(rate_hz, begin_step, options, surface_m(model.shape(), seen_along).into_iter());
        Ok(MeasureRecorder {
            measures,
            continuous: continuous.cloned(),
            newest: begin_step,
            rows: Vec::new(),
            collected: Vec::new(),
        })
    }

    /// Returns a recorder of the same tissue that begins at step `begin_step`. This one must have seen nothing.
    #[must_use]
    pub fn beginning_at(&self, begin_step: u64) -> Self {
        MeasureRecorder { measures: self.measures.beginning_at(begin_step), newest: begin_step, ..self.clone() }
    }

    /// Takes the session at its present step. Steps that were skipped at rest count as if nothing had changed in them. A
    /// step that it has seen already has no effect, except the first one, at which tools may begin.
    pub fn see(&mut self, session: &Session) {
        let step = session.step_count();
        if self.is_new(step) {
            let mut rows = std::mem::take(&mut self.collected);
            self.collect(session, &mut rows);
            self.see_rows(step, &rows);
            self.collected = rows;
        }
    }

    /// Takes the rows of a step that another recorder of the session has collected ([`MeasureRecorder::rows`]), as
    /// [`MeasureRecorder::see`] takes the session.
    pub(crate) fn see_rows(&mut self, step: u64, rows: &[ToolRow]) {
        if !self.is_new(step) {
            return;
        }
        (self.newest + 1..step).for_each(|_| self.measures.step(&self.rows));
        self.rows.clear();
        self.rows.extend_from_slice(rows);
        if step == self.newest {
            self.measures.begin(&self.rows);
        } else {
            self.measures.step(&self.rows);
        }
        self.newest = step;
    }

    /// Returns whether the rows of a step are wanted: of a new one, and of the first while no other was seen.
    fn is_new(&self, step: u64) -> bool {
        step > self.newest || step == self.newest && self.measures.steps() == 0
    }

    /// Returns the rows of the tools at the newest step.
    pub fn rows(&self) -> &[ToolRow] {
        &self.rows
    }

    /// Returns the measures so far.
    pub fn measures(&self) -> &Measures {
        &self.measures
    }

    /// Returns the measures, at the end.
    pub fn into_measures(self) -> Measures {
        self.measures
    }

    fn collect(&self, session: &Session, rows: &mut Vec<ToolRow>) {
        rows.clear();
        // It reads the springs near a tool: only for who asks for it.
        let is_measured = self.measures.options().limits.strain.is_some();
        let edge_m = session.model().shape().edge_m();
        let near = |rest_m: DVec3, radius_m: f64| {
            let reach_m = STRAIN_REACH * radius_m.max(edge_m);
            is_measured.then(|| session.tissue().strain_around(rest_m, reach_m))
        };
        if let Some(script) = &self.continuous {
            let step = session.step_count();
            let now = step.checked_sub(1).map_or(Moment::start_of(0), |step| Moment { step, fraction: 1.0 });
            for (tool, profile) in script.forces.iter().enumerate() {
                let poke = profile.at(now, script.rate_hz);
                if poke.force_n != DVec3::ZERO {
                    rows.push(row_of_push(session, tool, &poke, &near));
                }
            }
            for (index, profile) in script.moves.iter().enumerate() {
                rows.push(row_of_point(session, script.forces.len() + index, profile.point, &near));
            }
        }
        let of = |(number, tool): (usize, &Tool)| match session.tissue().tool_contact(number) {
            Some(contact) => Some(row_of_tip(number, &contact, tool.posed.as_ref().map(|posed| posed.tip), &near)),
            None => {
                let point = tool.control_point.filter(|_| tool.posed.is_none())?;
                let state = session.tissue().point(point);
                let acts = state.constraint_n.is_some() || state.applied_n != DVec3::ZERO;
                acts.then(|| match &tool.around {
                    Some(poke) => row_of_push(session, number, poke, &near),
                    None => row_of_point(session, number, point, &near),
                })
            }
        };
        rows.extend(session.tools.iter().enumerate().filter_map(of));
        // A tool that was played as a function of time may have got a command later.
        rows.sort_by_key(|row| row.tool);
        rows.dedup_by_key(|row| row.tool);
    }
}

/// How far around a tool the strain of the tissue is measured: radii of its tip, and at least edges of the tissue.
const STRAIN_REACH: f64 = 2.0;

/// The largest strain of the tissue near a place at rest, m, that a tool of some radius, m, touches; `None` if it is not measured.
type StrainNear<'f> = &'f dyn Fn(DVec3, f64) -> Option<f64>;

/// The cosine of the angle up to which a triangle faces who looks at it: 60°.
const FACES: f64 = 0.5;

/// Returns the triangles of the surface at rest, m: those whose corners are points, or else those that frames show; of these the ones
/// that face against `seen_along`, or all.
fn surface_m(shape: &dyn RestShape, seen_along: Option<DVec3>) -> Vec<[DVec3; 3]> {
    let mut triangles_m = all_triangles_m(shape);
    if let Some(seen_along) = seen_along {
        let normal = |[a, b, c]: &[DVec3; 3]| (*b - *a).cross(*c - *a).normalize_or_zero();
        triangles_m.retain(|corners_m| normal(corners_m).dot(seen_along) <= -FACES);
    }
    triangles_m
}

/// Returns all triangles of the surface at rest, m.
fn all_triangles_m(shape: &dyn RestShape) -> Vec<[DVec3; 3]> {
    let of_points = shape.triangles();
    if !of_points.is_empty() {
        let rest_m = |corner: u32| shape.rest_m(PointId::new(corner as usize));
        return of_points.into_iter().map(|corners| corners.map(rest_m)).collect();
    }
    let of_shown = |shown: palpate_tissue::shape::ShownShape<'_>| {
        let corners_m = |corners: &[u32; 3]| corners.map(|corner| shown.vertices_m[corner as usize]);
        shown.triangles.iter().map(corners_m).collect()
    };
    shape.shown_surface().map(of_shown).unwrap_or_default()
}

#[allow(clippy::cast_possible_truncation)]
fn row_of_tip(tool: usize, contact: &ToolContact, tip: Option<Tip>, near: StrainNear<'_>) -> ToolRow {
    let (rest_m, normal) = match contact.rest {
        Some(rest) => (rest.place_m, rest.normal),
        None => (contact.anchor_m, DVec3::new(0.0, 0.0, 1.0_f64.copysign(contact.normal.z))),
    };
    let is_in_contact = contact.contact_state != ContactState::Free;
    let indentation_m = (contact.anchor_m - contact.surface_m).dot(normal);
    // An edge has no area.
    let presses = tip.filter(|tip| is_in_contact && tip.shape != TipShape::Blade);
    let disc = presses.map(|Tip { radius_m, .. }| {
        let pressing_n = contact.force_on_tool_n.dot(contact.normal).max(0.0);
        let pressure_pa = pressing_n / (std::f64::consts::PI * radius_m * radius_m);
        PressedDisc { rest_m, normal, radius_m, pressure_pa }
    });
    let (place_m, force_n) = (contact.place_m, contact.force_on_tool_n);
    let radius_m = tip.filter(|tip| tip.shape != TipShape::Blade).map_or(0.0, |tip| tip.radius_m);
    let strain = if is_in_contact { near(rest_m, radius_m) } else { None };
    ToolRow { tool: tool as u32, place_m, force_n, is_in_contact, indentation_m, disc, strain }
}

/// Returns the row of a force around a place.
#[allow(clippy::cast_possible_truncation)]
fn row_of_push(session: &Session, tool: usize, poke: &Poke, near: StrainNear<'_>) -> ToolRow {
    if let Some(point) = poke.point {
        return row_of_point(session, tool, point, near);
    }
    let (tissue, shape) = (session.tissue(), session.model().shape());
    let displacement_m = tissue.surface_displacement_m(poke.centre_m);
    ToolRow {
        tool: tool as u32,
        place_m: poke.centre_m + displacement_m,
        force_n: tissue.reaction_around_n(poke),
        is_in_contact: true,
        indentation_m: -displacement_m.dot(shape.normal(shape.nearest(poke.centre_m))),
        disc: None,
        strain: near(poke.centre_m, 0.0),
    }
}

/// Returns the row of a force on a point, or of a grasped one.
#[allow(clippy::cast_possible_truncation)]
fn row_of_point(session: &Session, tool: usize, point: PointId, near: StrainNear<'_>) -> ToolRow {
    let (state, shape) = (session.tissue().point(point), session.model().shape());
    ToolRow {
        tool: tool as u32,
        place_m: shape.rest_m(point) + state.displacement_m,
        force_n: state.reaction_n(),
        is_in_contact: true,
        indentation_m: -state.displacement_m.dot(shape.normal(point)),
        disc: None,
        strain: near(shape.rest_m(point), 0.0),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::Cursor;
    use std::path::Path;
    use std::sync::Arc;

    use super::*;
    use crate::input::Input;
    use crate::journal::{JournalReader, JournalWriter, Replay, ReplayEvent, pb};
    use crate::simulation::Simulation;
    use palpate_exercise::{Figure, ToolLimits};
    use palpate_tissue::limits::Limits;

    fn liver() -> Arc<Model> {
        Model::parse("liver", include_str!("../../../scenes/liver.toml"), &[]).unwrap()
    }

    fn script(text: &str, model: &Model) -> Script {
        Script::parse("test", text, Path::new(""), &model.scene, &Limits::default()).unwrap()
    }

    fn value(figures: &[Figure], name: &str, tool: Option<u32>) -> Option<f64> {
        figures.iter().find(|figure| figure.definition.name == name && figure.tool == tool).map(|figure| figure.value)
    }

    /// With limits of each kind.
    fn limited() -> MeasureOptions {
        let limits = ToolLimits { force_n: Some(0.05), pressure_pa: Some(500.0), strain: Some(0.02) };
        MeasureOptions { limits, ..MeasureOptions::default() }
    }

    /// Measures a simulation of a script, and calls `record` with what acts at each step.
    fn measured(
        model: &Arc<Model>,
        script: &Script,
        held: bool,
        mut record: impl FnMut(&Simulation),
    ) -> MeasureRecorder {
        let mut simulation = Simulation::playing(model, script, held, &Limits::default()).unwrap();
        let continuous = (!held).then_some(script);
        let mut recorder = MeasureRecorder::new(model, 0, limited(), continuous).unwrap();
        for _ in 0..script.steps {
            simulation.take_inputs(0).unwrap();
            record(&simulation);
            let Simulation { session, due, .. } = &mut simulation;
            session.advance(due, |session| recorder.see(session));
        }
        recorder
    }

    /// A tip that strokes 10 mm and leaves, a force, a grasped point, and a pause in which the tissue comes to rest.
    const HANDS: &str = "duration_s = 0.6\nsample_every_s = 0.1\n\
        [[force]]\nat_m = [0.02, 0.02]\nforce_n = [0.0, 0.0, -0.1]\nfalloff_per_m = 300.0\nfalloff_offset = 0.0\n\
        profile = { type = \"pulse\", on_s = 0.1, off_s = 0.2 }\n\
        [[tool]]\npoint = [20, 20]\nmoves = [{ from_s = 0.0, to_s = 0.1, by_m = [0.0, 0.0, -0.002] }]\n\
        [[tool]]\ntip = { radius_m = 0.005 }\nposes = [{ at_s = 0.0, place_m = [0.03, 0.03, 0.002] }, \
        { at_s = 0.05, place_m = [0.03, 0.03, -0.002] }, { at_s = 0.2, place_m = [0.04, 0.03, -0.002] }]\nuntil_s = 0.25\n";

    #[test]
    fn a_journal_gives_the_bits_of_the_figures_of_the_session_that_it_recorded() {
        let model = liver();
        let script = script(HANDS, &model);
        let mut writer = JournalWriter::at_rest(&model);
        let recorded = measured(&model, &script, true, |simulation| {
            for due in &simulation.due {
                writer.input(simulation.session.step_count(), &Input::Command(due.clone()));
            }
        });
        let journal = writer.finish(pb::Why::Drained, "", script.steps, 1);
        let mut reader = JournalReader::new("measured.mcap", Cursor::new(journal)).unwrap();
        let survey = reader.survey(&mut |_| {}).unwrap();
        let mut replay = Replay::new(reader, survey, &Limits::default()).unwrap();
        let mut replayed = MeasureRecorder::new(&model, 0, limited(), None).unwrap();
        replay
            .advance(u64::MAX, &mut |event| {
                if let ReplayEvent::Step(session) = event {
                    replayed.see(session);
                }
                Ok(())
            })
            .unwrap();
        let (recorded, replayed) = (recorded.measures().figures(), replayed.measures().figures());
        assert!(recorded.len() > 50, "{}", recorded.len());
        assert_eq!(recorded, replayed);
        for (name, tool) in [
            ("peak_strain", Some(0)),
            ("peak_strain", Some(1)),
            ("strain_above_limit_share", Some(2)),
            ("pressure_above_limit_share", Some(2)),
            ("force_above_limit_share", None),
        ] {
            assert!(value(&recorded, name, tool).is_some_and(|value| value > 0.0), "{name} of {tool:?}");
        }
        assert_eq!(value(&recorded, "pressure_above_limit_share", Some(1)), Some(0.0));
    }

    #[test]
    fn each_tool_of_a_script_is_measured_and_a_pressed_disc_covers_where_it_was() {
        let model = liver();
        let script = script(HANDS, &model);
        let recorder = measured(&model, &script, false, |_| {});
        let figures = recorder.measures().figures();
        let near = |name: &str, tool: Option<u32>, expected: f64, tolerance: f64| {
            let value = value(&figures, name, tool).unwrap();
            assert!((value - expected).abs() <= tolerance, "{name} of {tool:?}: {value} instead of {expected}");
        };
        near("contact_time_s", Some(0), 0.1, 0.0015);
        near("contact_time_s", Some(1), 0.6, 1e-9);
        near("path_length_m", Some(1), 0.002, 2e-5);
        near("peak_indentation_m", Some(1), 0.002, 1e-9);
        near("path_length_m", Some(2), 0.014, 1e-6);
        near("economy", Some(2), 0.01077 / 0.014, 1e-3);
        // The surface is as deep as the tool, in the mean over its disc.
        near("peak_indentation_m", Some(2), 0.002, 2e-4);
        assert_eq!(value(&figures, "peak_pressure_pa", Some(1)), None);
        let (peak_pa, force_n) =
            (value(&figures, "peak_pressure_pa", Some(2)).unwrap(), value(&figures, "peak_force_n", Some(2)).unwrap());
        assert!(peak_pa > 1000.0 && peak_pa <= force_n / (std::f64::consts::PI * 2.5e-5), "{peak_pa} Pa, {force_n} N");
        // Two halves of the disc, and the way between them.
        let swept_m2 = std::f64::consts::PI * 2.5e-5 + 0.01 * 0.01;
        let covered_m2 = recorder.measures().surface().covered_m2(f64::MIN_POSITIVE);
        assert!((covered_m2 / swept_m2 - 1.0).abs() < 0.1, "{covered_m2} m² instead of {swept_m2}");
        // What the tissue was given is not less than nothing.
        assert!(value(&figures, "work_j", None).unwrap() > 0.0);
    }
}
