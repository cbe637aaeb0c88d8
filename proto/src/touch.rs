//! Conversion of devices, tips, force laws and local models to messages and back.

use glam::{DMat3, DVec3};
use palpate_haptics::force_law::{Law, Row};
use palpate_haptics::{ContactState, Coupling, Device, LocalModel, MotionState, OtherTool, Tip, TipShape};

use crate::geometry::{from_vector, point, vector};
use crate::pb;
use palpate_refusal::{self as refusal, Reason, Refusal, Result, number};

/// Returns the device in a message, with the name `declared` instead of its own.
///
/// # Errors
/// Refuses a name of more than 128 bytes or with control characters, and a limit that is not above 0 or beyond its
/// range: forces to 1000 N, stiffness to 10⁶ N/m, damping to 10⁴ N·s/m, the workspace's radius to 10 m. Refuses a torque that is negative or above 100 N·m.
pub fn from_device(message: &pb::Device) -> Result<Device> {
    refusal::label("device.name", &message.name)?;
    let within = |field: &str, value: f64, most: f64| {
        let field = format!("device.{field}");
        number(&field, value, &format!("above 0 and at most {most}"), |v| v > 0.0 && v <= most)
    };
    Ok(Device {
        name: "declared",
        force_n: within("max_force_n", message.max_force_n, 1e3)?,
        continuous_n: within("continuous_force_n", message.continuous_force_n, 1e3)?,
        stiffness_n_per_m: within("max_stiffness_n_per_m", message.max_stiffness_n_per_m, 1e6)?,
        damping_n_s_per_m: within("max_damping_n_s_per_m", message.max_damping_n_s_per_m, 1e4)?,
        workspace_m: within("workspace_radius_m", message.workspace_radius_m, 10.0)?,
        torque_n_m: number("device.max_torque_n_m", message.max_torque_n_m, "from 0 to 100", |v| {
            (0.0..=100.0).contains(&v)
        })?,
    })
}

/// Converts a device to a message, with its name. Does not check the values.
pub fn device(device: &Device) -> pb::Device {
    pb::Device {
        name: device.name.to_owned(),
        max_force_n: device.force_n,
        continuous_force_n: device.continuous_n,
        max_stiffness_n_per_m: device.stiffness_n_per_m,
        max_damping_n_s_per_m: device.damping_n_s_per_m,
        workspace_radius_m: device.workspace_m,
        max_torque_n_m: device.torque_n_m,
    }
}

/// Returns the tip in a message; the default tip if it is absent, with the default friction if that is absent.
/// Couples it by a spring if the message has one, otherwise by a constraint. Does not check other values than the shape.
///
/// # Errors
/// Refuses a shape that this program does not know (`{field}.shape`).
pub fn from_tip(field: &str, tip: Option<&pb::Tip>) -> Result<Tip> {
    let Some(tip) = tip else { return Ok(Tip::default()) };
    let unknown =
        |_| Refusal::new(Reason::OutOfRange, format!("{field}.shape"), "is a shape that this program does not know");
    Ok(Tip {
        shape: match pb::TipShape::try_from(tip.shape).map_err(unknown)? {
            pb::TipShape::Unspecified | pb::TipShape::Disc => TipShape::Disc,
            pb::TipShape::RigidDisc => TipShape::RigidDisc,
            pb::TipShape::Sphere => TipShape::Sphere,
            pb::TipShape::Blade => TipShape::Blade,
        },
        radius_m: tip.radius_m,
        friction: tip.friction.unwrap_or(Tip::default().friction),
        grasps: tip.grasps,
        coupling: tip.spring.as_ref().map_or(Coupling::Constraint, |spring| Coupling::Spring {
            stiffness_n_per_m: spring.stiffness_n_per_m,
            damping_n_s_per_m: spring.damping_n_s_per_m,
        }),
        edge_m: from_vector(tip.edge_m.as_ref()),
        burn_s: tip.burn_s,
    })
}

/// Converts a tip to a message; [`from_tip`] returns an equal tip.
pub fn tip(tip: &Tip) -> pb::Tip {
    let shape = match tip.shape {
        TipShape::Disc => pb::TipShape::Unspecified,
        TipShape::RigidDisc => pb::TipShape::RigidDisc,
        TipShape::Sphere => pb::TipShape::Sphere,
        TipShape::Blade => pb::TipShape::Blade,
    };
    pb::Tip {
        shape: shape.into(),
        radius_m: tip.radius_m,
        friction: Some(tip.friction),
        grasps: tip.grasps,
        spring: match tip.coupling {
            Coupling::Constraint => None,
            Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => {
                Some(pb::Spring { stiffness_n_per_m, damping_n_s_per_m })
            }
        },
        edge_m: (tip.edge_m != DVec3::ZERO).then(|| vector(tip.edge_m)).flatten(),
        burn_s: tip.burn_s,
    }
}

