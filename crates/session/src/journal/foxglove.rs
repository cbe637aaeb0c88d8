//! Exports for Foxglove: curves of tools and energies, and the moving points of the tissue.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::sync::Arc;

use glam::DVec3;
use mcap::{Channel, Message as Record, Schema, WriteOptions, Writer};
use palpate_proto::geometry::vector;
use palpate_proto::journal::foxglove::packed_element_field::NumericType;
use palpate_proto::journal::foxglove::{PackedElementField, PointCloud, Pose, Quaternion, Vector3};
use palpate_proto::journal::{TissueCurve, ToolCurve};
use prost::Message;

use super::format::{VERSION, schema_of};
use crate::Session;
use palpate_refusal::{Reason, Refusal, Result};

/// An MCAP export for Foxglove that is being written: channels `/tissue`, `/surface` and `/tool/N`. It is complete
/// only after [`Export::finish`].
pub struct Export<W: Write + Seek> {
    writer: Writer<W>,
    /// Time of step `begin`, ns since the Unix epoch.
    begun_ns: u64,
    begin: u64,
    rate_hz: f64,
    tissue: Arc<Channel<'static>>,
    points: Arc<Channel<'static>>,
    of_tools: Arc<Schema<'static>>,
    tools: BTreeMap<u32, Arc<Channel<'static>>>,
    /// The newest written step of the curves, and of the surface.
    newest: [Option<u64>; 2],
}

fn unwritten(e: &mcap::McapError) -> Refusal {
    Refusal::new(Reason::Unreadable, "", format!("the export can't be written: {e}"))
}

fn schema(id: u16, [name, file]: [&str; 2]) -> Arc<Schema<'static>> {
    let (name, encoding) = (name.to_owned(), "protobuf".to_owned());
    Arc::new(Schema { id, name, encoding, data: Cow::Owned(schema_of(file)) })
}

