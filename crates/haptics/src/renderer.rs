//! The rendering law: a thousand times a second, it computes a force from the newest local model and the tool's own
//! path.
//!
//! When a newer model arrives, the force would jump by the error of the old one. That difference is kept as a bias and
//! decays with [`BIAS_S`], so the hand feels a smooth change, not a knock.
//!
//! **A change of law.** A server that needs long for the exact law of a tissue sends a coarse one first. When the
//! tissue changes, it sends a new law. Each model names the law by which the server has placed its surface, so the
//! renderer changes the law with the first model that names the new one, and never between two models. Let F be the
//! force by the new model and law along the tool's path, and G that by the old ones. In the tick of the change, at
//! t₀, the bias is b = G(t₀) − F(t₀), and from then on the force is F(t) + b·e^{−(t − t₀)/τ}, τ = [`BIAS_S`]. At t₀
//! this is G(t₀), so there is no jump. In a later tick of length h the bias changes by at most |b|·h/τ, and the rest
//! is the change of F, the tissue's own. Both models pass through the force of their sample with any law
//! ([`Touching::at_sample`]). So apart from the error of the old model, b is not the difference of the laws' forces,
//! but that of their slopes over the distance since the sample: at most 0.1·K·s for a distance s and a coarse law
//! whose slope is within a tenth of K.
//!
//! **A copy of the tissue** ([`crate::prediction`]) gives the force in place of the local model if the client has one
//! and its error has been smaller. A change between the two also becomes a bias.
//!
//! The bias is not the force of a passive spring: it may give energy, at most |b|·v·τ when the tool moves at v. The
//! envelope counts it like all other work at the port, and its limits act on the sum. So a change of law cannot make
//! the port active, nor the force faster than the slew.

use glam::DVec3;

use crate::envelope::{Envelope, RenderingState, Wanted};
use crate::force_law::Law;
use crate::instrument_pose::{InstrumentPose, Wrench};
use crate::local_model::{ContactState, LocalModel, Touching, Track};
use crate::prediction::{MAX_OTHERS, OtherTool, Prediction, replace_others};

/// Time constant with which the bias (the difference of the force to that of the model before) decays, s.
pub const BIAS_S: f64 = 0.02;

/// Largest number of force laws that a renderer keeps. A further law replaces the oldest that neither the newest
/// model nor one that waits for the next tick names.
pub const MAX_LAWS: usize = 16;

/// Limits of [`Renderer::way_m`], m: no hand feels the smaller one, and every hand feels the larger one.
const MIN_WAY_M: f64 = 2e-5;
const MAX_WAY_M: f64 = 1e-3;

