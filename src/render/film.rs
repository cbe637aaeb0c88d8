//! Plays a script to make pictures and GIFs.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::Arc;

use super::picture::{Arrow, View, picture};
use palpate_refusal::Refusal;
use palpate_session::Session;
use palpate_session::run::{self, Player};
use palpate_session::surface::{Skin, Snapshot};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::{Moment, Poke};
use palpate_tissue::scene::script::Script;
use palpate_tissue::texture::Image;

/// The reasons why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum FilmFailure {
    /// The guard has stopped the session because its motion grew unstable.
    #[error("the run was stopped: {0}")]
    Held(String),
    /// The input was refused.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The file can't be written.
    #[error("can't write the picture: {0}")]
    Output(String),
}

/// A script that is played step by step to make pictures of it.
pub struct Film<'a> {
    session: Session,
    player: Player<'a>,
    script: &'a Script,
    changes: VecDeque<(u64, Arc<Model>)>,
    shown: Option<Arc<Skin>>,
}

/// The tissue at one moment, and the forces that act on it.
pub struct Still {
    snapshot: Snapshot,
    shown: Option<Arc<Skin>>,
    arrows: Vec<Arrow>,
}

impl<'a> Film<'a> {
    /// Starts the script on a new session of `model`.
    ///
    /// # Errors
    /// Returns a failure if a change of the tissue is refused.
    pub fn new(model: &Arc<Model>, script: &'a Script, limits: &Limits) -> Result<Self, FilmFailure> {
        let changes = model.apply_changes(&script.changes, limits)?;
        let mut session = Session::new(model);
        let player = Player::new(model, script, false, limits)?;
        player.begin(&mut session);
        Ok(Film { session, player, script, changes, shown: Skin::of(model) })
    }

    /// Advances the session until `step` steps are done.
    fn advance(&mut self, step: u64) -> Result<(), FilmFailure> {
        while self.session.step_count() < step {
            run::change(&mut self.session, &mut self.changes);
            let mut due = Vec::new();
            self.player.commands(self.session.step_count(), &mut due)?;
            self.session.advance(&mut due, |_| {});
            if let Some(reason) = self.session.fault() {
                return Err(FilmFailure::Held(reason));
            }
        }
        Ok(())
    }

    /// Plays the script until `step` steps are done, and returns the tissue then. It can't go back to an earlier
    /// step.
    ///
    /// # Errors
    /// Returns a failure if the guard stops the run or a change of the tissue is refused.
    pub fn at(&mut self, step: u64) -> Result<Still, FilmFailure> {
        self.advance(step)?;
        let model = self.session.model();
        // The force of the step just done: at a jump, the value before it.
        let before = step.saturating_sub(1);
        let moment = Moment { step: before, fraction: if step > 0 { 1.0 } else { 0.0 } };
        let pokes = self.script.forces.iter().map(|profile| profile.at(moment, model.scene.stepping.rate_hz));
        let arrow = |poke: Poke| Arrow { point: model.shape().nearest(poke.centre_m), towards: poke.force_n };
        let arrows = pokes.filter(|poke| poke.force_n.length() > 0.0).map(arrow).collect();
        Ok(Still::of(&self.session, self.shown.as_ref(), arrows))
    }

    /// Plays the whole script. Returns the tissue at the sample time with the largest displacement.
    ///
    /// # Errors
    /// Returns the failures of [`Film::at`].
    pub fn deepest(&mut self) -> Result<Still, FilmFailure> {
        let (mut most_m, mut found) = (f64::NEG_INFINITY, None);
        for step in (0..=self.script.steps).step_by(self.script.sample_every.max(1) as usize) {
            self.advance(step)?;
            let far_m = self.session.tissue().largest_displacement_m();
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
    /// Returns the current tissue of a session; `shown` is the surface that is drawn of a mesh.
    pub fn of(session: &Session, shown: Option<&Arc<Skin>>, arrows: Vec<Arrow>) -> Self {
        let mut displacement_m = std::array::from_fn(|_| Vec::new());
        session.tissue().shown_displacements_m(&mut displacement_m);
        let snapshot = Snapshot::new(&session.model().scene, session.step_count(), session.time_s(), displacement_m)
            .with_skin(shown);
        Still { snapshot, shown: shown.cloned(), arrows }
    }

    /// Returns the simulated time, s.
    pub fn time_s(&self) -> f64 {
        self.snapshot.simulation_time_s
    }

    /// Draws the tissue as seen by `view`.
    pub fn picture(&self, model: &Model, view: &View) -> Image {
        picture(model.shape(), self.shown.as_deref(), &self.snapshot, &self.arrows, view)
    }
}

/// A GIF that is being written, played at the speed of simulated time.
pub struct Gif<W: Write> {
    encoder: gif::Encoder<W>,
    size: [u16; 2],
    delay: f64,
    steps_a_frame: f64,
}

fn broken(e: &gif::EncodingError) -> FilmFailure {
    FilmFailure::Output(e.to_string())
}

impl<W: Write> Gif<W> {
    /// Starts a GIF of `frames_hz` pictures per second of simulated time, for a session of `rate_hz` steps per
    /// second. A GIF counts in hundredths of a second, so the rate is rounded accordingly.
    ///
    /// # Errors
    /// Returns a failure if the output can't be written.
    pub fn new(output: W, view: &View, frames_hz: f64, rate_hz: f64) -> Result<Self, FilmFailure> {
        let size = view.size.map(|pixels| pixels as u16);
        let mut encoder = gif::Encoder::new(output, size[0], size[1], &[]).map_err(|e| broken(&e))?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(|e| broken(&e))?;
        // A GIF measures delays in hundredths of a second.
        let delay = (100.0 / frames_hz).round().max(1.0);
        Ok(Gif { encoder, size, delay, steps_a_frame: 0.01 * delay * rate_hz })
    }

    /// Returns the step that a frame shows, counted from the step of the first frame.
    pub fn step(&self, frame: u64) -> u64 {
        (frame as f64 * self.steps_a_frame).round() as u64
    }

    /// Writes a picture as the next frame.
    ///
    /// # Errors
    /// Returns a failure if the output can't be written.
    pub fn add(&mut self, image: &Image) -> Result<(), FilmFailure> {
        let mut picture = gif::Frame::from_rgb_speed(self.size[0], self.size[1], &image.rgb, 10);
        picture.delay = self.delay as u16;
        self.encoder.write_frame(&picture).map_err(|e| broken(&e))
    }
}

/// Plays the whole script into a GIF of `frames_hz` pictures per second, at the speed of simulated time. Calls
/// `progress` with the step of each frame.
///
/// # Errors
/// Returns a failure if the guard stops the run, a change of the tissue is refused, or the file can't be written.
pub fn gif(
    model: &Arc<Model>,
    script: &Script,
    view: &View,
    limits: &Limits,
    frames_hz: f64,
    output: impl Write,
    progress: &mut dyn FnMut(u64),
) -> Result<(), FilmFailure> {
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
