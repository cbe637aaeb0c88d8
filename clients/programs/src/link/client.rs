//! The client at the device, for each scheme of rendering samples.

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::envelope::{Envelope, Wanted};
use palpate_haptics::{
    InstrumentPose, Law, LocalModel, MotionState, OtherTool, Predicted, Prediction, Predictor, Renderer, Tip, Wrench,
};
use palpate_session::tissue_copy::TissueCopy;
use palpate_tissue::Model;

use super::setup::{Rendering, Setup, TICK_S};
use super::spot::Spot;
use super::tissue::SECOND_TOOL;

/// The client at the device, by scheme.
pub(super) enum LinkClient {
    Raw(Option<LocalModel>),
    Hold(Option<LocalModel>, Option<f64>, Option<DVec3>, Box<Envelope>),
    Model(Box<Renderer>),
}

/// A copy of the tissue in the hand's frame.
struct Copied {
    tissue: TissueCopy,
    spot: Spot,
    /// The other tools in the tissue's frame; kept so that a tick allocates nothing.
    others: Vec<OtherTool>,
}

impl Predictor for Copied {
    fn feel(&mut self, now_s: f64, pose: &InstrumentPose, others: &[OtherTool]) -> Option<Predicted> {
        self.others.clear();
        self.others.extend(others.iter().map(|other| {
            let MotionState { time_s, place_m, velocity_m_per_s } = other.motion;
            let (place_m, velocity_m_per_s) =
                (self.spot.of_tissue(place_m), self.spot.direction_of_tissue(velocity_m_per_s));
            OtherTool { motion: MotionState { time_s, place_m, velocity_m_per_s }, ..*other }
        }));
        let felt = self.tissue.feel(now_s, &InstrumentPose::at(self.spot.of_tissue(pose.place_m)), &self.others)?;
        Some(Predicted { wrench: Wrench::of_force(self.spot.direction(felt.wrench.force_n)), ..felt })
    }
}

impl LinkClient {
    /// Creates the client of a setup, with rendering enabled.
    pub(super) fn new(setup: &Setup) -> Self {
        let envelope = || {
            let mut envelope = Envelope::new(setup.device, setup.spot.at_m);
            envelope.enable();
            envelope
        };
        match setup.scheme {
            Rendering::Raw => LinkClient::Raw(None),
            Rendering::Hold => LinkClient::Hold(None, None, None, Box::new(envelope())),
            Rendering::Model | Rendering::Prediction => {
                let mut client = LinkClient::Model(Box::new(Renderer::new((*setup.law).clone(), envelope())));
                client.copy(setup, &setup.model);
                client
            }
        }
    }

    /// Sets the copy of a tissue, if the client renders from one.
    pub(super) fn copy(&mut self, setup: &Setup, model: &Arc<Model>) {
        if let (LinkClient::Model(renderer), Rendering::Prediction) = (self, setup.scheme) {
            let copied =
                Copied { tissue: TissueCopy::new(model, setup.tip), spot: setup.spot, others: Vec::with_capacity(1) };
            renderer.predict(Some(Prediction::new(Box::new(copied))));
        }
    }

    /// Adds a further law, which samples may name from now on.
    pub(super) fn learn(&mut self, number: u32, law: &Law) {
        if let LinkClient::Model(renderer) = self {
            renderer.learn(number, law.clone());
        }
    }

    /// Takes the newest motion of the second tool, in the hand's frame.
    pub(super) fn follow(&mut self, tip: Tip, motion: MotionState) {
        if let LinkClient::Model(renderer) = self {
            renderer.follow_others(&[OtherTool { tool: SECOND_TOOL, tip, motion }]);
        }
    }

    /// Receives a sample that has arrived.
    pub(super) fn receive(&mut self, model: LocalModel, now_s: f64) {
        match self {
            LinkClient::Raw(newest) => *newest = Some(model),
            LinkClient::Hold(newest, arrived_s, ..) => (*newest, *arrived_s) = (Some(model), Some(now_s)),
            LinkClient::Model(renderer) => renderer.receive(model, now_s),
        }
    }

    /// Does a tick. Returns the force that the device holds until the next tick, N.
    pub(super) fn tick(&mut self, now_s: f64, place_m: DVec3) -> DVec3 {
        match self {
            LinkClient::Raw(newest) => newest.map_or(DVec3::ZERO, |model| model.force_n),
            LinkClient::Hold(newest, arrived_s, before, envelope) => {
                let moved_m = before.replace(place_m).map_or(DVec3::ZERO, |before_m| place_m - before_m);
                envelope.render(&Wanted {
                    now_s,
                    place_m,
                    velocity_m_per_s: moved_m / TICK_S,
                    force_n: newest.map_or(DVec3::ZERO, |model| model.force_n),
                    age_s: arrived_s.map(|arrived_s| now_s - arrived_s),
                })
            }
            LinkClient::Model(renderer) => renderer.tick(now_s, place_m),
        }
    }

    /// Returns the number of ticks that were rendered from a copy of the tissue.
    pub(super) fn predicted(&self) -> u64 {
        match self {
            LinkClient::Model(renderer) => renderer.predicted(),
            _ => 0,
        }
    }

    /// Returns the envelope, if there is one.
    pub(super) fn envelope(&mut self) -> Option<&mut Envelope> {
        match self {
            LinkClient::Raw(_) => None,
            LinkClient::Hold(.., envelope) => Some(envelope),
            LinkClient::Model(renderer) => Some(&mut renderer.envelope),
        }
    }

    /// Returns the time of the newest sample by the client's clock, s.
    pub(super) fn model_time_s(&self) -> Option<f64> {
        match self {
            LinkClient::Raw(newest) | LinkClient::Hold(newest, ..) => newest.map(|model| model.client_time_s),
            LinkClient::Model(renderer) => renderer.model_time_s(),
        }
    }
}