/// Renderer of one tool: it computes the force in each tick from the newest local model, the force laws and the
/// tool's path.
///
/// Samples arrive every 20 ms; between them the force follows the hand a thousand times a second. A tissue of 400 N/m
/// pushes back with 1 N at a depth of 2.5 mm:
///
/// ```
/// use glam::{DMat3, DVec3};
/// use palpate_haptics::device::UNDECLARED;
/// use palpate_haptics::{ContactState, Envelope, Law, LocalModel, Renderer};
///
/// let sample = |sequence: u64, client_time_s: f64, place_m: DVec3| LocalModel {
///     sequence,
///     client_time_s,
///     step: sequence,
///     place_m,
///     velocity_m_per_s: DVec3::ZERO,
///     force_n: 400.0 * (-place_m.z).max(0.0) * DVec3::Z,
///     stiffness_n_per_m: 400.0 * DMat3::IDENTITY,
///     damping_n_s_per_m: DMat3::ZERO,
///     surface_m: DVec3::ZERO,
///     normal: DVec3::Z,
///     curvature_per_m: DMat3::ZERO,
///     valid_m: 0.01,
///     friction: 0.2,
///     contact_state: if place_m.z < 0.0 { ContactState::Sticking } else { ContactState::Free },
///     law: 0,
/// };
/// let mut renderer = Renderer::new(Law::linear(400.0, 0.0), Envelope::new(UNDECLARED, DVec3::ZERO));
/// renderer.envelope.enable();
/// let (mut force_n, mut changes) = (DVec3::ZERO, 0);
/// for tick in 0..1000_u32 {
///     let now_s = f64::from(tick) * 1e-3;
///     // On the surface while rendering ramps in; then 25 mm/s down, to 2.5 mm.
///     let place_m = -(0.025 * (now_s - 0.7)).clamp(0.0, 0.0025) * DVec3::Z;
///     if tick.is_multiple_of(20) {
///         renderer.receive(sample(1 + u64::from(tick), now_s, place_m), now_s);
///     }
///     let before_n = std::mem::replace(&mut force_n, renderer.tick(now_s, place_m));
///     changes += u32::from(force_n != before_n);
/// }
/// assert!((force_n - 1.0 * DVec3::Z).length() < 1e-3, "{force_n} N");
/// assert!(changes > 90, "the force changed in each tick of the 100 ms of the way: {changes}");
/// ```
#[derive(Debug)]
pub struct Renderer {
    /// The laws with their numbers, the oldest first.
    laws: Vec<(u32, Law)>,
    /// The newest model in use, and the state of touch along the path since it.
    newest: Option<(LocalModel, Touching)>,
    /// A newer model that waits for the next tick, and its time of arrival, s.
    arrived: Option<(LocalModel, f64)>,
    /// Time of arrival of the newest model of any connection, s; `None` before the first.
    newest_s: Option<f64>,
    bias_n: DVec3,
    biased_s: f64,
    track: Track,
    before: Option<(f64, DVec3)>,
    velocity_m_per_s: DVec3,
    refused: u64,
    prediction: Option<Prediction>,
    /// The other tools on the tissue, by ascending number.
    others: Vec<OtherTool>,
    /// Number of ticks that were rendered from a copy of the tissue.
    predicted: u64,
    /// Whether the last tick was rendered from a copy, and its wanted force, N.
    last: (bool, DVec3),
    /// Safety envelope that limits each force before the device. Use it to enable, disable and reset rendering; its
    /// `render` is called by [`Renderer::tick`] alone.
    pub envelope: Envelope,
}

impl Renderer {
    /// Creates a renderer for a tissue with `law`, which gets number 0. The law must be sound ([`Law::is_sound`]),
    /// which is not checked. The force passes through `envelope`.
    pub fn new(law: Law, envelope: Envelope) -> Self {
        // Reserves all the memory that laws will use.
        let mut laws = Vec::with_capacity(MAX_LAWS);
        laws.push((0, law));
        Renderer {
            laws,
            newest: None,
            arrived: None,
            newest_s: None,
            bias_n: DVec3::ZERO,
            biased_s: 0.0,
            track: Track::default(),
            before: None,
            velocity_m_per_s: DVec3::ZERO,
            refused: 0,
            prediction: None,
            others: Vec::with_capacity(MAX_OTHERS),
            predicted: 0,
            last: (false, DVec3::ZERO),
            envelope,
        }
    }

    /// Sets the copy of the tissue from which forces are rendered once a sample has been compared with it; with
    /// `None`, forces are rendered from local models alone, as initially. Returns the previous copy. It may be large,
    /// so drop it outside of ticks.
    pub fn predict(&mut self, prediction: Option<Prediction>) -> Option<Prediction> {
        std::mem::replace(&mut self.prediction, prediction)
    }

    /// Replaces what is known of the other tools on the tissue, for the copy of it; at first there are none. Beyond
    /// [`MAX_OTHERS`] the last are left out. Those whose motion is not finite are left out too. Does not allocate.
    pub fn follow_others(&mut self, others: &[OtherTool]) {
        replace_others(&mut self.others, others);
    }

