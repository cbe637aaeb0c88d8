//! A client of a load that leads a tool with a tip, as a device does: it renders the force by local models, and tells of its tool
//! what the server would not guess.

use glam::DVec3;
use palpate_proto::geometry::vector;
use palpate_proto::{pb, touch};
use palpate_touch::deadband::HEARTBEAT_S;
use palpate_touch::news::News;
use palpate_touch::{Device, Envelope, Renderer, Tip};
use pb::command::Action;

use super::stroke::Stroke;

/// What clients leave out because the other end can do without.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Deadbands {
    /// Of samples: fraction of the force that is rendered; 0: one a step.
    pub(crate) down: f64,
    /// Of poses; 0: one a tick.
    pub(crate) up: f64,
}

/// The device of all clients.
const DEVICE: &str = "omega3";

/// What a haptic stream of such a client asks for.
pub(crate) fn opening(open: pb::TouchOpen, deadbands: Deadbands) -> pb::TouchOpen {
    pb::TouchOpen {
        device: Device::named(DEVICE).map(|device| touch::device(&device)),
        tip: Some(touch::tip(&Tip::default())),
        deadband: (deadbands.down > 0.0)
            .then(|| pb::Deadband { rendered_fraction: Some(deadbands.down), ..Default::default() }),
        heartbeat_s: Some(HEARTBEAT_S),
        ..open
    }
}

/// One client's tool.
pub(crate) struct Led {
    up: f64,
    renderer: Renderer,
    news: News,
}

impl Led {
    /// Of a stream that was opened; `None` if the server tells no law.
    pub(crate) fn new(opened: &pb::TouchOpened, deadbands: Deadbands) -> Option<Self> {
        let law = touch::from_law(opened.law.as_ref()?).ok()?;
        let renderer = Renderer::new(law, Envelope::new(Device::named(DEVICE)?, DVec3::ZERO));
        Some(Led { up: deadbands.up, renderer, news: News::default() })
    }

    /// A further law.
    pub(crate) fn learn(&mut self, update: &pb::ForceLawUpdate) {
        if let Some(message) = &update.law
            && let Ok(law) = touch::from_law(message)
        {
            self.renderer.learn(message.number, law);
        }
    }

    /// Takes a sample that came at `now_s`.
    pub(crate) fn hear(&mut self, sample: &pb::Sample, now_s: f64) {
        if let Some(model) = sample.tools.first().and_then(|tool| tool.local_model.as_ref()) {
            self.renderer.receive(touch::from_local_model(model, sample.step), now_s);
        }
    }

    /// One tick of the device: renders, and tells what is to be said of the tool.
    pub(crate) fn tick(&mut self, stroke: &Stroke, time_s: f64, now_s: f64) -> Option<Action> {
        let place_m = stroke.place_m(time_s)?;
        self.renderer.tick(now_s, place_m);
        let velocity_m_per_s = if self.up > 0.0 {
            let told = self.news.tell(now_s, place_m, self.renderer.way_m(self.up), HEARTBEAT_S)?;
            vector(told.velocity_m_per_s)
        } else {
            None
        };
        Some(Action::Pose(pb::Pose { velocity_m_per_s, ..touch::pose(place_m, &Tip::default()) }))
    }
}