fn channel(id: u16, topic: String, schema: &Arc<Schema<'static>>) -> Arc<Channel<'static>> {
    let (schema, message_encoding) = (Some(schema.clone()), "protobuf".to_owned());
    Arc::new(Channel { id, topic, schema, message_encoding, metadata: BTreeMap::new() })
}

/// The schema of the topic `/tissue`: the name of the message, and its file in the protocol.
pub const TISSUE_SCHEMA: [&str; 2] = ["palpate.journal.v1.TissueCurve", CURVES];
/// The schema of the topics `/tool/0`, `/tool/1` and so on, likewise.
pub const TOOL_SCHEMA: [&str; 2] = ["palpate.journal.v1.ToolCurve", CURVES];
/// The schema of the topic `/surface`, likewise.
pub const SURFACE_SCHEMA: [&str; 2] = ["foxglove.PointCloud", "foxglove/PointCloud.proto"];

/// The file of the curves.
const CURVES: &str = "palpate/journal/v1/curves.proto";

/// Returns the points of a tissue as a message of the topic `/surface`, in the frame `tissue`. `unix_ns` is its time, ns
/// since the Unix epoch; each point has a place and the length of its displacement, m, which become 32-bit floats.
#[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
pub fn point_cloud(unix_ns: u64, points: impl Iterator<Item = (DVec3, f64)>) -> PointCloud {
    let mut data = Vec::with_capacity(16 * points.size_hint().0);
    for (at_m, moved_m) in points {
        for number in [at_m.x, at_m.y, at_m.z, moved_m] {
            data.extend((number as f32).to_le_bytes());
        }
    }
    let field = |(name, offset): (&str, u32)| PackedElementField {
        name: name.to_owned(),
        offset,
        r#type: NumericType::Float32.into(),
    };
    PointCloud {
        timestamp: Some(prost_types::Timestamp {
            seconds: (unix_ns / 1_000_000_000) as i64,
            nanos: (unix_ns % 1_000_000_000) as i32,
        }),
        frame_id: "tissue".to_owned(),
        pose: Some(Pose {
            position: Some(Vector3::default()),
            orientation: Some(Quaternion { w: 1.0, ..Quaternion::default() }),
        }),
        point_stride: 16,
        fields: [("x", 0), ("y", 4), ("z", 8), ("displacement_m", 12)].map(field).to_vec(),
        data,
    }
}

/// Number before the channels of the tools: tool n has the channel 16 + n.
const FIRST_TOOL: u16 = 16;

impl<W: Write + Seek> Export<W> {
    /// Begins an export of a session at its present step, whose time is `begun_ns`, ns since the Unix epoch; later
    /// steps follow at their nominal interval. Writes the beginning of the file to `output`.
    ///
    /// # Errors
    /// Refuses an output that can't be written ([`Reason::Unreadable`]).
    pub fn new(output: W, begun_ns: u64, session: &Session) -> Result<Self> {
        let options = WriteOptions::new().library(format!("palpate {VERSION}"));
        let (of_tissue, of_points) = (schema(2, TISSUE_SCHEMA), schema(3, SURFACE_SCHEMA));
        Ok(Export {
            writer: options.create(output).map_err(|e| unwritten(&e))?,
            begun_ns,
            begin: session.step_count(),
            rate_hz: session.model().scene.stepping.rate_hz,
            tissue: channel(1, "/tissue".to_owned(), &of_tissue),
            points: channel(2, "/surface".to_owned(), &of_points),
            of_tools: schema(1, TOOL_SCHEMA),
            tools: BTreeMap::new(),
            newest: [None; 2],
        })
    }

    /// Returns the time of a step, ns since the Unix epoch, as if each step since the beginning had taken its
    /// nominal time.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn unix_ns(&self, step: u64) -> u64 {
        let since_s = step.saturating_sub(self.begin) as f64 / self.rate_hz;
        self.begun_ns.saturating_add((since_s * 1e9) as u64)
    }

    /// Notes a step as the newest. Returns whether it is not the newest already.
    fn is_new(&mut self, which: usize, step: u64) -> bool {
        self.newest[which].replace(step) != Some(step)
    }

    #[allow(clippy::cast_possible_truncation)]
    fn write(&mut self, channel: &Arc<Channel<'static>>, step: u64, message: &impl Message) -> Result<()> {
        let time = self.unix_ns(step);
        let record = Record {
            channel: channel.clone(),
            sequence: step as u32,
            log_time: time,
            publish_time: time,
            data: Cow::Owned(message.encode_to_vec()),
        };
        self.writer.write(&record).map_err(|e| unwritten(&e))
    }

    /// Writes the curves of the session's present step: the pose and force of each tool that ever had a control
    /// point, and the energies of the tissue, J. Does nothing if the step is the one that was written last. It
    /// computes every awake point.
    ///
    /// # Errors
    /// Refuses an output that can't be written ([`Reason::Unreadable`]).
    #[allow(clippy::cast_possible_truncation)]
    pub fn curves(&mut self, session: &Session) -> Result<()> {
        let (step, time_s) = (session.step_count(), session.time_s());
        if !self.is_new(0, step) {
            return Ok(());
        }
        for felt in session.felt() {
            let number = felt.tool;
            let of_tools = self.of_tools.clone();
            let id = FIRST_TOOL.saturating_add(number as u16);
            let channel = self.tools.entry(number).or_insert_with(|| channel(id, format!("/tool/{number}"), &of_tools));
            let curve = ToolCurve {
                step,
                time_s,
                tool: number,
                place_m: vector(felt.place_m),
                displacement_m: vector(felt.displacement_m),
                force_n: vector(felt.force_n),
                force_magnitude_n: felt.force_n.length(),
            };
            let channel = channel.clone();
            self.write(&channel, step, &curve)?;
        }
        let energy = session.energy();
        let curve = TissueCurve {
            step,
            time_s,
            kinetic_j: energy.kinetic,
            spring_j: energy.spring,
            anchor_j: energy.anchor_springs,
            largest_displacement_m: session.tissue().largest_displacement_m(),
            awake_points: session.tissue().awake_points() as u32,
        };
        let channel = self.tissue.clone();
        self.write(&channel, step, &curve)
    }

    /// Writes a point cloud of the session's present step: the place of each simulated point and the length of its
    /// displacement, m, as 32-bit floats in the order of the points. Does nothing if the step is the one that was
    /// written last.
    ///
    /// # Errors
    /// Refuses an output that can't be written ([`Reason::Unreadable`]).
    pub fn surface(&mut self, session: &Session) -> Result<()> {
        let step = session.step_count();
        if !self.is_new(1, step) {
            return Ok(());
        }
        let model = session.model();
        let point = |point| {
            let moved_m = session.tissue().point(point).displacement_m;
            (model.shape().rest_m(point) + moved_m, moved_m.length())
        };
        let cloud = point_cloud(self.unix_ns(step), model.points().map(point));
        let channel = self.points.clone();
        self.write(&channel, step, &cloud)
    }

    /// Writes the summary and the end of the export, and returns the output.
    ///
    /// # Errors
    /// Refuses an output that can't be written ([`Reason::Unreadable`]).
    pub fn finish(mut self) -> Result<W> {
        self.writer.finish().map_err(|e| unwritten(&e))?;
        Ok(self.writer.into_inner())
    }
}