    /// Returns the number of ticks that were rendered from a copy of the tissue, since the renderer was created.
    pub fn predicted(&self) -> u64 {
        self.predicted
    }

    /// Restarts for a new connection: drops the models, all laws and the copy of the tissue, and keeps `law` as
    /// number 0. It must be sound ([`Law::is_sound`]), which is not checked. The envelope, the counts and the tool's
    /// track stay. Until the first model of the new connection the wanted force is 0, to which a rendered force falls
    /// within the slew; if none arrives, rendering pauses by the age of the last one. Frees memory, so call it outside
    /// of ticks.
    pub fn begin(&mut self, law: Law) {
        self.prediction = None;
        self.begin_with(law, drop);
    }

    /// Restarts for a new connection without allocating or freeing memory: drops the models, and keeps `law`, which
    /// must be sound, as number 0. Passes the previous laws, at most [`MAX_LAWS`] and the oldest first, to `used`,
    /// which should have them freed outside of ticks. A copy of the tissue stays set: also call [`Renderer::predict`]
    /// with `None`, because the copy is of another tissue.
    pub fn begin_with(&mut self, law: Law, mut used: impl FnMut(Law)) {
        self.laws.drain(..).for_each(|known| used(known.1));
        self.laws.push((0, law));
        (self.newest, self.arrived) = (None, None);
        self.others.clear();
    }

    /// Adds a law under a number that models may name from now on. Returns true; or false, and changes nothing, if it
    /// is not sound or its number is known. Beyond [`MAX_LAWS`] it replaces the oldest that no current model names. A
    /// model that names an unknown law is rendered with the oldest one.
    pub fn learn(&mut self, number: u32, law: Law) -> bool {
        law.is_sound() && self.learn_with(number, law, drop)
    }

    /// Adds a law under a number without allocating or freeing memory. The law must be sound, which is not checked.
    /// Returns true, or false if the number is known. Passes the law that is no longer needed, which is `law` itself
    /// or one that it replaces, to `used`, which should have it freed outside of ticks. Beyond [`MAX_LAWS`] it
    /// replaces the oldest that no current model names.
    pub fn learn_with(&mut self, number: u32, law: Law, used: impl FnOnce(Law)) -> bool {
        if self.laws.iter().any(|known| known.0 == number) {
            used(law);
            return false;
        }
        if self.laws.len() == MAX_LAWS {
            let in_use = [self.newest.map(|newest| newest.0.law), self.arrived.map(|arrived| arrived.0.law)];
            let oldest = self.laws.iter().position(|known| !in_use.contains(&Some(known.0)));
            used(self.laws.remove(oldest.unwrap_or(0)).1);
        }
        self.laws.push((number, law));
        true
    }

    /// Returns the number of models that were refused because they were out of order or not sound
    /// ([`LocalModel::is_sound`]), since the renderer was created.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Returns the state of rendering. Before the first model it is DISABLED, even after [`Envelope::enable`].
    pub fn state(&self) -> RenderingState {
        match self.envelope.state() {
            RenderingState::Enabled if self.newest_s.is_none() => RenderingState::Disabled,
            state => state,
        }
    }

    /// Returns the time of the model in use by the client's clock ([`LocalModel::client_time_s`]), s; `None` before
    /// the first tick with a model, and again after [`Renderer::begin`]. A model that waits for the next tick does not
    /// count.
    pub fn model_time_s(&self) -> Option<f64> {
        self.newest.as_ref().map(|newest| newest.0.client_time_s)
    }

