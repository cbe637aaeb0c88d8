//! The limits of the configuration: what one scene, session or stream may ask for. The bound of each queue of
//! the server is here.

use serde::Deserialize;

/// Upper bounds, each set by its name in the section `[limits]` of the configuration file; a limit that the file
/// leaves out has its default. Whatever exceeds one is refused, unless its text says otherwise. No value is checked
/// here. 2^20 bytes are 1 MiB.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Mass points of a tissue. On a sheet, rows of fewer than 16 points count as rows of 16. Default: 2^22.
    pub points: usize,
    /// Substeps per step, given or chosen. Default: 100,000.
    pub substeps: u32,
    /// Force of a tool on any one point, |force|·e^{c′}, N, with c′ the offset of its falloff. Default: 10,000.
    pub point_force_n: f64,
    /// How far a grasped point may be moved from its rest position, and a tool's tip from the middle of the
    /// tissue, as a multiple of the tissue's longest side. Default: 10.
    pub reach_in_sides: f64,
    /// Bytes of a scene or script file, or of an image for the surface. Default: 16 MiB.
    pub file_bytes: u64,
    /// Bytes of a trace file. Default: 64 MiB.
    pub trace_bytes: u64,
    /// Bytes of a mesh file, and of each file that it names. Default: 64 MiB.
    pub mesh_bytes: u64,
    /// Vertices of a mesh that a client sends. Default: 500,000.
    pub mesh_vertices: usize,
    /// Meshes that one caller has sent and that have not expired. Default: 8.
    pub meshes_per_caller: usize,
    /// Time after the last part of a mesh that a client sent until the server forgets it, s. Default: 600.
    pub mesh_s: f64,
    /// Bytes of a journal that a client sends. Default: 128 MiB.
    pub journal_bytes: u64,
    /// Journals that one caller has sent and that have not expired. Default: 2.
    pub journals_per_caller: usize,
    /// Time after the last use of a journal that a client sent until the server forgets it, s. Default: 600.
    pub journal_s: f64,
    /// Tools of a session, and of a script. Their numbers are below this. Default: 64.
    pub tools: u32,
    /// Threads and clips of a session, and of a script. Their numbers are below this. Default: 64.
    pub ties: u32,
    /// Commands per tool that wait for their step. Default: 4096.
    pub queued_commands_per_tool: usize,
    /// Samples that wait for one reader. Beyond it, the oldest is dropped. Default: 64.
    pub queued_samples: usize,
    /// Probe records that wait for one reader. Beyond it, the oldest is dropped. Default: 64.
    pub queued_records: usize,
    /// Bytes of records or frames that wait for one reader. One record or frame may wait whatever its size.
    /// Default: 64 MiB.
    pub queued_bytes: usize,
    /// Bytes that the server may use in all for its callers. 0 means half of the memory of the machine or of
    /// its control group. Default: 0.
    pub memory_bytes: u64,
    /// Changes of tissue of a session that wait for their step. Default: 16.
    pub queued_changes: usize,
    /// Sessions of a server. Default: 1024.
    pub sessions: usize,
    /// Mass points of all sessions of a server. Default: 2^24.
    pub points_in_all: usize,
    /// Points times substeps of a session: the work of one step. Default: 2^26.
    pub point_substeps_per_step: u64,
    /// Triangles that one step of a session may search under all tips. A tip of 5 mm on a mesh with edges of 2
    /// mm searches about 1000 in each substep. Default: 2^17.
    pub contact_work: u64,
    /// Predicted time of a session's step with all points awake, in periods of its rate: 1 is real time.
    /// Default: 1.
    pub periods_per_step: f64,
    /// Points times substeps of the rehearsals that choose the scheme and the number of substeps for a scene's
    /// tolerance. Offline ([`Limits::offline`]), 32 times as many. With the default, they take some tenths of a
    /// second. Default: 2^27.
    pub rehearsal_work: u64,
    /// Points times substeps of the presses of measured curves that one call compares with a tissue. With the default,
    /// they take some ten seconds. Default: 2^30.
    pub press_work: u64,
    /// Streams that read one session. Default: 256.
    pub streams_per_session: usize,
    /// How many of these streams are reserved for streams that hold a tool; at most an eighth of
    /// `streams_per_session`, also if this is larger. Default: 32.
    pub streams_for_holders: usize,
    /// Streams of a server. Default: 16,384.
    pub streams: usize,
    /// Held tools of all sessions of a server. Default: 16,384.
    pub leases: usize,
    /// Step rate of a session, steps per second. Default: 20,000.
    pub session_rate_hz: f64,
    /// Vertices of a refined frame. Default: 2^22.
    pub frame_vertices: usize,
    /// Pixels along a side of a texture, painted or from a file. Default: 4096.
    pub texture_side: u32,
    /// Points of a probe, unless it is of all points. Default: 2^16.
    pub probe_points: usize,
    /// Longest lease of a tool, s. Default: 600.
    pub lease_s: f64,
    /// Longest lease of a tool that was taken by a call over HTTP/1.1 or gRPC-web, s, unless the lease is to
    /// outlive its connection. The end of such a connection says nothing about the holder of the tool. Default:
    /// 10.
    pub browser_lease_s: f64,
    /// Share of a stepping thread's time that sessions may use, 0 to 1. Beyond it, the thread accepts no
    /// further session. Default: 0.85.
    pub thread_share: f64,
    /// Open connections. Further ones are closed at once. The bound is lower if the process may not open as
    /// many files. Default: 4096.
    pub connections: usize,
    /// Open connections from one IPv4 address or one IPv6 network of 64 bits. Further ones are closed at once.
    /// Default: 2048.
    pub connections_per_address: usize,
    /// Streams and calls at the same time on one connection. Default: 256.
    pub streams_per_connection: u32,
    /// Bytes of a message from a client. Default: 2^20.
    pub message_bytes: usize,
    /// Unread bytes of all streams of one connection. Beyond it, the transport holds the client back. This
    /// bounds the memory that a connection takes. Default: 2^20.
    pub connection_window_bytes: u32,
    /// Time within which a new connection must choose its protocol, the TLS handshake included, s. Then it is
    /// closed. Default: 10.
    pub handshake_s: f64,
    /// Time within which a haptic stream must send its first message, and a call its complete message, s. Then
    /// it is ended. Default: 10.
    pub open_s: f64,
    /// Time of silence after which a connection is tested, and time for its answer, s. Without an answer it is
    /// closed. Default: 10.
    pub keepalive_s: f64,
    /// Commands of a haptic stream per tool and step of the session. Commands that stay faster are refused.
    /// Default: 4.
    pub commands_per_step: f64,
    /// Springs times iterations of an exact force law. If they do not suffice, the coarse law stays. Default:
    /// 2^27.
    pub law_work: u64,
    /// Operations, of some nanoseconds each, of one piece of heavy work on a mesh. Default: 2^32.
    pub mesh_work: u64,
    /// Pieces of heavy work (creating a session, changing a tissue, computing a force law) of one caller that
    /// wait. Default: 256.
    pub queued_work: usize,
    /// Time from the request of such a piece of work until it must be done, s. Default: 30.
    pub work_s: f64,
    /// Sessions created over one connection per minute; as many may be created at once. Default: 600.
    pub sessions_per_minute: f64,
    /// Calls of any kind over one connection per second; as many may come at once. Default: 2000.
    pub calls_per_s: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            points: 1 << 22,
            substeps: 100_000,
            point_force_n: 1e4,
            reach_in_sides: 10.0,
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
            ties: 64,
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
            press_work: 1 << 30,
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
    /// Returns the limits for a process that serves a single user, such as a command-line program: 32 times the
    /// `rehearsal_work`, all others unchanged. Calling it twice multiplies twice.
    #[must_use]
    pub fn offline(self) -> Self {
        Limits { rehearsal_work: self.rehearsal_work.saturating_mul(OFFLINE_WORK), ..self }
    }
}
