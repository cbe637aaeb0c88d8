//! Plays a script to make pictures and GIFs.

use std::io::Write;
use std::sync::Arc;

use super::picture::{Arrow, View, picture};
use palpate_session::Session;
use palpate_session::simulation::{Simulation, SimulationFailure};
use palpate_session::surface::burns::vertex_burns;
use palpate_session::surface::{Skin, Snapshot, Wound};
use palpate_texture::Image;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::{Moment, Poke};
use palpate_tissue::scene::script::Script;
use palpate_tissue::{Burns, Model};

/// A script that is played on a session of its own, step by step and only forwards, to make pictures of it.
pub struct Film<'a> {
    simulation: Simulation,
    script: &'a Script,
    shown: Option<Arc<Skin>>,
}

/// The tissue at one moment, and the forces that act on it: all that a picture needs besides the model and the view.
pub struct Still {
    snapshot: Snapshot,
    burns: Burns,
    shown: Option<Arc<Skin>>,
    arrows: Vec<Arrow>,
}

impl<'a> Film<'a> {
    /// Starts `script` on a new session of `model`, at step 0. The script must have been bound to the scene of
    /// `model`; `limits` are those of the session.
    ///
    /// # Errors
    /// Returns [`SimulationFailure::Refused`] if one of the script's changes of the tissue, at whatever step, is
    /// refused.
    pub fn new(model: &Arc<Model>, script: &'a Script, limits: &Limits) -> Result<Self, SimulationFailure> {
        Ok(Film { simulation: Simulation::playing(model, script, false, limits)?, script, shown: Skin::of(model) })
    }

    /// Plays the script until `step` steps are done, and returns the tissue then, with an arrow for each force of the
    /// script other than zero in the step just done. It can't go back: `step` must not be below that of an earlier
    /// call.
    ///
    /// # Errors
    /// Returns [`SimulationFailure::Held`] if the session's guard ends it or puts its tissue back to an earlier
    /// state, and [`SimulationFailure::Refused`] if a server would refuse a pose of the script.
    pub fn at(&mut self, step: u64) -> Result<Still, SimulationFailure> {
        self.simulation.run_to(step)?;
        let session = &self.simulation.session;
        let model = session.model();
        // The force of the step just done: at a jump, the value before it.
        let before = step.saturating_sub(1);
        let moment = Moment { step: before, fraction: if step > 0 { 1.0 } else { 0.0 } };
        let pokes = self.script.forces.iter().map(|profile| profile.at(moment, model.scene.stepping.rate_hz));
        let arrow = |poke: Poke| Arrow { point: model.shape().nearest(poke.centre_m), towards: poke.force_n };
        let arrows = pokes.filter(|poke| poke.force_n.length() > 0.0).map(arrow).collect();
        Ok(Still::of(session, self.shown.as_ref(), arrows))
    }

    /// Plays the whole script, of which nothing may have been played yet. Returns the tissue at the first of the
    /// script's sample times (each [`Script::sample_every`] steps, from 0) with the largest displacement of a point.
    ///
    /// # Errors
    /// Returns the failures of [`Film::at`].
    pub fn deepest(&mut self) -> Result<Still, SimulationFailure> {
        let (mut most_m, mut found) = (f64::NEG_INFINITY, None);
        for step in (0..=self.script.steps).step_by(self.script.sample_every.max(1) as usize) {
            self.simulation.run_to(step)?;
            let far_m = self.simulation.session.tissue().largest_displacement_m();
            if far_m > most_m {
                (most_m, found) = (far_m, Some(self.at(step)?));
            }
        }
        match found {
            Some(still) => Ok(still),
            None => self.at(0),
        }
    }
}

impl Still {
    /// Returns the current tissue of a session, with `arrows` for forces. `shown` is the surface that is drawn of a
    /// mesh ([`Skin::of`] its model); `None` for a sheet.
    pub fn of(session: &Session, shown: Option<&Arc<Skin>>, arrows: Vec<Arrow>) -> Self {
        let mut displacement_m = std::array::from_fn(|_| Vec::new());
        session.tissue().shown_displacements_m(&mut displacement_m);
        let snapshot = Snapshot::new(&session.model().scene, session.step_count(), session.time_s(), displacement_m)
            .with_skin(shown)
            .with_cuts(session.tissue().cuts());
        Still { snapshot, burns: session.tissue().burns(), shown: shown.cloned(), arrows }
    }