    /// Receives a model that arrived at `now_s` by the clock of [`Renderer::tick`], s. It takes effect at the next
    /// tick and replaces one that waits for it. A model whose sequence number is not above the last, that is not
    /// sound, or that arrives at a time that is not finite, is refused and counted ([`Renderer::refused`]). One that
    /// names an unknown law is rendered with the oldest law.
    pub fn receive(&mut self, model: LocalModel, now_s: f64) {
        let arrived = self.arrived.as_ref().map(|arrived| &arrived.0);
        let newest = arrived.or(self.newest.as_ref().map(|newest| &newest.0));
        let late = newest.is_some_and(|newest| model.sequence <= newest.sequence);
        if late || !model.is_sound() || !now_s.is_finite() {
            self.refused += 1;
            return;
        }
        // The number is resolved now, so that the removal of another law changes nothing.
        let is_known = self.laws.iter().any(|known| known.0 == model.law);
        let law = if is_known { model.law } else { self.laws[0].0 };
        self.arrived = Some((LocalModel { law, ..model }, now_s));
    }

    /// Switches to a model that has arrived: repeats the tool's path since its sample, and keeps the difference from
    /// the last model as the bias.
    fn adopt(&mut self, model: LocalModel, now_s: f64) {
        let before_n = self.newest.is_some().then(|| self.wanted_n(now_s));
        let law = law_of(&self.laws, &model);
        let mut touching = Touching::at_sample(&model, law);
        for place_m in self.track.after(model.client_time_s) {
            touching.move_to(&model, law, place_m);
        }
        self.newest = Some((model, touching));
        if let Some(prediction) = &mut self.prediction {
            prediction.compare(model.client_time_s, |pose| {
                let mut then = Touching::at_sample(&model, law);
                then.move_to(&model, law, pose.place_m);
                Some(Wrench::of_force(then.force_n(&model, law, model.velocity_m_per_s)))
            });
        }
        (self.biased_s, self.bias_n) = (now_s, DVec3::ZERO);
        if let Some(before_n) = before_n {
            self.bias_n = before_n - self.wanted_n(now_s);
        }
    }

    /// Returns the force to render before the envelope, N: that of the copy of the tissue or of the local model, with
    /// the bias.
    fn wanted_n(&self, now_s: f64) -> DVec3 {
        let Some((model, _)) = &self.newest else { return DVec3::ZERO };
        let outward = (model.contact_state != ContactState::Holding).then_some(model.normal);
        let (force_n, outward) = self.predicted_n().unwrap_or_else(|| (self.modelled_n(), outward));
        let force_n = force_n + self.bias_n * ((self.biased_s - now_s) / BIAS_S).exp();
        // A touch never pulls.
        outward.map_or(force_n, |outward| force_n - force_n.dot(outward).min(0.0) * outward)
    }

    /// Returns the force from the copy of the tissue, N, if it is to be rendered, and the direction out of the tissue.
    fn predicted_n(&self) -> Option<(DVec3, Option<DVec3>)> {
        let (model, _) = self.newest.as_ref()?;
        self.prediction.as_ref()?.wanted_n(model.normal)
    }

    /// Returns the force by the law and the newest model, N.
    fn modelled_n(&self) -> DVec3 {
        self.newest.as_ref().map_or(DVec3::ZERO, |(model, touching)| {
            touching.force_n(model, law_of(&self.laws, model), self.velocity_m_per_s)
        })
    }

    /// Returns the distance by which a server may be wrong about the tool's place so that the force is wrong by at
    /// most the fraction `share` of itself, m.
    ///
    /// A distance w changes the force by at most max(k, k_t)·w, with F, k and k_t the law's force and its stiffness
    /// along and across the normal, so w = `share`·F(d)/max(k, k_t) at a depth d. At a
    /// height h above the tissue it is `share`·h. It is kept between 0.02 and 1 mm, and is 0.02 mm before the first
    /// model.
    pub fn way_m(&self, share: f64) -> f64 {
        let Some((model, touching)) = &self.newest else { return MIN_WAY_M };
        let (depth_m, row) = touching.at_law(model, law_of(&self.laws, model));
        let way_m = if depth_m > 0.0 {
            share * row.force_n / row.stiffness_n_per_m.max(row.across_n_per_m).max(f64::MIN_POSITIVE)
        } else {
            share * -depth_m
        };
        way_m.clamp(MIN_WAY_M, MAX_WAY_M)
    }

