//! Reads the instruments that a haptic stream declares.

use palpate_proto::{instrument, pb};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::led_instrument::LedInstrument;
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::shape::RestShape;

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
