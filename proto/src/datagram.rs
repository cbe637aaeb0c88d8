//! Datagrams of touch: limits and conversions that both ends share.
//!
//! **Congestion.** The congestion control of a stream halves its rate when packets are lost, and waiting data is
//! outdated when it is sent. Touch can't wait, and has a limited rate anyway: at most one datagram of [`MAX_BYTES`]
//! per direction and step, some 8 Mbit/s at 1 kHz, and a thirtieth of that if both ends send only news. So its window
//! is constant ([`WINDOW_BYTES`]), and a buffer of a few packets drops the oldest when the network accepts less.

use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use wtransport::quinn::congestion::{Controller, ControllerFactory};
use wtransport::quinn::{IdleTimeout, TransportConfig, VarInt};

use crate::geometry::{from_vector, vector};
use crate::pb;

/// Largest message of a datagram, bytes: it fits into one packet on any path that QUIC can use. Longer ones go by the
/// stream.
pub const MAX_BYTES: usize = 1024;

/// Maximum number of earlier poses of a tool beside its newest in a datagram.
pub const MAX_EARLIER: usize = 8;

/// Largest number of earlier poses of an instrument in a datagram: they are sent whole.
pub const MAX_EARLIER_OF_INSTRUMENT: usize = 3;

/// Bytes that may be in flight: a second of 1 kHz at 250 bytes.
const WINDOW_BYTES: u64 = 256 << 10;

/// Bytes of datagrams that may wait to be sent, and to be read.
const WAITING_BYTES: usize = 4 * MAX_BYTES;

/// Time without any data after which a session has ended. The client then asks the server for another: sooner than
/// QUIC, whose pauses double, would notice that the network is back.
const IDLE: Duration = Duration::from_secs(10);

/// Returns the QUIC settings of a session of datagrams, for both ends: a constant congestion window of 256 KiB, room
/// for 4 datagrams of [`MAX_BYTES`] in each direction, and an end after 10 s without any data.
pub fn transport() -> TransportConfig {
    let mut transport = TransportConfig::default();
    transport
        .congestion_controller_factory(Arc::new(Constant))
        .datagram_send_buffer_size(WAITING_BYTES)
        .datagram_receive_buffer_size(Some(WAITING_BYTES))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE.as_millis() as u32))))
        // The streams of HTTP/3, and one for messages that must not be lost.
        .max_concurrent_bidi_streams(VarInt::from_u32(4))
        .max_concurrent_uni_streams(VarInt::from_u32(8))
        .stream_receive_window(VarInt::from_u32(32 << 10))
        .receive_window(VarInt::from_u32(64 << 10))
        .send_window(64 << 10);
    transport
}

/// A congestion controller with a constant window.
#[derive(Debug, Clone)]
struct Constant;

impl ControllerFactory for Constant {
    fn build(self: Arc<Self>, _now: Instant, _mtu: u16) -> Box<dyn Controller> {
        Box::new(Constant)
    }
}

impl Controller for Constant {
    fn on_congestion_event(&mut self, _now: Instant, _sent: Instant, _persistent: bool, _lost_bytes: u64) {}

    fn on_mtu_update(&mut self, _mtu: u16) {}

    fn window(&self) -> u64 {
        WINDOW_BYTES
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(Constant)
    }

    fn initial_window(&self) -> u64 {
        WINDOW_BYTES
    }

    fn into_any(self: Box<Self>) -> Box<dyn std::any::Any> {
        self
    }
}

/// One pose of a tool for a datagram, with the numbers of its command.
#[derive(Debug, Clone, PartialEq)]
pub struct Posed {
    /// Sequence number of its command; it increases from pose to pose of a tool.
    pub sequence: u64,
    /// Time of the client's clock at the pose, ns.
    pub client_time_ns: u64,
    /// The pose; the velocity of an earlier one is not sent.
    pub pose: pb::Pose,
}

/// Returns the message with the newest pose of `tool` and the `earlier` ones, given newest first, at most
/// [`MAX_EARLIER`]. Leaves out earlier poses with another tip or orientation, 10 m or more away along an axis, or
/// with a larger sequence number or time, which only matters during a gap of some milliseconds. Rounds earlier
/// positions to nanometres.
pub fn tool_poses<'a>(tool: u32, newest: &Posed, earlier: impl Iterator<Item = &'a Posed>) -> pb::ToolPoses {
    let place_m = from_vector(newest.pose.position_m.as_ref());
    let difference = |before: &Posed| {
        let [x_nm, y_nm, z_nm] = ((place_m - from_vector(before.pose.position_m.as_ref())) * 1e9).round().to_array();
        let same = before.pose.tip == newest.pose.tip && before.pose.orientation == newest.pose.orientation;
        let is_near = [x_nm, y_nm, z_nm].iter().all(|nm| nm.abs() < 1e10);
        Some(pb::EarlierPose {
            sequences: u32::try_from(newest.sequence.checked_sub(before.sequence)?).ok()?,
            client_time_ns: newest.client_time_ns.checked_sub(before.client_time_ns)?,
            x_nm: x_nm as i64,
            y_nm: y_nm as i64,
            z_nm: z_nm as i64,
        })
        .filter(|_| same && is_near)
    };
    pb::ToolPoses {
        tool,
        sequence: newest.sequence,
        client_time_ns: newest.client_time_ns,
        pose: Some(newest.pose),
        earlier: earlier.filter_map(difference).take(MAX_EARLIER).collect(),
    }
}