    /// Advances by one tick: records the tool's place (m, in the tissue's frame) at `now_s` by the client's clock, s,
    /// and switches to a model that has arrived. Does not allocate. A value that is not finite is not recorded and
    /// makes the envelope's state FAULT. Returns the force to render until the next tick, N: F(t) + b·e^{−(t − t₀)/τ}
    /// as at the top of this module, within the limits of the envelope.
    pub fn tick(&mut self, now_s: f64, place_m: DVec3) -> DVec3 {
        let known = place_m.is_finite() && now_s.is_finite();
        if let Some((then_s, from_m)) = self.before.filter(|_| known)
            && now_s > then_s
        {
            self.velocity_m_per_s = (place_m - from_m) / (now_s - then_s);
        }
        if known {
            self.before = Some((now_s, place_m));
            self.track.push(now_s, place_m);
            if let Some((model, touching)) = &mut self.newest {
                touching.move_to(model, law_of(&self.laws, model), place_m);
            }
            let others = &self.others;
            if let Some(prediction) = &mut self.prediction {
                self.envelope.supply(prediction.move_to(now_s, &InstrumentPose::at(place_m), others));
            }
            if let Some((model, arrived_s)) = self.arrived.take() {
                self.newest_s = Some(arrived_s);
                self.adopt(model, now_s);
            }
        }
        let is_predicted = self.predicted_n().is_some();
        if is_predicted != self.last.0 {
            (self.biased_s, self.bias_n) = (now_s, DVec3::ZERO);
            self.bias_n = self.last.1 - self.wanted_n(now_s);
        }
        let force_n = self.wanted_n(now_s);
        self.last = (is_predicted, force_n);
        self.predicted += u64::from(is_predicted);
        if known && self.prediction.is_some() {
            let modelled_n = self.modelled_n();
            self.prediction
                .iter_mut()
                .for_each(|prediction| prediction.keep(now_s, &InstrumentPose::at(place_m), modelled_n));
        }
        // While forces are rendered, the first model of a new connection counts as late like any other.
        let counts = self.newest.is_some() || self.envelope.is_engaged();
        let age_s = self.newest_s.filter(|_| counts).map(|newest_s| now_s - newest_s);
        let wanted = Wanted { now_s, place_m, velocity_m_per_s: self.velocity_m_per_s, force_n, age_s };
        self.envelope.render(&wanted)
    }
}

