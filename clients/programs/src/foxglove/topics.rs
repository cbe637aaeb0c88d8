//! The topics of a session that is shown live: its server for Foxglove, and the messages.

use std::collections::HashMap;
use std::collections::btree_map::{BTreeMap, Entry};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use ::foxglove::{Context, PartialMetadata, RawChannel, Schema, WebSocketServerHandle};
use glam::DVec3;
use palpate_client::view::SurfaceState;
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::journal::{TissueCurve, ToolCurve};
use palpate_proto::pb;
use palpate_session::journal::format::schema_of;
use palpate_session::journal::foxglove::{SURFACE_SCHEMA, TISSUE_SCHEMA, TOOL_SCHEMA, point_cloud};
use pb::view_service_client::ViewServiceClient;
use prost::Message;
use tonic::Status;

/// Number of messages that wait for a slow Foxglove; then the oldest are dropped. The point cloud of a large mesh has
/// some megabytes.
const MAX_WAITING_MESSAGES: usize = 64;

/// Largest number of vertices of a surface.
const MAX_VERTICES: usize = 1 << 24;

/// The vertices of a session's surface at rest, in the order of frames.
#[derive(Default)]
pub(super) struct RestVertices {
    /// Position of each vertex, m.
    rest_m: Vec<[f32; 3]>,
    /// Number of vertices along y of a sheet.
    vertices_y: usize,
    /// The index of each vertex of a mesh by its number in the file.
    of_file_vertex: HashMap<u32, usize>,
}

impl RestVertices {
    /// Gets the surface of a session.
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke; `DATA_LOSS` for more than 2²⁴ vertices.
    pub(super) async fn get(channel: palpate_client::Channel, session_id: &str) -> Result<Self, Status> {
        let request = pb::GetMeshRequest { session_id: session_id.to_owned(), refinement: 0 };
        let mut parts = ViewServiceClient::new(channel).get_mesh(request).await?.into_inner();
        let mut surface = RestVertices::default();
        while let Some(part) = parts.message().await? {
            surface.rest_m.extend_from_slice(part.rest_position_m.as_chunks().0);
            surface.vertices_y = part.vertices_y as usize;
            let known = surface.of_file_vertex.len();
            surface.of_file_vertex.extend(part.file_vertex.iter().enumerate().map(|(k, &vertex)| (vertex, known + k)));
            if surface.rest_m.len() > MAX_VERTICES || surface.of_file_vertex.len() > MAX_VERTICES {
                return Err(Status::data_loss("the server's mesh is too large to be shown"));
            }
        }
        Ok(surface)
    }

    /// Returns the position of a tool's control point at rest, m; `None` for a tool without one.
    fn control_point_m(&self, tool: &pb::ToolSample) -> Option<DVec3> {
        let index = match (&tool.point, tool.vertex) {
            (Some(point), _) => (point.x as usize).checked_mul(self.vertices_y)?.checked_add(point.y as usize)?,
            (None, Some(vertex)) => *self.of_file_vertex.get(&vertex)?,
            (None, None) => return None,
        };
        Some(DVec3::from(self.rest_m.get(index)?.map(f64::from)))
    }
}

/// The topics, and the server that Foxglove connects to.
pub(super) struct Topics {
    context: Arc<Context>,
    server: WebSocketServerHandle,
    tissue: Arc<RawChannel>,
    surface: Arc<RawChannel>,
    tools: BTreeMap<u32, Arc<RawChannel>>,
    /// Largest displacement in the newest frame, m.
    largest_displacement_m: f64,
    /// The tools in the newest record: those that poses lead.
    posed: Vec<u32>,
}

fn channel(context: &Arc<Context>, topic: &str, schema: [&str; 2]) -> Result<Arc<RawChannel>, String> {
    let [name, file] = schema;
    let builder = context.channel_builder(topic).message_encoding("protobuf");
    let built = builder.schema(Schema::new(name, "protobuf", schema_of(file))).build_raw();
    built.map_err(|e| format!("the topic {topic} can't be made: {e}"))
}

/// Returns the time of the system, ns since the Unix epoch.
fn unix_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

fn send(channel: &RawChannel, message: &impl Message) {
    if channel.has_sinks() {
        channel.log_with_meta(&message.encode_to_vec(), PartialMetadata { log_time: Some(unix_ns()) });
    }
}

