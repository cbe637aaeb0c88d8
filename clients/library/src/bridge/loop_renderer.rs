//! What a loop renders with: the rendering law of a single tip, or that of an instrument.

use palpate_haptics::{
    Envelope, InstrumentPose, InstrumentRenderer, Law, LocalModel, OtherInstrument, OtherTool, Prediction, Renderer,
    RenderingState, SecondHand, Wrench, WrenchSample,
};

/// The renderer of a loop.
pub(super) enum LoopRenderer {
    Tip(Box<Renderer>),
    Instrument(Box<InstrumentRenderer>),
}

impl LoopRenderer {
    pub(super) fn envelope(&self) -> &Envelope {
        match self {
            LoopRenderer::Tip(renderer) => &renderer.envelope,
            LoopRenderer::Instrument(renderer) => &renderer.envelope,
        }
    }

    pub(super) fn envelope_mut(&mut self) -> &mut Envelope {
        match self {
            LoopRenderer::Tip(renderer) => &mut renderer.envelope,
            LoopRenderer::Instrument(renderer) => &mut renderer.envelope,
        }
    }

    /// Restarts for a new connection, as [`Renderer::begin_with`] does.
    pub(super) fn begin_with(&mut self, law: Law, mut used: impl FnMut(Law)) {
        match self {
            LoopRenderer::Tip(renderer) => renderer.begin_with(law, used),
            LoopRenderer::Instrument(renderer) => {
                renderer.begin();
                used(law);
            }
        }
    }

    /// Adds a law, as [`Renderer::learn_with`] does; an instrument has no use for it.
    pub(super) fn learn_with(&mut self, number: u32, law: Law, used: impl FnOnce(Law)) {
        match self {
            LoopRenderer::Tip(renderer) => drop(renderer.learn_with(number, law, used)),
            LoopRenderer::Instrument(_) => used(law),
        }
    }

    pub(super) fn predict(&mut self, prediction: Option<Prediction>) -> Option<Prediction> {
        match self {
            LoopRenderer::Tip(renderer) => renderer.predict(prediction),
            LoopRenderer::Instrument(renderer) => renderer.predict(prediction),
        }
    }

    pub(super) fn follow_others(&mut self, others: &[OtherTool]) {
        match self {
            LoopRenderer::Tip(renderer) => renderer.follow_others(others),
            LoopRenderer::Instrument(renderer) => renderer.follow_others(others),
        }
    }

    /// Replaces what is known of other instruments, as [`InstrumentRenderer::follow_instruments`] does; a single tip touches none.
    pub(super) fn follow_instruments(&mut self, second: Option<SecondHand>, others: &[OtherInstrument]) {
        if let LoopRenderer::Instrument(renderer) = self {
            renderer.follow_instruments(second, others);
        }
    }

    /// Returns this hand with its instrument at a pose, as its other hand follows it.
    pub(super) fn as_second_hand(&self, first_tool: u32, led: &InstrumentPose, now_s: f64) -> Option<SecondHand> {
        match self {
            LoopRenderer::Tip(_) => None,
            LoopRenderer::Instrument(renderer) => Some(renderer.as_second_hand(first_tool, led, now_s)),
        }
    }

    /// Receives what a sample contains of the kind that this renderer uses. Returns the client's time of it, s.
    pub(super) fn receive(&mut self, newest: &NewestSample, now_s: f64) -> Option<f64> {
        match (self, newest) {
            (LoopRenderer::Tip(renderer), NewestSample::Model(model)) => {
                renderer.receive(*model, now_s);
                Some(model.client_time_s)
            }
            (LoopRenderer::Instrument(renderer), NewestSample::Wrench(sample)) => {
                renderer.receive(*sample, now_s);
                Some(sample.client_time_s)
            }
            _ => None,
        }
    }

    /// Advances by one tick. Returns the wrench to render until the next.
    pub(super) fn tick(&mut self, now_s: f64, pose: &InstrumentPose) -> Wrench {
        match self {
            LoopRenderer::Tip(renderer) => Wrench::of_force(renderer.tick(now_s, pose.place_m)),
            LoopRenderer::Instrument(renderer) => renderer.tick(now_s, pose),
        }
    }

    /// Returns the distance by which a server may be wrong about the tool's place, m ([`Renderer::way_m`]); `None` if it is told each
    /// pose.
    pub(super) fn way_m(&self, share: f64) -> Option<f64> {
        match self {
            LoopRenderer::Tip(renderer) => (share > 0.0).then(|| renderer.way_m(share)),
            LoopRenderer::Instrument(_) => None,
        }
    }

    pub(super) fn predicted(&self) -> u64 {
        match self {
            LoopRenderer::Tip(renderer) => renderer.predicted(),
            LoopRenderer::Instrument(renderer) => renderer.predicted(),
        }
    }

    pub(super) fn state(&self) -> RenderingState {
        match self {
            LoopRenderer::Tip(renderer) => renderer.state(),
            LoopRenderer::Instrument(renderer) => renderer.state(),
        }
    }

    /// Returns the client's time of the model or sample in use, s.
    pub(super) fn model_time_s(&self) -> Option<f64> {
        match self {
            LoopRenderer::Tip(renderer) => renderer.model_time_s(),
            LoopRenderer::Instrument(renderer) => renderer.sample_time_s(),
        }
    }
}

/// What the newest sample contains for a renderer.
#[derive(Debug, Clone, Copy)]
#[allow(clippy::large_enum_variant)] // It is copied into a slot of fixed size.
pub(super) enum NewestSample {
    Model(LocalModel),
    Wrench(WrenchSample),
}

impl NewestSample {
    /// Returns its number, which increases.
    pub(super) fn sequence(&self) -> u64 {
        match self {
            NewestSample::Model(model) => model.sequence,
            NewestSample::Wrench(sample) => sample.sequence,
        }
    }
}