/// Returns the law that a model names, or the oldest if it is unknown.
fn law_of<'l>(laws: &'l [(u32, Law)], model: &LocalModel) -> &'l Law {
    &laws.iter().find(|known| known.0 == model.law).unwrap_or(&laws[0]).1
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::device::UNDECLARED;
    use crate::envelope::ENGAGE_BELOW_N;

    /// Returns the model of a tool at rest at `place_m`, on a surface at `height_m` with a spring of 400 N/m.
    fn model(sequence: u64, time_s: f64, place_m: DVec3, height_m: f64) -> LocalModel {
        LocalModel {
            sequence,
            law: 0,
            client_time_s: time_s,
            step: sequence,
            place_m,
            velocity_m_per_s: DVec3::ZERO,
            force_n: 400.0 * (height_m - place_m.z) * DVec3::Z,
            stiffness_n_per_m: DMat3::IDENTITY,
            damping_n_s_per_m: DMat3::IDENTITY,
            surface_m: height_m * DVec3::Z,
            normal: DVec3::Z,
            curvature_per_m: DMat3::ZERO,
            valid_m: 0.01,
            friction: 0.2,
            contact_state: ContactState::Sticking,
        }
    }

    fn renderer() -> Renderer {
        Renderer::new(Law::linear(400.0, 0.5), Envelope::new(UNDECLARED, DVec3::ZERO))
    }

    #[test]
    fn a_moving_hand_feels_the_spring_where_it_is_and_the_damping_of_its_speed() {
        let mut renderer = renderer();
        let place_m = |tick: u32| -DVec3::Z * (0.002 + 1e-4 * f64::from(tick));
        renderer.receive(model(1, 0.0, place_m(0), 0.0), 0.0);
        for tick in 0..30 {
            let now_s = f64::from(tick) * 1e-3;
            renderer.tick(now_s, place_m(tick));
            // 0.1 m/s from the second tick on.
            let damping_n = if tick == 0 { 0.0 } else { 0.05 };
            let expected_n = 0.8 + 0.04 * f64::from(tick) + damping_n;
            let wanted_n = renderer.wanted_n(now_s);
            assert!((wanted_n - expected_n * DVec3::Z).length() < 1e-9, "{tick}: {wanted_n}");
        }
    }

    #[test]
    fn nothing_is_enabled_before_the_first_model() {
        let (mut renderer, place_m) = (renderer(), 0.001 * DVec3::Z);
        renderer.envelope.enable();
        for tick in 0..800 {
            assert_eq!(renderer.tick(f64::from(tick) * 1e-3, place_m), DVec3::ZERO);
            assert_eq!(renderer.state(), RenderingState::Disabled);
        }
        renderer.receive(model(1, 0.8, place_m, 0.0), 0.8);
        assert_eq!(renderer.state(), RenderingState::Disabled);
        renderer.tick(0.8, place_m);
        assert_eq!(renderer.state(), RenderingState::Enabled);
        // Another connection begins, without another call to `enable`.
        renderer.begin(Law::linear(400.0, 0.5));
        renderer.tick(0.801, place_m);
        assert_eq!(renderer.state(), RenderingState::Enabled);
    }

    #[test]
    fn a_tip_that_the_first_model_finds_in_the_tissue_feels_nothing_until_it_is_out() {
        // 4 mm deep: 1.6 N by every model.
        let (mut renderer, deep_m, out_m) = (renderer(), -0.004, 0.001);
        let (mut tick, mut height_m) = (0_u32, deep_m);
        // The largest force of half a second. The tip goes there at 0.05 m/s, so that its work pays for what it feels.
        let mut run = |renderer: &mut Renderer, to_m: f64, hears: bool| {
            let mut largest_n: f64 = 0.0;
            for _ in 0..500 {
                height_m += (to_m - height_m).clamp(-5e-5, 5e-5);
                let (now_s, place_m) = (f64::from(tick) * 1e-3, height_m * DVec3::Z);
                if hears {
                    renderer.receive(model(u64::from(tick), now_s, place_m, 0.0), now_s);
                }
                largest_n = largest_n.max(renderer.tick(now_s, place_m).length());
                tick += 1;
            }
            largest_n
        };
        renderer.envelope.enable();
        assert_eq!(run(&mut renderer, deep_m, false), 0.0);
        assert_eq!(run(&mut renderer, deep_m, true), 0.0);
        assert!(run(&mut renderer, out_m, true) < ENGAGE_BELOW_N);
        run(&mut renderer, out_m, true);
        assert!(run(&mut renderer, deep_m, true) > 1.5);
        // Another server continues at once, and so does the force.
        renderer.begin(Law::linear(400.0, 0.5));
        assert!(run(&mut renderer, deep_m, true) > 1.5);
        // The first model of another server takes too long: rendering is paused, and starts as at the beginning once
        // enabled.
        renderer.begin(Law::linear(400.0, 0.5));
        run(&mut renderer, deep_m, false);
        assert_eq!(renderer.state(), RenderingState::Paused);
        renderer.envelope.enable();
        assert!(run(&mut renderer, deep_m, false) < 1e-3);
        assert_eq!(renderer.state(), RenderingState::Enabled);
        assert!(run(&mut renderer, deep_m, true) < 1e-3);
    }

    #[test]
    fn a_newer_model_changes_the_force_without_a_jump() {
        let (mut renderer, place_m) = (renderer(), -0.004 * DVec3::Z);
        renderer.receive(model(1, 0.0, place_m, 0.0), 0.0);
        renderer.tick(0.0, place_m);
        assert!((renderer.wanted_n(0.0).z - 1.6).abs() < 1e-12);
        // The first model's surface was a millimetre too high: 1.6 N instead of 1.2.
        renderer.receive(model(2, 0.001, place_m, -0.001), 0.001);
        renderer.tick(0.001, place_m);
        for (later_s, expected_n) in [(0.0, 1.6), (BIAS_S, 1.2 + 0.4 / std::f64::consts::E), (1.0, 1.2)] {
            let wanted_n = renderer.wanted_n(0.001 + later_s);
            assert!((wanted_n - expected_n * DVec3::Z).length() < 1e-9, "{later_s} s: {wanted_n}");
        }
    }

    /// A copy of the spring with its stiffness multiplied by a factor.
    struct Copy(f64);

    impl crate::Predictor for Copy {
        fn feel(&mut self, _: f64, pose: &InstrumentPose, _: &[OtherTool]) -> Option<crate::Predicted> {
            let place_m = pose.place_m;
            let contact_state = if place_m.z < 0.0 { ContactState::Sticking } else { ContactState::Free };
            Some(crate::Predicted {
                wrench: Wrench::of_force(-400.0 * self.0 * place_m.z.min(0.0) * DVec3::Z),
                contact_state,
                own_work_j: 0.0,
                others_work_j: 0.0,
            })
        }
    }

    #[test]
    fn a_hand_that_lifts_off_a_copy_that_is_off_is_let_go_of_without_a_knock_and_is_not_pulled() {
        // A sample may be of the previous tick, after which there is no forecast.
        for (factor, late) in [(0.8, 50), (1.25, 50), (0.8, 1), (1.25, 1)] {
            let mut renderer = renderer();
            renderer.predict(Some(Prediction::new(Box::new(Copy(factor)))));
            // 7.5 mm deep, and up with 40 mm/s.
            let at = |tick: u32| (-0.0075 + 4e-5 * f64::from(tick.max(300) - 300)) * DVec3::Z;
            let mut before_n = DVec3::ZERO;
            for tick in 0..600 {
                let now_s = 1e-3 * f64::from(tick);
                if tick >= late {
                    let then_s = 1e-3 * f64::from(tick - late);
                    renderer.receive(model(u64::from(tick), then_s, at(tick - late), 0.0), now_s);
                }
                renderer.tick(now_s, at(tick));
                let (wanted_n, true_n) = (renderer.wanted_n(now_s), -400.0 * at(tick).z.min(0.0));
                if tick > 200 {
                    // The spring itself falls by 16 mN a tick.
                    assert!((before_n - wanted_n).length() < 0.04, "{factor}, {late}, {tick}: {before_n} {wanted_n}");
                    assert!(wanted_n.z >= 0.0 && (wanted_n.z - true_n).abs() < 0.2, "{factor}, {tick}: {wanted_n}");
                }
                before_n = wanted_n;
            }
            assert!(renderer.predicted() > 500 && before_n == DVec3::ZERO, "{}", renderer.predicted());
        }
    }

    #[test]
    fn the_time_of_the_newest_model_is_that_of_the_one_that_is_rendered() {
        let (mut renderer, place_m) = (renderer(), -0.004 * DVec3::Z);
        assert_eq!(renderer.model_time_s(), None);
        renderer.receive(model(1, 0.25, place_m, 0.0), 0.5);
        // It takes effect at the next tick.
        assert_eq!(renderer.model_time_s(), None);
        renderer.tick(0.5, place_m);
        assert_eq!(renderer.model_time_s(), Some(0.25));
        renderer.begin(Law::linear(400.0, 0.5));
        assert_eq!(renderer.model_time_s(), None);
    }
}
