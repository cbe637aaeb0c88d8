//! The limits of the configuration: what one scene, session or stream may ask for. The bound of each queue of
//! the server is here.

use serde::Deserialize;

/// Upper bounds, each set by its name in the section `[limits]` of the configuration file. Whatever exceeds one
/// is refused, unless its text says otherwise.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Mass points of a tissue.
    pub points: usize,
    /// Substeps per step.
    pub substeps: u32,
    /// Force of a tool on any one point, |force|·e^{c′}, N.
    pub point_force_n: f64,
    /// How far a grasped point may be moved from its rest position, as a multiple of the tissue's longest side.
    pub reach_in_sheets: f64,
    /// Bytes of a scene or script file.
    pub file_bytes: u64,
    /// Bytes of a trace file.
    pub trace_bytes: u64,
    /// Bytes of a mesh file.
    pub mesh_bytes: u64,
    /// Vertices of a mesh that a client sends.
    pub mesh_vertices: usize,
    /// Meshes that one caller has sent and that have not expired.
    pub meshes_per_caller: usize,
    /// Time after the last part of a mesh that a client sent until the server forgets it, s.
    pub mesh_s: f64,
    /// Bytes of a journal that a client sends.
    pub journal_bytes: u64,
    /// Journals that one caller has sent and that have not expired.
    pub journals_per_caller: usize,
    /// Time after the last use of a journal that a client sent until the server forgets it, s.
    pub journal_s: f64,
    /// Tools of a session. Their numbers are below this.
    pub tools: u32,
    /// Commands per tool that wait for their step.
    pub queued_commands_per_tool: usize,
    /// Samples that wait for one reader. Beyond it, the oldest is dropped.
    pub queued_samples: usize,
    /// Probe records that wait for one reader. Beyond it, the oldest is dropped.
    pub queued_records: usize,
    /// Bytes of records or frames that wait for one reader. One record or frame may wait whatever its size.
    pub queued_bytes: usize,
    /// Bytes that the server may use in all for its callers. 0 means half of the memory of the machine or of
    /// its control group.
    pub memory_bytes: u64,
    /// Changes of tissue of a session that wait for their step.
    pub queued_changes: usize,
    /// Sessions of a server.
    pub sessions: usize,
    /// Mass points of all sessions of a server.
    pub points_in_all: usize,
    /// Points times substeps of a session: the work of one step.
    pub point_substeps_per_step: u64,
    /// Triangles that one step of a session may search under all tips. A tip of 5 mm on a mesh with edges of 2
    /// mm searches about 1000 in each substep.
    pub contact_work: u64,
    /// Predicted time of a session's step with all points awake, in periods of its rate.
    pub periods_per_step: f64,
    /// Points times substeps of the rehearsals that choose the scheme and the number of substeps for a scene's
    /// tolerance. Offline, 32 times as many. With the default, they take some tenths of a second.
    pub rehearsal_work: u64,
    /// Streams that read one session.
    pub streams_per_session: usize,
    /// How many of these streams are reserved for streams that hold a tool.
    pub streams_for_holders: usize,
    /// Streams of a server.
    pub streams: usize,
    /// Held tools of all sessions of a server.
    pub leases: usize,
    /// Step rate of a session, Hz.
    pub session_rate_hz: f64,
    /// Vertices of a refined frame.
    pub frame_vertices: usize,
    /// Pixels along a side of a texture.
    pub texture_side: u32,
    /// Points of a probe, unless it is of all points.
    pub probe_points: usize,
    /// Longest lease of a tool, s.
    pub lease_s: f64,
    /// Longest lease of a tool that was taken by a call over HTTP/1.1 or gRPC-web, s, unless the lease is to
    /// outlive its connection. The end of such a connection says nothing about the holder of the tool.
    pub browser_lease_s: f64,
    /// Share of a stepping thread's time that sessions may use, 0 to 1. Beyond it, the thread accepts no
    /// further session.
    pub thread_share: f64,
    /// Open connections. Further ones are closed at once. The bound is lower if the process may not open as
    /// many files.
    pub connections: usize,
    /// Open connections from one IPv4 address or one IPv6 network of 64 bits. Further ones are closed at once.
    pub connections_per_address: usize,
    /// Streams and calls at the same time on one connection.
    pub streams_per_connection: u32,
    /// Bytes of a message from a client.
    pub message_bytes: usize,
    /// Unread bytes of all streams of one connection. Beyond it, the transport holds the client back. This
    /// bounds the memory that a connection takes.
    pub connection_window_bytes: u32,
    /// Time within which a new connection must choose its protocol, the TLS handshake included, s. Then it is closed.
    pub handshake_s: f64,
    /// Time within which a haptic stream must send its first message, and a call its complete message, s. Then
    /// it is ended.
    pub open_s: f64,
    /// Time of silence after which a connection is tested, and time for its answer, s. Without an answer it is
    /// closed.
    pub keepalive_s: f64,
    /// Commands of a haptic stream per tool and step of the session. Commands that stay faster are refused.
    pub commands_per_step: f64,
    /// Springs times iterations of an exact force law. If they do not suffice, the coarse law stays.
    pub law_work: u64,
    /// Operations, of some nanoseconds each, of one piece of heavy work on a mesh.
    pub mesh_work: u64,
    /// Pieces of heavy work (creating a session, changing a tissue, computing a force law) of one caller that
    /// wait.
    pub queued_work: usize,
    /// Time from the request of such a piece of work until it must be done, s.
    pub work_s: f64,
    /// Sessions created over one connection per minute; as many may be created at once.
    pub sessions_per_minute: f64,
    /// Calls of any kind over one connection per second; as many may come at once.
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

/// Factor of the work for compiling a scene offline, relative to a server: reference solutions need a tolerance
/// of 1e-10.
const OFFLINE_WORK: u64 = 32;

impl Limits {
    /// Returns the limits for a process that serves a single user: 32 times the `rehearsal_work`.
    #[must_use]
    pub fn offline(self) -> Self {
        Limits { rehearsal_work: self.rehearsal_work.saturating_mul(OFFLINE_WORK), ..self }
    }
}
