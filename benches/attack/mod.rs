//! Clients that are not friends: a table of what they do, and a thread for each that does it until it is called off.
//! `make bench-load` shows what each does to one honest client; `tests/server/siege.rs` mixes them.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::panic, clippy::disallowed_methods)]

mod bytes;
mod cpu;
mod datagrams;
mod legal;
mod memory;
mod meshes;
mod slots;
mod tools;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use futures_util::future::BoxFuture;
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::caller::{SIDE, TestCaller, TokenFile, why};
use crate::honest::Freezer;

/// The server, the attackers and the amounts of an attack.
pub struct Ground {
    /// The attackers.
    pub caller: TestCaller,
    /// A session of an honest client, whose id got about. It holds tool 0 there.
    pub shared: String,
    /// The server's process.
    pub process: u32,
    /// The file of tokens, which changes under attacks that need it to.
    pub keys: Arc<TokenFile>,
    /// The honest client itself, where an attack has it stand still.
    pub freezer: Option<Freezer>,
    /// Factor of all amounts: 1 is the full attack.
    pub scale: f64,
    pub seed: u64,
    strikes: AtomicU64,
    refusals: Mutex<BTreeMap<String, u64>>,
}

impl Ground {
    pub fn new(caller: TestCaller, shared: &str, process: u32, keys: &Arc<TokenFile>) -> Self {
        Ground {
            caller,
            shared: shared.to_owned(),
            process,
            keys: keys.clone(),
            freezer: None,
            scale: 1.0,
            seed: 0,
            strikes: AtomicU64::new(0),
            refusals: Mutex::default(),
        }
    }

    /// Returns a scaled number, at least one.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn count(&self, all: u32) -> u32 {
        ((f64::from(all) * self.scale) as u32).max(1)
    }

    /// The side of a square sheet: its points are scaled.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn side(&self, all: u32) -> u32 {
        ((f64::from(all) * self.scale.sqrt()) as u32).max(4)
    }

    /// Counts what was done.
    fn strike(&self) {
        self.strikes.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts what was refused, by reason; `None` of that.
    fn heard<T>(&self, answer: Result<T, Status>) -> Option<T> {
        let note = |status: Status| *self.refusals.lock().unwrap().entry(why(&status)).or_default() += 1;
        answer.map_err(note).ok()
    }
}

/// Does it for as long as it is let; fails if the server does not play.
type AttackFunction = for<'g> fn(&'g Ground) -> BoxFuture<'g, Result<(), Status>>;

/// An attack.
#[derive(Clone, Copy)]
pub struct AttackKind {
    pub name: &'static str,
    /// In one line.
    pub about: &'static str,
    pub run: AttackFunction,
    /// Tools of the honest client beside it.
    pub tools: u32,
    /// Of the honest client's way to the server and back, ms.
    pub round_trip_ms: u64,
    /// The attacker shows the honest client's own token.
    pub same_caller: bool,
    /// The server's file descriptors.
    pub descriptors: Option<u32>,
}

const fn kind(name: &'static str, about: &'static str, run: AttackFunction) -> AttackKind {
    AttackKind { name, about, run, tools: 1, round_trip_ms: 0, same_caller: false, descriptors: None }
}