    /// Returns the simulated time, s.
    pub fn time_s(&self) -> f64 {
        self.snapshot.simulation_time_s
    }

    /// Draws the tissue as seen by `view`, as [`picture`] does. `model` must be that of the session.
    pub fn picture(&self, model: &Model, view: &View) -> Image {
        let shown = self.shown.as_deref();
        let wound = Wound::of(model, self.snapshot.cuts(), shown, view.refinement);
        let burns = vertex_burns(model, &self.burns, shown, view.refinement, 0);
        picture(model.shape(), shown, &self.snapshot, wound.as_ref(), &burns, &self.arrows, view)
    }
}

/// A GIF that is being written, frame by frame, and that plays at the speed of simulated time, repeated endlessly.
/// Dropping it writes its end.
pub struct Gif<W: Write> {
    encoder: gif::Encoder<W>,
    size: [u16; 2],
    delay: f64,
    steps_a_frame: f64,
}

fn broken(e: gif::EncodingError) -> SimulationFailure {
    SimulationFailure::Output(std::io::Error::other(e))
}

impl<W: Write> Gif<W> {
    /// Starts a GIF of `frames_hz` (above 0) pictures per second of simulated time, with the size of `view`, for a
    /// session of `rate_hz` steps per second. Writes its head to `output`. The time between two frames is rounded to
    /// hundredths of a second, at least one: there are at most 100 pictures per second.
    ///
    /// # Errors
    /// Returns [`SimulationFailure::Output`] if the output can't be written.
    pub fn new(output: W, view: &View, frames_hz: f64, rate_hz: f64) -> Result<Self, SimulationFailure> {
        let size = view.size.map(|pixels| pixels as u16);
        let mut encoder = gif::Encoder::new(output, size[0], size[1], &[]).map_err(broken)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(broken)?;
        // A GIF measures delays in hundredths of a second.
        let delay = (100.0 / frames_hz).round().max(1.0);
        Ok(Gif { encoder, size, delay, steps_a_frame: 0.01 * delay * rate_hz })
    }

    /// Returns the step that frame number `frame` (from 0) shows, counted from the step of the first frame.
    pub fn step(&self, frame: u64) -> u64 {
        (frame as f64 * self.steps_a_frame).round() as u64
    }

    /// Writes a picture of the size of the view as the next frame, with at most 256 colours.
    ///
    /// # Errors
    /// Returns [`SimulationFailure::Output`] if the output can't be written.
    ///
    /// # Panics
    /// If the picture has another number of pixels than the view.
    pub fn add(&mut self, image: &Image) -> Result<(), SimulationFailure> {
        let mut picture = gif::Frame::from_rgb_speed(self.size[0], self.size[1], &image.rgb, 10);
        picture.delay = self.delay as u16;
        self.encoder.write_frame(&picture).map_err(broken)
    }
}

/// Plays the whole script on a new session of `model` into a GIF at `output`, which plays at the speed of simulated
/// time and repeats endlessly. It shows `frames_hz` pictures per second, above 0, with the time between two frames
/// rounded to hundredths of a second, at least one ([`Gif::new`]). Calls `progress` with the step of each frame, once
/// that is written.
///
/// # Errors
/// Returns the failures of [`Gif::new`], [`Film::new`], [`Film::at`] and [`Gif::add`]: the output can't be written, a
/// change or a pose of the script is refused, or the guard acts. What was written until then stays.
pub fn gif(
    model: &Arc<Model>,
    script: &Script,
    view: &View,
    limits: &Limits,
    frames_hz: f64,
    output: impl Write,
    progress: &mut dyn FnMut(u64),
) -> Result<(), SimulationFailure> {
    let mut file = Gif::new(output, view, frames_hz, model.scene.stepping.rate_hz)?;
    let mut film = Film::new(model, script, limits)?;
    for frame in 0_u64.. {
        let step = file.step(frame);
        if step > script.steps {
            break;
        }
        file.add(&film.at(step)?.picture(model, view))?;
        progress(step);
    }
    Ok(())
}
