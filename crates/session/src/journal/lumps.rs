//! Lumps of an exercise in a journal.

use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::journal as pb;
use palpate_tissue::scene::exercise::Lump;

/// Returns lumps as messages.
pub(super) fn lumps(lumps: &[Lump]) -> Vec<pb::Lump> {
    let lump = |lump: &Lump| pb::Lump {
        centre_m: vector(lump.centre_m),
        radius_m: lump.radius_m,
        stiffness_factor: lump.stiffness_factor,
    };
    lumps.iter().map(lump).collect()
}

/// Returns the lumps in messages.
pub(super) fn from_lumps(messages: &[pb::Lump]) -> Vec<Lump> {
    let lump = |message: &pb::Lump| Lump {
        centre_m: from_vector(message.centre_m.as_ref()),
        radius_m: message.radius_m,
        stiffness_factor: message.stiffness_factor,
    };
    messages.iter().map(lump).collect()
}