/// All that is known, in the order of the points of what a server has to bear.
pub const KINDS: &[AttackKind] = &[
    // Work without end.
    kind("endless-scene", "scenes of four points that ask for 1 substep and need 2³²", |g| {
        Box::pin(cpu::endless_scene(g))
    }),
    kind("big-law", "force laws of a sheet of 331² with very weak anchor springs", |g| Box::pin(cpu::big_law(g))),
    // Somebody stands still.
    kind("stall-server", "the server stops for 5 s", |g| Box::pin(bytes::stall_server(g, 5.0))),
    AttackKind {
        round_trip_ms: 50,
        ..kind("stall-server-far", "the same, 50 ms away", |g| Box::pin(bytes::stall_server(g, 5.0)))
    },
    AttackKind {
        tools: 16,
        ..kind("stall-server-16", "the server stops for 1 s, with 16 tools", |g| Box::pin(bytes::stall_server(g, 1.0)))
    },
    AttackKind {
        tools: 16,
        round_trip_ms: 50,
        ..kind("stall-server-16-far", "the same, 50 ms away", |g| Box::pin(bytes::stall_server(g, 1.0)))
    },
    kind("stall-client", "the honest client stops for 5 s", |g| Box::pin(bytes::stall_client(g, 5.0))),
    AttackKind {
        round_trip_ms: 50,
        ..kind("stall-client-far", "the same, 50 ms away", |g| Box::pin(bytes::stall_client(g, 5.0)))
    },
    AttackKind {
        tools: 16,
        ..kind("stall-client-16", "the honest client stops for 1 s, with 16 tools", |g| {
            Box::pin(bytes::stall_client(g, 1.0))
        })
    },
    AttackKind {
        tools: 16,
        round_trip_ms: 50,
        ..kind("stall-client-16-far", "the same, 50 ms away", |g| Box::pin(bytes::stall_client(g, 1.0)))
    },
    // Work that one call causes on the server.
    kind("fixed-positions", "4096 positions per call to a sheet with 500,000 fixed points", |g| {
        Box::pin(cpu::fixed_positions(g))
    }),
    kind("empty-commands", "500,000 empty commands per call", |g| Box::pin(cpu::empty_commands(g))),
    // A token that is not one any more.
    kind(
        "revoked-unread",
        "commands with a revoked token, without reading (counted: accepted more than 2 s after the revocation)",
        |g| Box::pin(slots::revoked_unread(g)),
    ),
    // Memory.
    kind("tissue-changes", "changes of a tissue with 500,000 fixed points, for a step that never comes", |g| {
        Box::pin(memory::tissue_changes(g))
    }),
    kind("fixed-sessions", "sessions with 500,000 fixed points each", |g| Box::pin(memory::fixed_sessions(g))),
    kind("unread-viewers", "139 viewers of 186² at refinement 10 that read nothing", |g| {
        Box::pin(memory::unread_viewers(g))
    }),
    kind("waiting-commands", "64 tools with 4096 waiting commands each, in one session after the other", |g| {
        Box::pin(memory::waiting_commands(g))
    }),
    kind("thin-sheet", "a sheet of 4,194,304 × 1, all of it awake", |g| Box::pin(memory::thin_sheet(g))),
    // Cost of a request.
    kind("unread-probes", "20 probes of all points that nobody reads", |g| Box::pin(cpu::unread_probes(g, 20, SIDE))),
    AttackKind {
        same_caller: true,
        ..kind("unread-probes-same", "the same by the honest client's own token", |g| {
            Box::pin(cpu::unread_probes(g, 20, SIDE))
        })
    },
    kind("unread-probes-250", "250 such probes", |g| Box::pin(cpu::unread_probes(g, 250, SIDE))),
    kind("probe-2048", "a probe of all points of 2048²", |g| Box::pin(cpu::unread_probes(g, 1, g.side(2048)))),
    kind("heavy-poked", "a sheet of 2000², made at rest and then pushed everywhere", |g| {
        Box::pin(cpu::heavy_poked(g))
    }),
    kind("stiff-change", "a tissue that is changed to k = 10⁹ N/m and pushed", |g| Box::pin(cpu::stiff_change(g))),
    kind("woken-together", "400 resting sessions pushed at once", |g| Box::pin(cpu::woken_together(g))),
    kind("polling", "GetSession again and again while 262,144 commands wait", |g| Box::pin(cpu::polling(g))),
    kind("hash-1024", "the hash of a sheet of 1024², eight times a second", |g| Box::pin(cpu::hashes(g))),
    kind("page-gets", "GETs of the page without waiting for answers", |g| Box::pin(bytes::page_gets(g))),
    kind("flood-window-update", "WINDOW_UPDATE frames as fast as possible", |g| {
        Box::pin(bytes::frames(g, &bytes::WINDOW_UPDATE))
    }),
    kind("flood-priority", "PRIORITY frames as fast as possible", |g| Box::pin(bytes::frames(g, &bytes::PRIORITY))),
    kind("flood-ping", "PING frames as fast as possible", |g| Box::pin(bytes::frames(g, &bytes::PING))),
    kind("flood-settings", "SETTINGS frames as fast as possible", |g| Box::pin(bytes::frames(g, &bytes::SETTINGS))),
    kind("datagram-noise", "UDP packets of random bytes as fast as possible", |g| {
        Box::pin(datagrams::packets(g, false))
    }),
    kind("datagram-beginnings", "UDP packets that look like the first of a handshake, as fast as possible", |g| {
        Box::pin(datagrams::packets(g, true))
    }),
    kind("datagram-tickets", "datagram sessions with forged tickets, 32 at a time", |g| {
        Box::pin(datagrams::forged_tickets(g))
    }),
    kind("datagram-chatter", "a datagram session that sends a hundred times the allowed rate", |g| {
        Box::pin(datagrams::chatter(g))
    }),
    kind("stalled-viewer", "a viewer that asks for 1000 full frames a second and reads none", |g| {
        Box::pin(memory::stalled_viewer(g))
    }),
    kind("command-flood", "a client that sends 100 times as many commands", |g| Box::pin(cpu::command_flood(g))),
    kind("create-and-drop", "sessions made and dropped without end", |g| Box::pin(cpu::create_and_drop(g))),
    kind("legal-calls", "random legal calls to sessions of its own", |g| Box::pin(legal::calls(g))),
    // Cost of tools and meshes.
    kind("tip-strip", "64 tips of half of a sheet of 2000 × 1, again and again", |g| Box::pin(tools::strip(g, 2000))),
    kind("tip-strip-60000", "the same on 60,000 × 1", |g| Box::pin(tools::strip(g, 60_000))),
    kind("tips-organ", "64 tips of 25 mm that press a gallbladder and are released", |g| {
        Box::pin(tools::organ(g, "gallbladder", 0.025, false))
    }),
    kind("tips-organ-small", "64 tips of 5 mm that press a gallbladder and are released", |g| {
        Box::pin(tools::organ(g, "gallbladder", 0.005, false))
    }),
    kind("grasps-organ", "64 grasps of 5 mm that pull a liver", |g| Box::pin(tools::organ(g, "liver", 0.005, true))),
    kind("grasps-sheet", "64 grasps of 10 mm that pull at the same points of 60²", |g| Box::pin(tools::grasps(g, 60))),
    kind("touch-again", "64 tools that release a sheet and touch it again with another tip", |g| {
        Box::pin(tools::touch_again(g))
    }),
    kind("wide-pushes", "64 forces on all points of 100²", |g| Box::pin(tools::wide_pushes(g))),
    kind("mesh-hub", "meshes with two vertices that have 100,000 edges each, by two callers", |g| {
        Box::pin(meshes::hub(g, None))
    }),
    kind("mesh-hub-coarse", "the same with mesh.vertices = 500", |g| Box::pin(meshes::hub(g, Some(500)))),
    kind("mesh-nested", "4000 tetrahedra, each within the next", |g| Box::pin(meshes::nested(g, true))),
    kind("mesh-overlaid", "4000 tetrahedra in one place", |g| Box::pin(meshes::nested(g, false))),
    kind("mesh-unused", "20,000 vertices that no triangle uses", |g| Box::pin(meshes::unused_vertices(g))),
    kind("mesh-empty-accessor", "a glTF file of 300 bytes with 10,000,000 vertices", |g| {
        Box::pin(meshes::empty_accessor(g))
    }),
    // Attacks that lock out others.
    kind("watchers", "256 streams of samples of the honest client's session", |g| Box::pin(slots::watchers(g))),
    kind("kept-leases", "every other tool of the honest client's session taken for 600 s, then hung up", |g| {
        Box::pin(slots::kept_leases(g))
    }),
    kind("all-slots", "as many sessions as allowed", |g| Box::pin(slots::all_slots(g))),
    AttackKind {
        descriptors: Some(1024),
        ..kind("descriptors", "1500 connections without a token, to a server that may open 1024 files", |g| {
            Box::pin(slots::connections(g, bytes::GREETING))
        })
    },
    kind("half-open", "1000 connections that send nothing", |g| Box::pin(slots::connections(g, b""))),
];

