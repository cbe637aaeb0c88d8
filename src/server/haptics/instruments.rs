//! The instruments of a haptic stream.

use std::sync::{Arc, Mutex};

use palpate_haptics::PortLoad;
use palpate_proto::{instrument, pb};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::led_instrument::{InstrumentSample, LedInstrument};
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::shape::RestShape;

/// The instruments of a stream, which its commands move and its samples tell of.
pub(super) type Instruments = Arc<Mutex<Vec<LedInstrument>>>;

/// Reads the instruments that a stream declares.
///
/// # Errors
/// Refuses an instrument that is not valid ([`instrument::from_instrument`]), a tip that does not suit the tissue, a tip whose tool
/// the stream does not ask for, and a tool that two instruments have.
pub(super) fn instruments(open: &pb::TouchOpen, shape: &dyn RestShape) -> Result<Vec<LedInstrument>> {
    let mut read: Vec<LedInstrument> = Vec::new();
    for (index, message) in open.instruments.iter().enumerate() {
        let field = format!("instruments[{index}]");
        let instrument = instrument::from_instrument(&field, message)?;
        for (number, tip) in instrument.tips.iter().enumerate() {
            check_tip(&format!("{field}.tips[{number}].tip"), shape, &tip.tip)?;
        }
        let wrong = |message: String| Err(Refusal::new(Reason::OutOfRange, format!("{field}.first_tool"), message));
        let tips = u32::try_from(instrument.tips.len()).unwrap_or(u32::MAX);
        let Some(end) = message.first_tool.checked_add(tips) else {
            return wrong("is too large".to_owned());
        };
        for tool in message.first_tool..end {
            if !open.tools.contains(&tool) {
                return wrong(format!("makes a tip of tool {tool}, which is not among the tools of the stream"));
            }
            if read.iter().any(|other| other.has(tool)) {
                return wrong(format!("makes a tip of tool {tool}, which another instrument has"));
            }
        }
        read.push(LedInstrument::new(instrument, message.first_tool));
    }
    Ok(read)
}

/// Converts what an instrument felt to a message.
pub(super) fn message(sample: &InstrumentSample) -> pb::InstrumentSample {
    use palpate_proto::geometry::vector;
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
    }
}