/// Converts a tool of another stream to a message. Its time is that of the sample.
pub fn other_tool(other: &OtherTool) -> pb::OtherTool {
    pb::OtherTool {
        tool: other.tool,
        position_m: vector(other.motion.place_m),
        velocity_m_per_s: vector(other.motion.velocity_m_per_s),
        tip: Some(tip(&other.tip)),
    }
}

/// Returns the tool of another stream in a message, at the time `time_s` of the client's clock; `None` if its tip has a
/// shape that this program does not know. Absent vectors become 0.
pub fn from_other_tool(message: &pb::OtherTool, time_s: f64) -> Option<OtherTool> {
    let (place_m, velocity_m_per_s) =
        (from_vector(message.position_m.as_ref()), from_vector(message.velocity_m_per_s.as_ref()));
    let motion = MotionState { time_s, place_m, velocity_m_per_s };
    Some(OtherTool { tool: message.tool, tip: from_tip("tip", message.tip.as_ref()).ok()?, motion })
}

/// Creates the pose of a tool whose tip is at `place_m` in the tissue's frame, m, without orientation, offset or
/// velocity.
pub fn pose(place_m: DVec3, tip: &Tip) -> pb::Pose {
    pb::Pose {
        position_m: vector(place_m),
        orientation: None,
        tip_offset_m: None,
        tip: Some(self::tip(tip)),
        velocity_m_per_s: None,
    }
}

/// Converts a force law to a message. `number` is its number in the stream, by which local models refer to it.
pub fn law(law: &Law, number: u32) -> pb::ForceLaw {
    let row = |row: &Row| pb::ForceLawRow {
        force_n: row.force_n,
        stiffness_n_per_m: row.stiffness_n_per_m,
        across_n_per_m: row.across_n_per_m,
        damping_n_s_per_m: row.damping_n_s_per_m,
        across_n_s_per_m: row.across_n_s_per_m,
        drag_n_s_per_m: row.drag_n_s_per_m,
    };
    pb::ForceLaw { step_m: law.step_m, rows: law.rows.iter().map(row).collect(), coarse: law.is_coarse, number }
}

/// Returns the force law in a message, without its number.
///
/// # Errors
/// Refuses a law that a client can't use ([`Law::is_sound`]): with fewer than two rows, a number that is not finite or
/// below 0, a distance of the rows of 0, or forces that fall from row to row.
pub fn from_law(message: &pb::ForceLaw) -> Result<Law> {
    let row = |row: &pb::ForceLawRow| Row {
        force_n: row.force_n,
        stiffness_n_per_m: row.stiffness_n_per_m,
        across_n_per_m: row.across_n_per_m,
        damping_n_s_per_m: row.damping_n_s_per_m,
        across_n_s_per_m: row.across_n_s_per_m,
        drag_n_s_per_m: row.drag_n_s_per_m,
    };
    let rows = message.rows.iter().map(row).collect();
    let law = Law { step_m: message.step_m, rows, is_coarse: message.coarse };
    let range = "must have at least two rows, all numbers finite and at least 0, and forces that never fall";
    let wrong = || Refusal::new(Reason::OutOfRange, "law", range);
    if law.is_sound() { Ok(law) } else { Err(wrong()) }
}

/// Creates the message about the law that replaces the law numbered `before`. `update` is the number and the new law,
/// or the reason and message why there is none. `tissue_step` is the step from whose beginning a changed tissue acts,
/// if that is the cause; `None` if the tissue has not changed.
pub fn law_update(
    before: u32,
    tissue_step: Option<u64>,
    update: std::result::Result<(u32, &Law), (&str, &str)>,
) -> pb::ForceLawUpdate {
    let unchanged = pb::ForceLawUpdate { coarse_number: before, tissue_step, ..Default::default() };
    match update {
        Ok((number, newer)) => pb::ForceLawUpdate { law: Some(law(newer, number)), ..unchanged },
        Err((reason, message)) => {
            pb::ForceLawUpdate { reason: reason.to_owned(), message: message.to_owned(), ..unchanged }
        }
    }
}

fn symmetric(m: DMat3) -> Option<pb::Symmetric3> {
    let (x, y, z) = (m.x_axis, m.y_axis, m.z_axis);
    Some(pb::Symmetric3 { xx: x.x, yy: y.y, zz: z.z, xy: x.y, xz: x.z, yz: y.z })
}