impl Topics {
    /// Starts the server.
    ///
    /// # Errors
    /// Returns why it can't listen at that address.
    pub(super) async fn serve(listen: SocketAddr) -> Result<Self, String> {
        let context = Context::new();
        let tissue = channel(&context, "/tissue", TISSUE_SCHEMA)?;
        let surface = channel(&context, "/surface", SURFACE_SCHEMA)?;
        let server = context.websocket_server().name("palpate").message_backlog_size(MAX_WAITING_MESSAGES);
        let started = server.bind(listen.ip().to_string(), listen.port()).start().await;
        let server = started.map_err(|e| format!("--listen {listen}: {e}"))?;
        let (tools, posed) = (BTreeMap::new(), Vec::new());
        Ok(Topics { context, server, tissue, surface, tools, largest_displacement_m: 0.0, posed })
    }

    /// Returns the port that it listens at.
    pub(super) fn port(&self) -> u16 {
        self.server.port()
    }

    /// Sends the points of a frame.
    pub(super) fn frame(&mut self, rest: &RestVertices, surface: &SurfaceState) {
        let moved = surface.displacement_m.iter().map(|moved_m| moved_m.map(f64::from));
        let lengths = moved.clone().map(|moved_m| DVec3::from(moved_m).length());
        // A frame may have more vertices than the surface.
        self.largest_displacement_m = lengths.clone().take(rest.rest_m.len()).fold(0.0, f64::max);
        if self.surface.has_sinks() {
            let place =
                |rest_m: &[f32; 3], moved_m: [f64; 3]| DVec3::from(rest_m.map(f64::from)) + DVec3::from(moved_m);
            let points = rest.rest_m.iter().zip(moved).zip(lengths);
            let points = points.map(|((rest_m, moved_m), length_m)| (place(rest_m, moved_m), length_m));
            send(&self.surface, &point_cloud(unix_ns(), points));
        }
    }

    /// Sends the energies of a record, and what the tools in it do and feel.
    ///
    /// # Errors
    /// Returns why a tool has no topic.
    pub(super) fn record(&mut self, record: &pb::ProbeResponse) -> Result<(), String> {
        if let Some(energy) = &record.energy {
            let curve = TissueCurve {
                step: record.step,
                time_s: record.simulation_time_s,
                kinetic_j: energy.kinetic_j,
                spring_j: energy.spring_j,
                anchor_j: energy.anchor_j,
                largest_displacement_m: self.largest_displacement_m,
                awake_points: record.awake_points,
            };
            send(&self.tissue, &curve);
        }
        self.posed.clear();
        for tool in &record.tools {
            self.posed.push(tool.tool);
            self.tool(&ToolCurve {
                step: record.step,
                time_s: record.simulation_time_s,
                tool: tool.tool,
                place_m: tool.place_m,
                displacement_m: tool.displacement_m,
                force_n: tool.force_on_tool_n,
                force_magnitude_n: from_vector(tool.force_on_tool_n.as_ref()).length(),
            })?;
        }
        Ok(())
    }

    /// Sends what the tools of a sample do and feel that are not in records: those that no poses lead. Their place is
    /// that of the control point.
    ///
    /// # Errors
    /// Returns why a tool has no topic.
    pub(super) fn sample(&mut self, rest: &RestVertices, sample: &pb::Sample) -> Result<(), String> {
        for tool in &sample.tools {
            let Some(rest_m) = rest.control_point_m(tool).filter(|_| !self.posed.contains(&tool.tool)) else {
                continue;
            };
            self.tool(&ToolCurve {
                step: sample.step,
                time_s: sample.simulation_time_s,
                tool: tool.tool,
                place_m: vector(rest_m + from_vector(tool.displacement_m.as_ref())),
                displacement_m: tool.displacement_m,
                force_n: tool.force_on_tool_n,
                force_magnitude_n: from_vector(tool.force_on_tool_n.as_ref()).length(),
            })?;
        }
        Ok(())
    }

    fn tool(&mut self, curve: &ToolCurve) -> Result<(), String> {
        let topic = match self.tools.entry(curve.tool) {
            Entry::Occupied(topic) => topic.into_mut(),
            Entry::Vacant(missing) => {
                missing.insert(channel(&self.context, &format!("/tool/{}", curve.tool), TOOL_SCHEMA)?)
            }
        };
        send(topic, curve);
        Ok(())
    }

    /// Ends the server and the connections to it.
    pub(super) async fn stop(self) {
        self.server.stop().wait().await;
    }
}
