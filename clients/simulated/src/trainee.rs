//! Simulated trainees of exercises that hide lumps: they press a block in rows through a server, and mark where it felt stiffer than at
//! other places. They decide by the forces that they feel and by nothing else.
//!
//! A press goes straight down to a depth and up again. A trainee keeps the largest force of each. On a block without lumps the force
//! depends on how far the edges are, so each press is compared with those at places that are as far from them: by the median of the up to
//! eight places that mirror it. What is left, smoothed over neighbours, is how much stiffer it felt there. The trainee marks the stiffest places, if
//! they are stiffer than its threshold.

use std::collections::VecDeque;

use glam::DVec3;
use palpate_client::{Channel, Touch};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use crate::random::Random;

/// How a trainee presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TraineeKind {
    /// Presses the whole surface, deep and evenly.
    Expert,
    /// Presses few places, fast and unevenly.
    Hurried,
    /// Presses the whole surface so lightly that it feels little.
    Timid,
    /// Presses as the expert does, and pays no attention: it marks places by chance.
    Blind,
}

impl TraineeKind {
    /// All kinds, the expert first.
    pub const ALL: [TraineeKind; 4] =
        [TraineeKind::Expert, TraineeKind::Hurried, TraineeKind::Timid, TraineeKind::Blind];

    fn manner(self) -> Manner {
        let careful = Manner { spacing_m: 0.01, depth_m: 0.0055, unsteady_m: 0.0, steps: [40, 60, 30, 30] };
        match self {
            TraineeKind::Expert | TraineeKind::Blind => careful,
            TraineeKind::Hurried => Manner { spacing_m: 0.02, unsteady_m: 0.0007, steps: [30, 30, 5, 20], ..careful },
            TraineeKind::Timid => Manner { depth_m: 0.0007, ..careful },
        }
    }
}

/// The movements of a trainee.
#[derive(Debug, Clone, Copy)]
struct Manner {
    /// Distance of neighbouring presses.
    spacing_m: f64,
    /// Depth of a press, and the standard deviation of what it deviates from that.
    depth_m: f64,
    unsteady_m: f64,
    /// Steps of a press: to its place, down, hold, up.
    steps: [u64; 4],
}

/// Radius of the fingertip, m.
pub const FINGER_M: f64 = 0.008;

/// Standard deviation of a force as it is felt, N.
const NOISE_N: f64 = 0.01;

/// How much stiffer a place must feel to be marked.
const THRESHOLD: f64 = 0.013;

/// Marks of one trainee, at most, and the least distance between two, m.
const MAX_MARKS: usize = 4;
const APART_M: f64 = 0.018;

/// Height above the surface between presses, m, and distance of the outermost presses from the edge, m.
const HEIGHT_M: f64 = 0.0015;
const MARGIN_M: f64 = 0.01;

/// A press and what it felt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeltPress {
    /// The place of the surface at rest, m.
    pub place_m: DVec3,
    /// The largest force, N.
    pub force_n: f64,
}

/// What a trainee did.
#[derive(Debug, Clone, PartialEq)]
pub struct TraineeWork {
    /// Its presses, in their order.
    pub presses: Vec<FeltPress>,
    /// The places that it marked, m.
    pub marks_m: Vec<DVec3>,
}

/// A press that is planned.
struct PlannedPress {
    place_m: DVec3,
    /// The first step of it, and the first after it.
    steps: [u64; 2],
}

