//! A client of a load test that leads a tool with a tip, as a device does: it renders the force from local models,
//! and sends its tool's place when the server's estimate is wrong.

use glam::DVec3;
use palpate_haptics::dead_reckoning::News;
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_haptics::device::UNDECLARED;
use palpate_haptics::hand::Hand;
use palpate_haptics::{Device, Envelope, Renderer, RenderingState, Tip};
use palpate_proto::geometry::vector;
use palpate_proto::{pb, touch};
use pb::command::Action;

use super::holding::Holding;
use super::led_instrument::{self, HeldInstrument, InstrumentKind};
use super::stroke::Stroke;

/// Deadbands of a simulated client: fractions of the force, 0 to 1, below which the two ends do not send changes to
/// each other.
#[derive(Debug, Clone, Copy)]
pub struct Deadbands {
    /// Deadband of samples from the server, as a fraction of the force; with 0 the server sends one at each step.
    pub down: f64,
    /// Deadband of poses to the server, as a fraction of the force; with 0 the client sends one at each tick.
    pub up: f64,
}

/// Device and hand that lead the tool of a client.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lead {
    pub(crate) deadbands: Deadbands,
    pub(crate) device: Device,
    /// The hand that holds the device; `None`: the tool follows the stroke exactly.
    pub(crate) hand: Option<Hand>,
    /// The instrument that the hand leads, in place of a tool; then there is no device, and nothing is rendered.
    pub(crate) instrument: Option<InstrumentKind>,
}

/// Returns the device of clients without another one.
pub(crate) fn default_device() -> Device {
    Device::named("omega3").unwrap_or(UNDECLARED)
}

/// Interval at which a hand without forces enables them again, s.
const ASKS_EVERY_S: f64 = 0.3;

/// Returns the opening of a haptic stream for such a client: `open` with device, tip, deadband and heartbeat.
pub(crate) fn opening(open: pb::TouchOpen, lead: &Lead) -> pb::TouchOpen {
    if let Some(kind) = lead.instrument {
        return led_instrument::opening(open, kind);
    }
    pb::TouchOpen {
        device: Some(touch::device(&lead.device)),
        tip: Some(touch::tip(&Tip::default())),
        deadband: (lead.deadbands.down > 0.0)
            .then(|| pb::Deadband { rendered_fraction: Some(lead.deadbands.down), ..Default::default() }),
        heartbeat_s: Some(HEARTBEAT_S),
        ..open
    }
}

/// What one client leads.
pub(crate) enum HeldTool {
    Tip(Box<LedTip>),
    Instrument(Box<HeldInstrument>),
}

impl HeldTool {
    /// Creates what a client leads on a stream that was opened; arguments and result are those of [`LedTip::new`].
    pub(crate) fn new(opened: &pb::TouchOpened, lead: &Lead, seed: u64, middle_m: DVec3) -> Option<Self> {
        match lead.instrument.zip(lead.hand) {
            Some((kind, hand)) => Some(HeldTool::Instrument(Box::new(HeldInstrument::new(kind, hand, seed, middle_m)))),
            None => LedTip::new(opened, lead, seed, middle_m).map(|tip| HeldTool::Tip(Box::new(tip))),
        }
    }

    /// Adds a further law, if it is valid. An instrument needs none.
    pub(crate) fn learn(&mut self, update: &pb::ForceLawUpdate) {
        if let HeldTool::Tip(tip) = self {
            tip.learn(update);
        }
    }

    /// Receives a sample that arrived at `now_s`.
    pub(crate) fn hear(&mut self, sample: &pb::Sample, now_s: f64) {
        if let HeldTool::Tip(tip) = self {
            tip.hear(sample, now_s);
        }
    }

    /// Does one tick. Returns the pose to send, if one is due.
    pub(crate) fn tick(&mut self, stroke: &Stroke, time_s: f64, now_s: f64) -> Option<Action> {
        match self {
            HeldTool::Tip(tip) => tip.tick(stroke, time_s, now_s),
            HeldTool::Instrument(held) => Some(held.tick(now_s)),
        }
    }
}

/// One client's tool.
pub(crate) struct LedTip {
    up: f64,
    renderer: Renderer,
    news: News,
    holding: Option<Holding>,
}

impl LedTip {
    /// Creates the tool of a stream that was opened, on a tissue with the centre `middle_m`; the seed determines the
    /// movements of a hand. `None` if the server sent no valid law.
    fn new(opened: &pb::TouchOpened, lead: &Lead, seed: u64, middle_m: DVec3) -> Option<Self> {
        let law = touch::from_law(opened.law.as_ref()?).ok()?;
        let renderer = Renderer::new(law, Envelope::new(lead.device, middle_m));
        let holding = lead.hand.map(|hand| Holding::new(hand, seed, middle_m));
        Some(LedTip { up: lead.deadbands.up, renderer, news: News::default(), holding })
    }

    /// Adds a further law, if it is valid.
    fn learn(&mut self, update: &pb::ForceLawUpdate) {
        if let Some(message) = &update.law
            && let Ok(law) = touch::from_law(message)
        {
            self.renderer.learn(message.number, law);
        }
    }

    /// Receives a sample that arrived at `now_s`.
    fn hear(&mut self, sample: &pb::Sample, now_s: f64) {
        if let Some(model) = sample.tools.first().and_then(|tool| tool.local_model.as_ref()) {
            self.renderer.receive(touch::from_local_model(model, sample.step), now_s);
        }
    }

    /// Does one tick of the device: renders a force. Returns the pose to send, if one is due.
    fn tick(&mut self, stroke: &Stroke, time_s: f64, now_s: f64) -> Option<Action> {
        let place_m = match &mut self.holding {
            None => stroke.place_m(time_s)?,
            Some(holding) => {
                if self.renderer.state() != RenderingState::Enabled && now_s - holding.asked_s > ASKS_EVERY_S {
                    self.renderer.envelope.reset();
                    self.renderer.envelope.enable();
                    holding.asked_s = now_s;
                }
                holding.place_m(now_s)
            }
        };
        let force_n = self.renderer.tick(now_s, place_m);
        if let Some(holding) = &mut self.holding {
            holding.force_n = force_n;
        }
        let velocity_m_per_s = if self.up > 0.0 {
            let told = self.news.tell(now_s, place_m, self.renderer.way_m(self.up), HEARTBEAT_S)?;
            vector(told.velocity_m_per_s)
        } else {
            None
        };
        Some(Action::Pose(pb::Pose { velocity_m_per_s, ..touch::pose(place_m, &Tip::default()) }))
    }
}
