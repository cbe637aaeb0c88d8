//! The limits of the configuration, in one place: what one scene, session or stream may ask for. Each queue
//! of the server has its bound here.

use serde::Deserialize;

/// Upper bounds. Every one can be set in the section `[limits]` of the configuration file.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Mass points of a sheet.
    pub points: usize,
    /// Substeps of a step.
    pub substeps: u32,
    /// Force of a tool on any one point, N: |force|·e^{c′}.
    pub point_force_n: f64,
    /// How far a grasped point may be brought from its rest position, as a multiple of the sheet's longer side.
    pub reach_in_sheets: f64,
    /// Bytes of a scene or script file.
    pub file_bytes: u64,
    /// Bytes of a trace file.
    pub trace_bytes: u64,
    /// Bytes of a file with a mesh.
    pub mesh_bytes: u64,
    /// Vertices of a mesh that a client sends.
    pub mesh_vertices: usize,
    /// Meshes that a caller has sent, and that have not expired.
    pub meshes_per_caller: usize,
    /// A mesh that a client has sent is forgotten so long after its last part, s.
    pub mesh_s: f64,
    /// Bytes of a journal that a client sends.
    pub journal_bytes: u64,
    /// Journals that a caller has sent, and that have not expired.
    pub journals_per_caller: usize,
    /// A journal that a client has sent is forgotten so long after it was last used, s.
    pub journal_s: f64,
    /// Tools of a session: their numbers are below this.
    pub tools: u32,
    /// Commands that wait for their step, per tool.
    pub queued_commands_per_tool: usize,
    /// Samples that wait for a reader before the oldest is dropped.
    pub queued_samples: usize,
    /// Probe records that wait for a reader before the oldest is dropped.
    pub queued_records: usize,
    /// Bytes that wait for one reader, of records or of frames; at least one record or frame may.
    pub queued_bytes: usize,
    /// Bytes that the server may take in all for what its callers ask for; half of what the machine or its control group
    /// has, if 0.
    pub memory_bytes: u64,
    /// Other tissues of a session that wait for their step.
    pub queued_changes: usize,
    /// Sessions of a server.
    pub sessions: usize,
    /// Mass points of all sessions of a server.
    pub points_in_all: usize,
    /// Points times substeps of a session: what one step may cost its thread.
    pub point_substeps_per_step: u64,
    /// Triangles that a step of a session may look up under all tips: a tip of 5 mm on a mesh whose edges are 2 mm long looks up
    /// about 1000 in each substep.
    pub contact_work: u64,
    /// How long a step of a session may take, predicted with all points awake, in periods of its rate.
    pub periods_per_step: f64,
    /// Points times substeps that may be computed to find out which scheme and how many substeps keep a scene's tolerance;
    /// offline 32 times as many. With the rest, some tenths of a second.
    pub rehearsal_work: u64,
    /// Streams that read one session.
    pub streams_per_session: usize,
    /// Of those, kept for streams that hold a tool.
    pub streams_for_holders: usize,
    /// Streams of a server.
    pub streams: usize,
    /// Tools that are held, of all sessions of a server.
    pub leases: usize,
    /// Step rate of a session, Hz.
    pub session_rate_hz: f64,
    /// Vertices of a refined frame.
    pub frame_vertices: usize,
    /// Pixels along a side of a texture.
    pub texture_side: u32,
    /// Points of a probe that is not of all points.
    pub probe_points: usize,
    /// Longest lease of a tool, s.
    pub lease_s: f64,
    /// Longest lease of a tool that was taken by a call over HTTP/1.1 or gRPC-web, unless it is to outlive its connection,
    /// s: the end of such a connection says nothing of who holds the tool.
    pub browser_lease_s: f64,
    /// Share of a stepping thread's time that sessions may take before no further one is let in, 0 to 1.
    pub thread_share: f64,
    /// Connections; what comes above that is closed at once. Fewer, if the process may not open as many files.
    pub connections: usize,
    /// Connections from one address, of IPv6 from one network of 64 bits; what comes above that is closed at once.
    pub connections_per_address: usize,
    /// Streams and calls at once on a connection.
    pub streams_per_connection: u32,
    /// Bytes of a message from a client.
    pub message_bytes: usize,
    /// Bytes of a connection that wait to be read, in all its streams, before the transport holds the client back: what a
    /// connection can take of the server's memory.
    pub connection_window_bytes: u32,
    /// A connection that has not said what it wants to speak after so long is closed, the handshake of TLS included, s.
    pub handshake_s: f64,
    /// A haptic stream without its first message after so long is ended, and so is a call whose message has not come in
    /// full, s.
    pub open_s: f64,
    /// A connection is asked whether it lives when it was silent so long, and closed if it does not answer for as long, s.
    pub keepalive_s: f64,
    /// Commands of a haptic stream, per tool and step of the session: what comes faster for long is refused.
    pub commands_per_step: f64,
    /// Springs times iterations that an exact force law may take; where they don't suffice, the coarse one stays.
    pub law_work: u64,
    /// Operations, of some nanoseconds each, that a piece of heavy work may take on a mesh.
    pub mesh_work: u64,
    /// Pieces of heavy work (a session laid out, another tissue, a force law) of one caller that wait.
    pub queued_work: usize,
    /// Such a piece has to be done within so long after it was asked for, s.
    pub work_s: f64,
    /// Sessions made over one connection, per minute, and at once.
    pub sessions_per_minute: f64,
    /// Calls made over one connection, of any kind, per second, and at once.
    pub calls_per_s: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            points: 1 << 22,
            substeps: 100_000,
            point_force_n: 1e4,
            reach_in_sheets: 10.0,
            file_bytes: 16 << 20,
            trace_bytes: 64 << 20,
            mesh_bytes: 64 << 20,
            mesh_vertices: 500_000,
            meshes_per_caller: 8,
            mesh_s: 600.0,
            journal_bytes: 128 << 20,
            journals_per_caller: 2,
            journal_s: 600.0,
            tools: 64,
            queued_commands_per_tool: 4096,
            queued_samples: 64,
            queued_records: 64,
            queued_bytes: 64 << 20,
            memory_bytes: 0,
            queued_changes: 16,
            sessions: 1024,
            points_in_all: 1 << 24,
            point_substeps_per_step: 1 << 26,
            contact_work: 1 << 17,
            periods_per_step: 1.0,
            rehearsal_work: 1 << 27,
            streams_per_session: 256,
            streams_for_holders: 32,
            streams: 16_384,
            leases: 16_384,
            session_rate_hz: 20_000.0,
            frame_vertices: 1 << 22,
            texture_side: 4096,
            probe_points: 1 << 16,
            lease_s: 600.0,
            browser_lease_s: 10.0,
            thread_share: 0.85,
            connections: 4096,
            connections_per_address: 2048,
            streams_per_connection: 256,
            message_bytes: 1 << 20,
            connection_window_bytes: 1 << 20,
            handshake_s: 10.0,
            open_s: 10.0,
            keepalive_s: 10.0,
            commands_per_step: 4.0,
            law_work: 1 << 27,
            mesh_work: 1 << 32,
            queued_work: 256,
            work_s: 30.0,
            sessions_per_minute: 600.0,
            calls_per_s: 2000.0,
        }
    }
}

/// Factor by which compiling a scene may take more work for one user alone than on a server: reference solutions need a
/// tolerance of 1e-10.
const OFFLINE_WORK: u64 = 32;

impl Limits {
    /// Returns the limits for a process in which no other caller waits.
    #[must_use]
    pub fn offline(self) -> Self {
        Limits { rehearsal_work: self.rehearsal_work.saturating_mul(OFFLINE_WORK), ..self }
    }
}