/// Does the exercise of a session, which `trainee_id` opens: presses, decides, marks and lets go. Does not end the exercise. The seed decides
/// about what is left to chance in the trainee.
///
/// # Errors
/// Returns the refusals of the server, and how a connection broke.
pub async fn do_exercise(
    channel: Channel,
    trainee_id: &str,
    kind: TraineeKind,
    seed: u64,
) -> Result<TraineeWork, Status> {
    let session_id = trainee_id.to_owned();
    let asked = SessionServiceClient::new(channel.clone()).get_session(pb::GetSessionRequest { session_id }).await?;
    let extent = asked.into_inner().session.and_then(|session| session.extent);
    let (least_m, most_m) = extent.and_then(|extent| extent.least_m.zip(extent.most_m)).unwrap_or_default();
    let mut random = Random::new(seed, kind as u64);
    let manner = kind.manner();
    let places = rows(least_m, most_m, manner.spacing_m);
    let middle_m = 0.5 * (from_vector(Some(&least_m)) + from_vector(Some(&most_m)));
    let open = pb::TouchOpen {
        session_id: trainee_id.to_owned(),
        tools: vec![0],
        lease_s: Some(60.0),
        holder: "simulated trainee".to_owned(),
        sample_every_steps: Some(2),
        ..Default::default()
    };
    let (say, messages) = tokio::sync::mpsc::channel(1 << 10);
    let mut touch = Touch::open(channel, open, ReceiverStream::new(messages)).await?;
    let from = touch.opened().step + LEAD_STEPS;
    let (planned, mut poses) = plan(&places, most_m.z, &manner, from, &mut random);
    let end = planned.last().map_or(from, |press| press.steps[1]);
    let mut presses: Vec<FeltPress> =
        planned.iter().map(|press| FeltPress { place_m: press.place_m, force_n: 0.0 }).collect();
    let (mut sequence, mut now) = (0, touch.opened().step);
    while now < end {
        while let Some(&(step, place_m)) = poses.front().filter(|(step, _)| *step < now + 2 * LEAD_STEPS) {
            poses.pop_front();
            sequence += 1;
            let tip = Some(pb::Tip { radius_m: FINGER_M, ..Default::default() });
            let pose = pb::Pose { position_m: vector(place_m), tip, ..Default::default() };
            send(&say, command(sequence, Some(step), pb::command::Action::Pose(pose))).await?;
        }
        let Some(sample) = next_sample(&mut touch).await? else { break };
        now = sample.step;
        // A sample is of the end of a step.
        let at = planned.partition_point(|press| press.steps[1] < now);
        let felt = sample.tools.first().and_then(|tool| tool.force_on_tool_n);
        if let (Some(press), Some(felt)) = (presses.get_mut(at), felt) {
            press.force_n = press.force_n.max(DVec3::new(felt.x, felt.y, felt.z).length());
        }
    }
    let marks_m = match kind {
        TraineeKind::Blind => (0..3).map(|_| *random.one_of(&places)).collect(),
        _ => decided(&presses, middle_m, manner.spacing_m, &mut random),
    };
    for place_m in &marks_m {
        sequence += 1;
        let mark = pb::Mark { place_m: vector(*place_m), diameter_m: None };
        send(&say, command(sequence, None, pb::command::Action::Mark(mark))).await?;
    }
    sequence += 1;
    send(&say, command(sequence, None, pb::command::Action::Release(pb::Release {}))).await?;
    while let Some(sample) = next_sample(&mut touch).await? {
        if sample.tools.first().is_some_and(|tool| tool.acknowledged_sequence >= sequence) {
            break;
        }
    }
    Ok(TraineeWork { presses, marks_m })
}

/// Steps by which commands are sent ahead of their time.
const LEAD_STEPS: u64 = 400;

fn command(sequence: u64, at_step: Option<u64>, action: pb::command::Action) -> pb::Command {
    pb::Command { tool: 0, sequence: Some(sequence), at_step, action: Some(action), ..Default::default() }
}

async fn send(say: &tokio::sync::mpsc::Sender<Say>, command: pb::Command) -> Result<(), Status> {
    say.send(Say::Command(command)).await.map_err(|_| Status::unavailable("the stream has ended"))
}

/// Returns the next sample; `None` at the end of the stream.
async fn next_sample(touch: &mut Touch) -> Result<Option<pb::Sample>, Status> {
    loop {
        match touch.next().await? {
            Some(Heard::Sample(sample)) => return Ok(Some(sample)),
            Some(Heard::Rejection(rejection)) => return Err(Status::aborted(rejection.message)),
            Some(_) => {}
            None => return Ok(None),
        }
    }
}

/// Returns places in rows over the top of a box, each row in the other direction than the one before.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn rows(least_m: pb::Vector3, most_m: pb::Vector3, spacing_m: f64) -> Vec<DVec3> {
    let along = |least: f64, most: f64| -> Vec<f64> {
        let length_m = (most - least - 2.0 * MARGIN_M).max(0.0);
        let gaps = (length_m / spacing_m).round().max(1.0);
        (0..=gaps as u32).map(|number| least + MARGIN_M + length_m * f64::from(number) / gaps).collect()
    };
    let (xs, ys) = (along(least_m.x, most_m.x), along(least_m.y, most_m.y));
    let mut places = Vec::new();
    for (row, y) in ys.iter().enumerate() {
        let place = |x: &f64| DVec3::new(*x, *y, most_m.z);
        if row % 2 == 0 { places.extend(xs.iter().map(place)) } else { places.extend(xs.iter().rev().map(place)) }
    }
    places
}