/// The attack of that name.
pub fn named(name: &str) -> Option<&'static AttackKind> {
    KINDS.iter().find(|kind| kind.name == name)
}

/// Result of an attack.
#[derive(Default)]
pub struct Toll {
    pub strikes: u64,
    /// By reason.
    pub refusals: BTreeMap<String, u64>,
    /// Processor time of the attacker itself, s of a core.
    pub processor_s: f64,
}

/// An attack under way.
pub struct Attack {
    over: CancellationToken,
    thread: JoinHandle<Toll>,
}

impl Attack {
    pub fn start(run: AttackFunction, ground: Ground) -> Self {
        let over = CancellationToken::new();
        let thread = std::thread::spawn({
            let over = over.clone();
            move || {
                // The attacker shares a core with the measured clients; only the server's core counts.
                #[cfg(target_os = "linux")]
                rustix::process::setpriority_process(None, 19).unwrap();
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
                runtime.block_on(async {
                    while !over.is_cancelled() {
                        tokio::select! {
                            () = over.cancelled() => {}
                            // Open streams are dropped, and opened again.
                            done = run(&ground) => {
                                ground.heard(done);
                                tokio::time::sleep(Duration::from_millis(20)).await;
                            }
                        }
                    }
                });
                // With what the attack has left to itself.
                drop(runtime);
                let took = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
                #[allow(clippy::cast_precision_loss)]
                let processor_s = took.tv_sec as f64 + took.tv_nsec as f64 * 1e-9;
                Toll {
                    strikes: ground.strikes.into_inner(),
                    refusals: ground.refusals.into_inner().unwrap(),
                    processor_s,
                }
            }
        });
        Attack { over, thread }
    }

    /// Calls it off, and hangs up.
    pub fn end(self) -> Toll {
        self.over.cancel();
        self.thread.join().unwrap()
    }
}
