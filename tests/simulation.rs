//! Clients and a session in virtual time, over a network that delays, cuts off, and brings what two clients sent in
//! any order; clients crash and come back. The intake, the session and the queues are the server's own; threads and
//! sockets, which run by a real clock, are not in it (those are in tests/server/isolation.rs). Each seed is a course of its
//! own, and the same course each time.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::task::{Context, Poll, Waker};

use crate::common;
use crate::common::random::TestRandom;
use glam::DVec3;
use palpate_realtime::queue::{Reader, Writer, queue};
use palpate_refusal::Reason;
use palpate_session::command::Command;
use palpate_session::intake::Intake;
use palpate_session::lease::LeaseId;
use palpate_session::schedule::Schedule;
use palpate_session::{Sample, Session};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;

const MS: u64 = 1_000_000;
const STEPS: u64 = 1500;
const CLIENTS: usize = 4;
/// Fewer than clients: they compete.
const TOOLS: u64 = 3;
const LEASE_MS: u64 = 60;
const QUEUED_SAMPLES: usize = 8;

/// Messages of a client to the server.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Said {
    Acquire(u32, LeaseId),
    /// Sequence, and how deep, mm.
    Press(u32, LeaseId, u64, u64),
    Release(LeaseId),
}

/// On its way: when it arrives, whose turn it is then, in which order it was sent; from whom, and what.
type Message = (u64, usize, u64, usize, Said);

#[derive(Default)]
struct SimulatedClient {
    /// Tool and lease that it believes to hold.
    held: Option<(u32, LeaseId)>,
    sequence: u64,
    /// It is gone until then.
    crashed_until: u64,
    /// Nothing of it passes until then.
    cut_until: u64,
    /// Of one connection all arrives in order.
    last_arrival: u64,
    samples: Option<(Writer<Sample>, Reader<Sample>)>,
    last_step: u64,
    dropped: u64,
}

#[derive(Debug, Default, PartialEq)]
struct ClientHistory {
    hash: u128,
    accepted: u64,
    refused: BTreeMap<&'static str, u64>,
    seen: u64,
    dropped: u64,
    expired: u64,
}

fn poll<T>(reader: &mut Reader<T>) -> Option<(T, u64)> {
    let mut pop = std::pin::pin!(reader.pop());
    match pop.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(Ok(item)) => Some(item),
        _ => None,
    }
}