/// Returns the presses, and the poses of the tool with their steps. Movements have the least jerk.
#[allow(clippy::cast_precision_loss)]
fn plan(
    places: &[DVec3],
    top_m: f64,
    manner: &Manner,
    from: u64,
    random: &mut Random,
) -> (Vec<PlannedPress>, VecDeque<(u64, DVec3)>) {
    let (mut step, mut poses, mut planned) = (from, VecDeque::new(), Vec::new());
    let Some(first) = places.first() else { return (planned, poses) };
    let mut at_m = DVec3::new(first.x, first.y, top_m + HEIGHT_M);
    for place_m in places {
        let above_m = DVec3::new(place_m.x, place_m.y, top_m + HEIGHT_M);
        let depth_m = (manner.depth_m + manner.unsteady_m * random.normal()).max(0.0);
        let below_m = DVec3::new(place_m.x, place_m.y, top_m - depth_m);
        let begin = step;
        for (to_m, steps) in [above_m, below_m, below_m, above_m].into_iter().zip(manner.steps) {
            for number in 1..=steps {
                let x = number as f64 / steps as f64;
                let part = x * x * x * (10.0 + x * (6.0 * x - 15.0));
                poses.push_back((step, at_m.lerp(to_m, part)));
                step += 1;
            }
            at_m = to_m;
        }
        planned.push(PlannedPress { place_m: *place_m, steps: [begin, step] });
    }
    (planned, poses)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

/// Returns how much stiffer each press felt than those that mirror it, smoothed over its neighbours. A press that few others mirror is
/// compared with its neighbours.
fn contrasts(presses: &[FeltPress], middle_m: DVec3, spacing_m: f64) -> Vec<f64> {
    let from_edges = |press: &FeltPress| {
        let away_m = (press.place_m - middle_m).abs();
        DVec3::new(away_m.x.min(away_m.y), away_m.x.max(away_m.y), 0.0)
    };
    let mirrors = |one: &FeltPress, other: &FeltPress| from_edges(one).distance(from_edges(other)) < 0.1 * spacing_m;
    let is_beside = |one: &FeltPress, other: &FeltPress, reach: f64| {
        one != other && one.place_m.distance(other.place_m) < reach * spacing_m
    };
    let forces = |chosen: &dyn Fn(&FeltPress) -> bool| -> Vec<f64> {
        presses.iter().filter(|press| chosen(press)).map(|press| press.force_n).collect()
    };
    let contrast = |press: &FeltPress| {
        let mut alike = forces(&|other| mirrors(press, other));
        if alike.len() < 4 {
            alike = forces(&|other| is_beside(press, other, 1.5));
        }
        press.force_n / median(alike).max(f64::MIN_POSITIVE) - 1.0
    };
    let each: Vec<f64> = presses.iter().map(contrast).collect();
    let smoothed = |(press, own): (&FeltPress, &f64)| {
        let near = presses.iter().zip(&each).filter(|(other, _)| is_beside(press, other, 1.1));
        let (sum, count) = near.fold((0.0, 0.0), |(sum, count), (_, contrast)| (sum + contrast, count + 1.0));
        0.5 * own + 0.5 * sum / f64::max(count, 1.0)
    };
    presses.iter().zip(&each).map(smoothed).collect()
}

/// Returns the places that felt stiffer than others, the stiffest first.
fn decided(presses: &[FeltPress], middle_m: DVec3, spacing_m: f64, random: &mut Random) -> Vec<DVec3> {
    let feel =
        |press: &FeltPress| FeltPress { force_n: (press.force_n + NOISE_N * random.normal()).max(0.0), ..*press };
    let felt: Vec<FeltPress> = presses.iter().map(feel).collect();
    let contrasts = contrasts(&felt, middle_m, spacing_m);
    let mut order: Vec<usize> = (0..felt.len()).collect();
    order.sort_by(|one, other| contrasts[*other].total_cmp(&contrasts[*one]));
    let mut marks_m: Vec<DVec3> = Vec::new();
    let mut peaks_m: Vec<DVec3> = Vec::new();
    for index in order.into_iter().filter(|index| contrasts[*index] > THRESHOLD) {
        let peak_m = felt[index].place_m;
        if marks_m.len() == MAX_MARKS || peaks_m.iter().any(|other_m| other_m.distance(peak_m) < APART_M) {
            continue;
        }
        peaks_m.push(peak_m);
        // In the middle of what felt stiff around the stiffest place.
        let near = felt.iter().zip(&contrasts).filter(|(press, _)| press.place_m.distance(peak_m) < 1.5 * spacing_m);
        let (sum_m, weight) = near.fold((DVec3::ZERO, 0.0), |(sum_m, weight), (press, contrast)| {
            (sum_m + contrast.max(0.0) * press.place_m, weight + contrast.max(0.0))
        });
        marks_m.push(sum_m / weight);
    }
    marks_m
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stiff_place_is_marked_and_an_even_block_is_not() {
        let corner = |m: f64| pb::Vector3 { x: m, y: m, z: 0.04 };
        let places = rows(corner(-0.05), corner(0.05), 0.01);
        assert_eq!(places.len(), 81);
        let press = |lump_m: Option<DVec3>| {
            let force_n = |place_m: &DVec3| {
                let away = place_m.abs().max_element() / 0.04;
                let stiffer = lump_m.map_or(0.0, |lump_m| 0.1 * (-(place_m.distance(lump_m) / 0.008).powi(2)).exp());
                2.0 * (1.0 - 0.2 * away * away) * (1.0 + stiffer)
            };
            places.iter().map(|place_m| FeltPress { place_m: *place_m, force_n: force_n(place_m) }).collect::<Vec<_>>()
        };
        let middle_m = DVec3::new(0.0, 0.0, 0.04);
        assert!(decided(&press(None), middle_m, 0.01, &mut Random::new(1, 0)).is_empty());
        let lump_m = DVec3::new(0.013, -0.022, 0.04);
        let marks_m = decided(&press(Some(lump_m)), middle_m, 0.01, &mut Random::new(1, 0));
        assert!(marks_m.len() == 1 && marks_m[0].distance(lump_m) < 0.005, "{marks_m:?}");
    }
}
