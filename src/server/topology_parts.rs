//! Splits what blades have severed into messages.

use palpate_haptics::ReportedSpring;
use palpate_proto::geometry::vector;
use palpate_proto::pb;
use palpate_realtime::SessionHandle;
use palpate_tissue::{Model, SeveredJoint};

/// Number of springs in a message: about 100 KiB.
const SPRINGS_PER_MESSAGE: usize = 2048;

/// What blades have severed in a session since a version of its topology.
pub(super) struct TopologyParts {
    version: u32,
    continues: bool,
    pieces: u32,
    springs: std::vec::IntoIter<pb::SeveredSpring>,
}

impl TopologyParts {
    /// Reads what is severed now, less what a client knows that has version `since_version`. `by_name`: for a copy of the tissue.
    pub(super) fn new(handle: &SessionHandle, since_version: u32, by_name: bool) -> Self {
        let status = handle.status();
        let (cuts, model) = (&status.cuts, &status.model);
        let continues = cuts.continues(since_version);
        let is_new = |version: u32| !continues || version > since_version;
        let shows_points = handle.skin.as_ref().is_none_or(|skin| !skin.is_bound());
        let springs: Vec<_> = if by_name {
            cuts.reported(0).filter(|(_, version)| is_new(*version)).map(named).collect()
        } else {
            let joints = cuts.joints(model);
            joints
                .iter()
                .filter(|joint| is_new(joint.version))
                .map(|joint| spring(model, joint, shows_points))
                .collect()
        };
        TopologyParts {
            version: cuts.version(),
            continues,
            pieces: if cuts.is_empty() { 1 } else { u32::try_from(cuts.pieces(model)).unwrap_or(u32::MAX) },
            springs: springs.into_iter(),
        }
    }

    /// Returns the next message, and whether it is the last, which has `last` set.
    pub(super) fn next(&mut self) -> (pb::GetTopologyResponse, bool) {
        let severed = self.springs.by_ref().take(SPRINGS_PER_MESSAGE).collect();
        let last = self.springs.len() == 0;
        let TopologyParts { version, continues, pieces, .. } = *self;
        (pb::GetTopologyResponse { version, continues, severed, pieces, last }, last)
    }
}

#[allow(clippy::cast_possible_truncation)]
fn spring(model: &Model, joint: &SeveredJoint, shows_points: bool) -> pb::SeveredSpring {
    let [first_m, second_m] = joint.points.map(|point| model.shape().rest_m(point));
    let shown = |index: usize| match model.shown_order() {
        Some([_, places]) => places[index],
        None => index as u32,
    };
    let vertex = |end: usize| shows_points.then(|| shown(joint.points[end].index()));
    pb::SeveredSpring {
        first_vertex: vertex(0),
        second_vertex: vertex(1),
        part: joint.part as f32,
        rest_m: vector(first_m.lerp(second_m, joint.part)),
        version: joint.version,
        name: None,
    }
}

#[allow(clippy::cast_possible_truncation)]
fn named((spring, version): (ReportedSpring, u32)) -> pb::SeveredSpring {
    let ReportedSpring { place, number, part } = spring;
    pb::SeveredSpring { part: part as f32, version, name: Some(pb::SpringName { place, number }), ..Default::default() }
}