fn course(seed: u64) -> ClientHistory {
    let mut random = TestRandom(seed);
    let limits = Limits { queued_commands_per_tool: 16, ..Limits::default() };
    let scene = common::scene(common::SMALL);
    let (mut session, mut intake) = (Session::new(&common::model(&scene)), Intake::new(&scene, &limits));
    let mut clients: Vec<SimulatedClient> = (0..CLIENTS).map(|_| SimulatedClient::default()).collect();
    // By when it arrives, earliest first; of the same moment one client's before another's, and another time after it.
    let mut network: BinaryHeap<Reverse<Message>> = BinaryHeap::new();
    let mut serial = 0;
    let mut found = ClientHistory::default();
    let (mut submitted, mut refused, mut due, mut leases) = (0, 0, Vec::new(), 0_u128);
    // Of each tool, the last word of its holder that was taken in.
    let mut last_word: BTreeMap<u32, u64> = BTreeMap::new();
    let schedule = Schedule::new(0, 0, scene.stepping.rate_hz);
    for step in 0..STEPS {
        let now = step * MS;
        for (number, client) in clients.iter_mut().enumerate() {
            if client.crashed_until > step {
                continue;
            }
            match random.below(1000) {
                0..=2 => {
                    // All it knew is gone, and what it had under way still arrives.
                    *client = SimulatedClient { crashed_until: step + random.below(200), ..SimulatedClient::default() };
                    client.last_arrival = step;
                    continue;
                }
                3..=5 => client.cut_until = step + random.below(150),
                _ => {}
            }
            let said = match client.held {
                None if random.below(10) == 0 => {
                    leases += 1;
                    let tool = random.below(TOOLS) as u32;
                    client.held = Some((tool, leases));
                    (client.samples, client.dropped) = (Some(queue(QUEUED_SAMPLES)), 0);
                    Said::Acquire(tool, leases)
                }
                None => continue,
                Some((_, lease)) if random.below(200) == 0 => {
                    client.held = None;
                    Said::Release(lease)
                }
                Some((tool, lease)) => {
                    client.sequence += 1;
                    Said::Press(tool, lease, client.sequence, random.below(30))
                }
            };
            let delay = 1 + random.below(4) + if random.below(50) == 0 { random.below(40) } else { 0 };
            client.last_arrival = client.last_arrival.max(client.cut_until).max(step + delay);
            serial += 1;
            let turn = (number + client.last_arrival as usize) % CLIENTS;
            network.push(Reverse((client.last_arrival, turn, serial, number, said)));
        }
        while network.peek().is_some_and(|next| next.0.0 <= step) {
            let Reverse((_, _, _, number, said)) = network.pop().unwrap();
            let told = match said {
                Said::Acquire(tool, lease) => {
                    let taken = intake.acquire(&[tool], "client", LEASE_MS as f64 * 1e-3, lease, now);
                    assert!(intake.tools_of(lease).count() <= 1);
                    taken
                }
                Said::Release(lease) => intake.release(lease),
                Said::Press(tool, lease, sequence, deep_mm) => {
                    submitted += 1;
                    let point = scene.sheet().unwrap().point([tool as usize + 1, 2]);
                    let depth_m = DVec3::new(0.0, 0.0, -1e-3 * deep_mm as f64);
                    // Places supersede each other, forces all act: each tool on a point of its own, and nowhere else.
                    let action = if deep_mm % 2 == 0 {
                        Action::Grasp { point, displacement_m: depth_m }
                    } else {
                        let falloff_per_m = 100.0 / scene.sheet().unwrap().spacing_m;
                        let centre_m = scene.shape().rest_m(point);
                        Action::Push(Poke {
                            point: None,
                            centre_m,
                            force_n: 10.0 * depth_m,
                            falloff_per_m,
                            falloff_offset: 0.0,
                        })
                    };
                    let (sequence, at_step, time_to_live_s, client_time_ns) = (Some(sequence), None, None, 0);
                    let command = Command {
                        tool,
                        sequence,
                        client_time_ns,
                        by_datagram: false,
                        at_step,
                        time_to_live_s,
                        action,
                        arrival_ns: now,
                    };
                    let taken = intake.submit(lease, vec![command], now);
                    refused += u64::from(taken.is_err());
                    if taken.is_ok() {
                        last_word.insert(tool, step);
                    }
                    taken
                }
            };
            if let Err(refusal) = told {
                let known = [Reason::ToolHeld, Reason::NotHolder, Reason::StaleSequence, Reason::QueueFull];
                assert!(known.contains(&refusal.reason), "{refusal:?}");
                *found.refused.entry(refusal.reason.as_str()).or_default() += 1;
                // It no longer assumes that it holds a tool.
                if refusal.reason != Reason::QueueFull && clients[number].cut_until <= step {
                    clients[number].held = None;
                }
            }
        }
        intake.take_due(step, now, &mut due);
        session.advance(&mut due, |_| {});
        intake.rest(session.step_count(), session.step_count(), &schedule);
        assert_eq!(session.fault(), None, "seed {seed}, step {step}");

        // Every arrival is counted, and no queue exceeds its bound.
        let counts = intake.counts();
        assert_eq!(counts.accepted + refused, submitted, "seed {seed}, step {step}: {counts:?}");
        assert_eq!(counts.accepted, counts.applied + counts.superseded + counts.dropped + counts.waiting);
        assert!(counts.waiting <= TOOLS * limits.queued_commands_per_tool as u64);
        // One holder a tool; and one that says nothing holds it no longer than its lease.
        let held: Vec<u32> = intake.holders().map(|holder| holder.0).collect();
        assert!(held.windows(2).all(|pair| pair[0] < pair[1]), "{held:?}");
        let sample = session.sample(None);
        for tool in &sample.tools {
            assert!(tool.contact.is_none_or(|contact| contact.force_on_tool_n.is_finite()));
            let silent = step.saturating_sub(last_word.get(&tool.tool).copied().unwrap_or(0));
            if !held.contains(&tool.tool) || silent > LEASE_MS + 1 {
                let applied_n = tool.contact.map_or(0.0, |contact| contact.applied_force_n.length());
                assert!(applied_n < 1e-9, "seed {seed}, step {step}: {tool:?}");
            }
        }
        for client in &mut clients {
            let Some((writer, reader)) = &mut client.samples else { continue };
            writer.push(sample.clone());
            // Reads when it is there and feels like it.
            while client.crashed_until <= step && client.cut_until <= step && random.below(3) > 0 {
                let Some((sample, dropped)) = poll(reader) else { break };
                assert!(sample.step > client.last_step && dropped >= client.dropped);
                found.seen += 1;
                found.dropped += dropped - client.dropped;
                (client.last_step, client.dropped) = (sample.step, dropped);
            }
        }
    }
    found.accepted = intake.counts().accepted;
    found.expired = intake.expired();
    found.hash = session.tissue().state_hash();
    found
}

#[test]
fn whatever_the_network_does_all_is_accounted_for_and_no_tool_stays_held() {
    let mut all = ClientHistory::default();
    for seed in 0..60 {
        let found = course(seed);
        all.accepted += found.accepted;
        all.seen += found.seen;
        all.dropped += found.dropped;
        all.expired += found.expired;
        for (reason, count) in found.refused {
            *all.refused.entry(reason).or_default() += count;
        }
    }
    // The courses have seen what they were made for.
    assert!(all.accepted > 10_000 && all.seen > 10_000 && all.dropped > 0 && all.expired > 10, "{all:?}");
    assert!(all.refused["TOOL_HELD"] > 10 && all.refused["NOT_HOLDER"] > 10, "{all:?}");
}

#[test]
fn the_same_seed_is_the_same_course() {
    assert_eq!(course(7), course(7));
    assert_ne!(course(7).hash, course(8).hash);
}