fn from_symmetric(m: Option<&pb::Symmetric3>) -> DMat3 {
    m.map_or(DMat3::ZERO, |m| {
        DMat3::from_cols(DVec3::new(m.xx, m.xy, m.xz), DVec3::new(m.xy, m.yy, m.yz), DVec3::new(m.xz, m.yz, m.zz))
    })
}

/// Converts a local model to a message, without its step, which is that of the sample. Rounds its time to
/// nanoseconds; a negative one becomes 0. Leaves out a curvature of zero.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn local_model(model: &LocalModel) -> pb::LocalModel {
    let contact = match model.contact_state {
        ContactState::Free => pb::Contact::Free,
        ContactState::Sticking => pb::Contact::Sticking,
        ContactState::Sliding => pb::Contact::Sliding,
        ContactState::Holding => pb::Contact::Holding,
    };
    pb::LocalModel {
        sequence: model.sequence,
        client_time_ns: (model.client_time_s * 1e9).round().max(0.0) as u64,
        position_m: vector(model.place_m),
        velocity_m_per_s: vector(model.velocity_m_per_s),
        force_on_tool_n: vector(model.force_n),
        stiffness_n_per_m: symmetric(model.stiffness_n_per_m),
        damping_n_s_per_m: symmetric(model.damping_n_s_per_m),
        surface_m: vector(model.surface_m),
        normal: vector(model.normal),
        curvature_per_m: symmetric(model.curvature_per_m).filter(|_| model.curvature_per_m != DMat3::ZERO),
        valid_m: model.valid_m,
        friction: model.friction,
        contact: contact.into(),
        law: model.law,
    }
}

/// Returns the local model in a message. `step` is the step of its sample. Vectors and matrices that are absent
/// become 0, and an unspecified contact [`ContactState::Free`]. Does not check the values: the renderer refuses
/// invalid models.
pub fn from_local_model(message: &pb::LocalModel, step: u64) -> LocalModel {
    let contact_state = match message.contact() {
        pb::Contact::Unspecified | pb::Contact::Free => ContactState::Free,
        pb::Contact::Sticking => ContactState::Sticking,
        pb::Contact::Sliding => ContactState::Sliding,
        pb::Contact::Holding => ContactState::Holding,
    };
    #[allow(clippy::cast_precision_loss)]
    LocalModel {
        sequence: message.sequence,
        client_time_s: message.client_time_ns as f64 * 1e-9,
        step,
        place_m: from_vector(message.position_m.as_ref()),
        velocity_m_per_s: from_vector(message.velocity_m_per_s.as_ref()),
        force_n: from_vector(message.force_on_tool_n.as_ref()),
        stiffness_n_per_m: from_symmetric(message.stiffness_n_per_m.as_ref()),
        damping_n_s_per_m: from_symmetric(message.damping_n_s_per_m.as_ref()),
        surface_m: from_vector(message.surface_m.as_ref()),
        normal: from_vector(message.normal.as_ref()),
        curvature_per_m: from_symmetric(message.curvature_per_m.as_ref()),
        valid_m: message.valid_m,
        friction: message.friction,
        contact_state,
        law: message.law,
    }
}

/// Bytes of the headers around a message of a stream: gRPC, HTTP/2, TCP and IP.
const HEADER_BYTES: u64 = 5 + 9 + 32 + 20;

/// Returns the size of a sample on the wire in a stream, bytes: the encoded message, and 66 bytes for the headers of
/// gRPC, HTTP/2, TCP and IP.
pub fn wire_bytes(sample: &pb::Sample) -> u64 {
    prost::Message::encoded_len(sample) as u64 + HEADER_BYTES
}

/// Returns the size on the wire ([`wire_bytes`]) of a typical sample of one tool with this model, bytes, for estimates
/// without a server.
pub fn sample_bytes(model: &LocalModel) -> u64 {
    let tool = pb::ToolSample {
        acknowledged_sequence: model.sequence,
        client_time_ns: 1,
        server_hold_ns: 1 << 20,
        step_wait_ns: 1 << 19,
        point: Some(point([15, 15])),
        displacement_m: vector(model.surface_m),
        velocity_m_per_s: vector(model.velocity_m_per_s),
        force_on_tool_n: vector(model.force_n),
        applied_force_n: vector(-model.force_n),
        local_model: Some(local_model(model)),
        ..Default::default()
    };
    wire_bytes(&pb::Sample {
        step: model.step,
        simulation_time_s: 1.0,
        server_time_ns: 1,
        time_dilation: 1.0,
        awake_points: 961,
        tools: vec![tool],
        ..Default::default()
    })
}
