//! The instruments of the haptic streams of each session: what they felt, and where they are for the others.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, Weak};

use palpate_haptics::instrument_contact::MAX_OTHER_INSTRUMENTS;
use palpate_haptics::{ContactLoad, OtherInstrument, PortLoad};
use palpate_proto::instrument::other_instrument;
use palpate_proto::{instrument, pb};
use palpate_session::Sample;
use palpate_session::led_instrument::{InstrumentSample, LedInstrument};
use palpate_tissue::lock::lock;

/// The instruments of a stream, which its commands move and its samples tell of.
pub(super) type Instruments = Arc<Mutex<Vec<LedInstrument>>>;

/// Converts what an instrument felt to a message.
fn instrument_sample(sample: &InstrumentSample) -> pb::InstrumentSample {
    use palpate_proto::geometry::vector;
    let contact = |(other_tool, load): &(u32, ContactLoad)| pb::InstrumentContact {
        other_tool: *other_tool,
        depth_m: load.depth_m,
        force_n: vector(load.wrench.force_n),
        torque_n_m: vector(load.wrench.torque_n_m),
    };
    pb::InstrumentSample {
        first_tool: sample.first_tool,
        about_m: vector(sample.pose.place_m),
        force_on_tool_n: vector(sample.wrench.force_n),
        torque_on_tool_n_m: vector(sample.wrench.torque_n_m),
        opening_n_m: sample.opening_n_m,
        orientation: instrument::orientation(sample.pose.orientation),
        jaw_rad: sample.pose.jaw_rad,
        client_time_ns: (sample.client_time_s * 1e9).round().max(0.0) as u64,
        port_load: sample.port_load.map(|PortLoad { force_of_port_n, on_hand }| pb::PortLoad {
            force_of_port_n: vector(force_of_port_n),
            force_on_hand_n: vector(on_hand.force_n),
            torque_on_hand_n_m: vector(on_hand.torque_n_m),
        }),
        contacts: sample.contacts.iter().map(contact).collect(),
    }
}

/// Returns the message that the jaws of an instrument exceed their limit since a step, if they do.
fn jaw_overload(sample: &InstrumentSample, step: u64) -> Option<pb::JawOverload> {
    let (limit_n_m, torque_n_m) = (sample.exceeded_n_m?, sample.opening_n_m?);
    Some(pb::JawOverload { first_tool: sample.first_tool, step, torque_n_m, limit_n_m })
}

/// The instruments of the streams of a session.
type StreamsOfSession = Arc<Mutex<Vec<Weak<Mutex<Vec<LedInstrument>>>>>>;

/// The instruments of all sessions of a server, so that each knows what the others of its session are. A stream that ends leaves it.
#[derive(Debug, Clone, Default)]
pub(super) struct SessionInstruments(Arc<Mutex<HashMap<String, StreamsOfSession>>>);

impl SessionInstruments {
    /// Adds the instruments of a stream of a session. `tells_of_others`: its samples contain the instruments of the others.
    pub(super) fn join(&self, session: &str, own: Instruments, tells_of_others: bool) -> JoinedInstruments {
        let has_any = !lock(&own).is_empty();
        if !has_any && !tells_of_others {
            return JoinedInstruments { streams: StreamsOfSession::default(), own, tells_of_others };
        }
        let mut all = lock(&self.0);
        all.retain(|_, streams| {
            let mut streams = lock(streams);
            streams.retain(|stream| stream.strong_count() > 0);
            !streams.is_empty()
        });
        let streams = all.entry(session.to_owned()).or_default().clone();
        if has_any {
            lock(&streams).push(Arc::downgrade(&own));
        }
        JoinedInstruments { streams, own, tells_of_others }
    }
}

/// The instruments of a stream, and those of the other streams of its session.
pub(super) struct JoinedInstruments {
    streams: StreamsOfSession,
    own: Instruments,
    tells_of_others: bool,
}

impl JoinedInstruments {
    /// Adds to a message what the instruments of the stream felt at a sample, and where the others are then, if it is to tell. Returns
    /// the instruments whose jaws exceed their limit since this sample.
    pub(super) fn add_to(&self, message: &mut pb::Sample, sample: &Sample) -> Vec<pb::JawOverload> {
        if !self.tells_of_others && lock(&self.own).is_empty() {
            return Vec::new();
        }
        let streams: Vec<Instruments> = lock(&self.streams).iter().filter_map(Weak::upgrade).collect();
        let now_s = sample.simulation_time_s;
        // One lock at a time: two streams may look at each other.
        let seen = |stream: &Instruments| {
            lock(stream).iter().filter_map(|instrument| instrument.seen(now_s)).collect::<Vec<_>>()
        };
        let others = streams.iter().filter(|stream| !Arc::ptr_eq(stream, &self.own)).flat_map(seen);
        // They were seen at samples of their own streams.
        let mut all: Vec<OtherInstrument> = others.map(|other| other.go_on(now_s)).collect();
        all.sort_by_key(|other| other.first_tool);
        if self.tells_of_others {
            message.other_instruments = all.iter().take(MAX_OTHER_INSTRUMENTS).map(other_instrument).collect();
        }
        let mut own = lock(&self.own);
        own.iter_mut().for_each(|instrument| instrument.see(sample));
        all.extend(own.iter().filter_map(|instrument| instrument.seen(now_s)));
        let felt = own.iter_mut().filter_map(|instrument| instrument.sample(sample, all.iter().copied()));
        let felt: Vec<InstrumentSample> = felt.collect();
        message.instruments = felt.iter().map(instrument_sample).collect();
        felt.iter().filter_map(|felt| jaw_overload(felt, sample.step)).collect()
    }
}