/// Returns the commands to instruments in a datagram, oldest first. Leaves out those without a pose.
pub fn instrument_commands(message: &pb::PosesDatagram) -> impl Iterator<Item = pb::Command> {
    message.instruments.iter().filter_map(|posed| {
        Some(pb::Command {
            tool: posed.tool,
            sequence: Some(posed.sequence),
            client_time_ns: posed.client_time_ns,
            action: Some(pb::command::Action::Instrument(posed.pose?)),
            ..Default::default()
        })
    })
}

/// Returns the commands in a message, oldest first: the earlier poses, at most [`MAX_EARLIER`] and without velocity,
/// then the newest. Leaves out earlier poses whose number or time would be below 0; empty without a newest pose.
pub fn commands(message: &pb::ToolPoses) -> impl Iterator<Item = pb::Command> {
    let pb::ToolPoses { tool, sequence, client_time_ns, pose, earlier } = message;
    let command = |sequence: u64, client_time_ns: u64, pose: pb::Pose| pb::Command {
        tool: *tool,
        sequence: Some(sequence),
        client_time_ns,
        action: Some(pb::command::Action::Pose(pose)),
        ..Default::default()
    };
    let place_m = pose.as_ref().map_or(DVec3::ZERO, |pose| from_vector(pose.position_m.as_ref()));
    let before = move |before: &pb::EarlierPose| {
        let away_m = 1e-9 * DVec3::new(before.x_nm as f64, before.y_nm as f64, before.z_nm as f64);
        let pose = pb::Pose { position_m: vector(place_m - away_m), velocity_m_per_s: None, ..(*pose)? };
        let sequence = sequence.checked_sub(before.sequences.into())?;
        Some(command(sequence, client_time_ns.checked_sub(before.client_time_ns)?, pose))
    };
    let newest = pose.map(|pose| command(*sequence, *client_time_ns, pose));
    earlier.iter().take(MAX_EARLIER).rev().filter_map(before).chain(newest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::touch;
    use palpate_haptics::Tip;

    fn posed(sequence: u64, place_m: DVec3, tip: &Tip) -> Posed {
        Posed { sequence, client_time_ns: 5 + 1_000_000 * sequence, pose: touch::pose(place_m, tip) }
    }

    #[test]
    fn nine_poses_of_a_tool_fit_in_a_datagram_and_come_back_oldest_first() {
        let tip = Tip::default();
        let all: Vec<Posed> = (100..120_u32)
            .map(|k| posed(k.into(), DVec3::new(0.1 + 1e-5 * f64::from(k), -0.2, 0.003 * f64::from(k).sin()), &tip))
            .collect();
        let message = tool_poses(3, &all[19], all[..19].iter().rev());
        assert_eq!(message.earlier.len(), MAX_EARLIER);
        let datagram = pb::PosesDatagram {
            number: 1 << 40,
            acknowledges: 1 << 40,
            heartbeat_s: 0.04,
            sent_ns: 1 << 60,
            tools: vec![message.clone()],
            instruments: Vec::new(),
        };
        assert!(prost::Message::encoded_len(&datagram) < 400, "{}", prost::Message::encoded_len(&datagram));
        let commands: Vec<pb::Command> = commands(&message).collect();
        for (command, posed) in commands.iter().zip(&all[11..]) {
            assert_eq!((command.sequence, command.client_time_ns), (Some(posed.sequence), posed.client_time_ns));
            let Some(pb::command::Action::Pose(pose)) = &command.action else { panic!() };
            let away_m = from_vector(pose.position_m.as_ref()) - from_vector(posed.pose.position_m.as_ref());
            assert!(away_m.length() < 1e-9 && pose.tip == posed.pose.tip);
        }
        assert_eq!(commands.len(), 9);
    }

    #[test]
    fn what_has_no_place_in_the_message_is_left_out_and_nonsense_gives_no_command() {
        let [tip, other] = [0.005, 0.006].map(|radius_m| Tip { radius_m, ..Tip::default() });
        let newest = posed(7, DVec3::ZERO, &tip);
        let earlier = [posed(6, DVec3::X * 100.0, &tip), posed(5, DVec3::NAN, &tip), posed(4, DVec3::ZERO, &other)];
        assert!(tool_poses(0, &newest, earlier.iter().chain([&posed(8, DVec3::ZERO, &tip)])).earlier.is_empty());
        let before = pb::EarlierPose { sequences: 9, ..Default::default() };
        let message = pb::ToolPoses { earlier: vec![before], ..tool_poses(0, &newest, [].iter()) };
        assert_eq!(commands(&message).count(), 1);
        assert_eq!(commands(&pb::ToolPoses { pose: None, ..message }).count(), 0);
    }
}
