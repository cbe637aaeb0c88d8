//! Plan of a load test: phases with arrivals of users, the properties of the users, and the objectives.

use std::path::Path;

use palpate_haptics::Device;
use palpate_haptics::device::{DEVICES, UNDECLARED};
use palpate_haptics::hand::{HANDS, Hand};
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_tissue::files::read_text;
use palpate_tissue::scene::toml_document::{Document, Fields, Item};

use super::led_instrument::InstrumentKind;
use super::objective::Objective;
use super::tip::{Deadbands, Lead, default_device};
use crate::network::Conditions;
use crate::random::Random;

/// Largest plan, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Largest number of users of a plan; a plan with more is refused.
const MAX_USERS: usize = 10_000;

/// Time for which a user stays without another value, s: longer than any trial.
pub(crate) const STAYS_S: f64 = 86_400.0;

/// The name that stands for no script in a list of scripts.
pub(crate) const NO_SCRIPT: &str = "none";

/// Largest number of entries of a list; a longer list is refused.
const MAX_ENTRIES: usize = 64;

/// One of several alternatives, with its relative frequency.
#[derive(Debug, Clone)]
pub(crate) struct Share<T> {
    share: f64,
    pub(crate) what: T,
}

/// Returns a list of one alternative, which every user gets.
pub(crate) fn only<T>(what: T) -> Vec<Share<T>> {
    vec![Share { share: 1.0, what }]
}

/// Draws the index of one of several alternatives, by their shares.
fn draw<T>(parts: &[Share<T>], random: &mut Random) -> usize {
    let mut left = random.between(0.0, parts.iter().map(|part| part.share).sum());
    let found = parts.iter().position(|part| {
        left -= part.share;
        left < 0.0
    });
    // A part without a share is never taken, even after rounding.
    found.or_else(|| parts.iter().rposition(|part| part.share > 0.0)).unwrap_or(0)
}

/// A simulated network between users and the server.
#[derive(Debug, Clone)]
pub(crate) struct Wire {
    pub(crate) name: String,
    /// Conditions of the network; `None`: users reach the server directly.
    pub(crate) conditions: Option<Conditions>,
}

impl Wire {
    pub(crate) fn direct() -> Self {
        Wire { name: "direct".to_owned(), conditions: None }
    }
}

/// Viewers of a session.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Viewers {
    pub(crate) number: u32,
    pub(crate) rate_hz: f64,
}

/// Pattern of the arrivals of users.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Arrivals {
    /// Users arrive at even intervals. Contains users per second.
    Steady(f64),
    /// Users arrive at random. Contains the mean number of users per second.
    Poisson(f64),
    /// This many users arrive at once.
    Spike(u32),
    /// This many users arrive at even intervals before the clock of the plan starts: it waits until all are
    /// connected. A refusal of one ends the load test.
    Gathering { users: u32, over_s: f64 },
    /// No user arrives; present users stay.
    None,
}

/// One phase of a plan.
#[derive(Debug, Clone)]
pub(crate) struct Phase {
    pub(crate) name: String,
    pub(crate) seconds: f64,
    pub(crate) arrivals: Arrivals,
    /// Time for which a user stays, s; with random arrivals on average.
    pub(crate) stays_s: f64,
    pub(crate) objective: Option<Objective>,
}

/// Plan of a load test: phases in which users arrive, the properties of the users, and objectives.
///
/// Four users a second arrive for 10 s, and each stays for 5 s. A share below 0 is refused, with its line:
///
/// ```
/// use palpate_refusal::Reason;
/// use palpate_simulated::load::LoadPlan;
///
/// let text = "[[phase]]\nname = \"busy\"\nseconds = 10\narrivals = \"steady\"\nrate_per_s = 4\nstays_s = 5\n";
/// LoadPlan::parse("plan.toml", text)?;
///
/// let wrong = format!("{text}[[scene]]\nname = \"paper\"\nshare = -1\n");
/// let refusal = LoadPlan::parse("plan.toml", &wrong).expect_err("no share is below 0");
/// assert_eq!((refusal.reason, refusal.place.as_deref()), (Reason::OutOfRange, Some("plan.toml:9")));
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
#[derive(Debug, Clone)]
pub struct LoadPlan {
    pub(crate) name: String,
    pub(crate) seed: u64,
    /// Commands per second of each client.
    pub(crate) rate_hz: f64,
    /// Clients of each user, with one tool each. With 0, commands sent beforehand keep the session awake.
    pub(crate) clients_per_user: u32,
    /// Clients that share a connection.
    pub(crate) clients_per_connection: u32,
    /// Threads of this generator.
    pub(crate) threads: u32,
    pub(crate) scenes: Vec<Share<String>>,
    /// Alternatives of what leads the tools; `None`: forces push the tissue along a stroke.
    pub(crate) leads: Vec<Share<Option<Lead>>>,
    pub(crate) wires: Vec<Share<Wire>>,
    /// Scripts of the server that are played in the sessions, again and again; `None`: nothing is.
    pub(crate) scripts: Vec<Share<Option<String>>>,
    pub(crate) viewers: Vec<Share<Viewers>>,
    pub(crate) phases: Vec<Phase>,
    /// Objective of the whole plan.
    pub(crate) objective: Option<Objective>,
}

/// One user: a session of its own, with its clients and viewers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct User {
    /// Time of arrival since the plan began, s.
    pub(crate) at_s: f64,
    pub(crate) stays_s: f64,
    // Indices in the lists of the plan.
    pub(crate) scene: usize,
    pub(crate) lead: usize,
    pub(crate) wire: usize,
    pub(crate) script: usize,
    pub(crate) viewers: usize,
    /// Seed of the movements of its hand.
    pub(crate) seed: u64,
}

impl LoadPlan {
    /// Reads a plan from a file in TOML. The scene files that it names are not read ([`super::PreparedPlan::new`]).
    ///
    /// # Errors
    /// Refuses a file that can't be read or has more than 1 MiB; otherwise returns the refusals of
    /// [`LoadPlan::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        LoadPlan::parse(&path.display().to_string(), &read_text(path, MAX_BYTES)?)
    }

    /// Parses a plan from a text in TOML. Refusals name the text `name`.
    ///
    /// # Errors
    /// Refuses, with line and key, a text that is not TOML, unknown and missing keys, values of another type or out
    /// of range, a list of more than 64 entries or without a share above 0, and a plan without a phase; and a plan in
    /// which more than 10 000 users would arrive.
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        let document = Document::parse(name, text)?;
        let plan = document.read(plan)?;
        if plan.users().len() > MAX_USERS {
            return Err(document.locate(Refusal::new(
                Reason::TooLarge,
                "phase",
                format!("more than {MAX_USERS} users would arrive: lower the rates, or shorten the phases"),
            )));
        }
        Ok(plan)
    }

    /// Returns the duration of all phases together, s.
    pub(crate) fn lasts_s(&self) -> f64 {
        self.phases.iter().map(|phase| phase.seconds).sum()
    }

    /// Returns the time over which users arrive before the clock starts, s; `None` if the clock waits for no users.
    pub(crate) fn gathers_over_s(&self) -> Option<f64> {
        self.phases.iter().find_map(|phase| match phase.arrivals {
            Arrivals::Gathering { over_s, .. } => Some(over_s),
            _ => None,
        })
    }

    /// Returns all users by arrival, the same for the same plan. The list has at most one more than [`MAX_USERS`].
    pub(crate) fn users(&self) -> Vec<User> {
        let [mut times, mut mix, mut played] = [1, 2, 3].map(|stream| Random::new(self.seed, stream));
        let (mut users, mut from_s) = (Vec::new(), 0.0);
        for phase in &self.phases {
            let (seconds, stays_s, mut at_s) = (phase.seconds, phase.stays_s, 0.0);
            let room = (MAX_USERS + 1).saturating_sub(users.len());
            let moments: Vec<(f64, f64)> = match phase.arrivals {
                Arrivals::Steady(rate) => std::iter::from_fn(|| {
                    let moment = (at_s, stays_s);
                    at_s += 1.0 / rate;
                    (moment.0 < seconds).then_some(moment)
                })
                .take(room)
                .collect(),
                Arrivals::Poisson(rate) => std::iter::from_fn(|| {
                    let mut waits = || -(1.0 - times.between(0.0, 1.0)).ln();
                    at_s += waits() / rate;
                    (at_s < seconds).then(|| (at_s, stays_s * waits()))
                })
                .take(room)
                .collect(),
                Arrivals::Spike(number) => vec![(0.0, stays_s); number as usize],
                Arrivals::Gathering { users, over_s } => {
                    (0..users).map(|user| (over_s * f64::from(user) / f64::from(users), stays_s)).collect()
                }
                Arrivals::None => Vec::new(),
            };
            for (at_s, stays_s) in moments {
                let (at_s, seed) = (from_s + at_s, self.seed.wrapping_add(users.len() as u64));
                let (scene, lead) = (draw(&self.scenes, &mut mix), draw(&self.leads, &mut mix));
                let (wire, viewers) = (draw(&self.wires, &mut mix), draw(&self.viewers, &mut mix));
                let script = draw(&self.scripts, &mut played);
                users.push(User { at_s, stays_s, scene, lead, wire, script, viewers, seed });
            }
            from_s += phase.seconds;
        }
        users
    }
}

/// Returns a number within a range, if present.
fn within(fields: &mut Fields<'_>, key: &'static str, range: &str, least: f64, most: f64) -> Result<Option<f64>> {
    let Some(value) = fields.number(key)? else { return Ok(None) };
    number(&fields.path(key), value, range, |value| (least..=most).contains(&value)).map(Some)
}

fn share(fields: &mut Fields<'_>) -> Result<f64> {
    Ok(within(fields, "share", "from 0 to 1000000", 0.0, 1e6)?.unwrap_or(1.0))
}

/// Returns a whole number up to a limit.
fn count(item: &Item<'_>, most: u32) -> Result<u32> {
    let whole = item.whole()?;
    u32::try_from(whole)
        .ok()
        .filter(|count| *count <= most)
        .ok_or_else(|| item.refuse(Reason::OutOfRange, format!("must be at most {most}, but is {whole}")))
}

fn objective(fields: &mut Fields<'_>) -> Result<Option<Objective>> {
    let Some(item) = fields.item("objective") else { return Ok(None) };
    let text = item.text()?;
    text.parse().map(Some).map_err(|why: String| item.refuse(Reason::WrongKind, why))
}

/// Returns a list of tables with shares; `instead` alone if there is none.
fn parts<T>(
    fields: &mut Fields<'_>,
    key: &'static str,
    instead: T,
    read: impl Fn(&mut Fields<'_>) -> Result<T>,
) -> Result<Vec<Share<T>>> {
    let Some(item) = fields.item(key) else { return Ok(only(instead)) };
    let tables = item.tables()?;
    if tables.len() > MAX_ENTRIES {
        return Err(item.refuse(Reason::TooLarge, format!("has more than {MAX_ENTRIES} entries")));
    }
    let entry = |table: &Item<'_>| table.table(|fields| Ok(Share { share: share(fields)?, what: read(fields)? }));
    let parts = tables.iter().map(entry).collect::<Result<Vec<_>>>()?;
    if parts.iter().all(|part| part.share <= 0.0) {
        return Err(item.refuse(Reason::OutOfRange, "needs at least one entry with a share above 0"));
    }
    Ok(parts)
}

fn plan(fields: &mut Fields<'_>) -> Result<LoadPlan> {
    let name = fields.text("name")?.unwrap_or_else(|| "load".to_owned());
    let seed = fields.item("seed").map_or(Ok(1), |item| item.whole())?;
    let rate_hz = within(fields, "rate_hz", "from 1 to 4000", 1.0, 4000.0)?.unwrap_or(1000.0);
    let scenes = parts(fields, "scene", "liver".to_owned(), |fields| fields.required("name")?.text())?;
    let leads = parts(fields, "hand", None, lead)?;
    let wires = parts(fields, "network", Wire::direct(), wire)?;
    let scripts = parts(fields, "script", None, |fields| {
        let name = fields.required("name")?.text()?;
        Ok((name != NO_SCRIPT).then_some(name))
    })?;
    let viewers = parts(fields, "viewers", Viewers { number: 0, rate_hz: 60.0 }, |fields| {
        let number = count(&fields.required("number")?, 16)?;
        let rate_hz = within(fields, "rate_hz", "from 0.1 to 1000", 0.1, 1000.0)?.unwrap_or(60.0);
        Ok(Viewers { number, rate_hz })
    })?;
    let objective = objective(fields)?;
    let item = fields.required("phase")?;
    let tables = item.tables()?;
    if tables.is_empty() || tables.len() > MAX_ENTRIES {
        return Err(item.refuse(Reason::OutOfRange, format!("needs 1 to {MAX_ENTRIES} entries")));
    }
    let phases = tables.iter().enumerate().map(|(index, table)| table.table(|fields| phase(fields, index)));
    let phases = phases.collect::<Result<Vec<_>>>()?;
    let (clients_per_user, clients_per_connection, threads) = (1, 1, 1);
    Ok(LoadPlan {
        name,
        seed,
        rate_hz,
        clients_per_user,
        clients_per_connection,
        threads,
        scenes,
        leads,
        wires,
        scripts,
        viewers,
        phases,
        objective,
    })
}

/// Returns names in quotation marks, separated by commas.
fn quoted<'n>(names: impl Iterator<Item = &'n str>) -> String {
    let names: Vec<String> = names.map(|name| format!("\"{name}\"")).collect();
    names.join(", ")
}

fn lead(fields: &mut Fields<'_>) -> Result<Option<Lead>> {
    let item = fields.required("hand")?;
    let name = item.text()?;
    let hand = Hand::named(&name);
    if hand.is_none() && name != "push" {
        return Err(item.wrong(&format!("one of \"push\", {}", quoted(HANDS.iter().map(|hand| hand.name)))));
    }
    let item = fields.item("device");
    let device = item.as_ref().map(|item| {
        let found = item
            .as_text()
            .and_then(|name| if name == UNDECLARED.name { Some(UNDECLARED) } else { Device::named(name) });
        let names = DEVICES.iter().map(|device| device.name).chain([UNDECLARED.name]);
        found.ok_or_else(|| item.wrong(&format!("one of {}", quoted(names))))
    });
    let device = device.transpose()?;
    let fraction = |fields: &mut Fields<'_>, key| within(fields, key, "from 0 to 1", 0.0, 1.0);
    let (down, up) = (fraction(fields, "deadband")?, fraction(fields, "up_deadband")?);
    let item = fields.item("instrument");
    let instrument = item.as_ref().map(|item| {
        let name = item.as_text().unwrap_or_default();
        let found = InstrumentKind::ALL.iter().find(|kind| kind.1 == name);
        found.map(|kind| kind.0).ok_or_else(|| {
            item.wrong(&format!("one of {}", quoted(InstrumentKind::ALL.map(|kind| kind.1).into_iter())))
        })
    });
    let instrument = instrument.transpose()?;
    let given = [
        ("device", device.is_some()),
        ("deadband", down.is_some()),
        ("up_deadband", up.is_some()),
        ("instrument", instrument.is_some()),
    ];
    let Some(hand) = hand else {
        return match given.iter().find(|key| key.1) {
            Some((key, _)) => {
                Err(fields.refuse(Reason::WrongKind, key, "is for a hand: this one pushes, and feels nothing"))
            }
            None => Ok(None),
        };
    };
    if let Some((key, _)) = given[..3].iter().find(|key| key.1 && instrument.is_some()) {
        return Err(fields.refuse(Reason::WrongKind, key, "is for a hand without an instrument: that renders nothing"));
    }
    let deadbands = Deadbands { down: down.unwrap_or(0.0), up: up.unwrap_or(0.0) };
    Ok(Some(Lead { deadbands, device: device.unwrap_or_else(default_device), hand: Some(hand), instrument }))
}

fn wire(fields: &mut Fields<'_>) -> Result<Wire> {
    let name = fields.required("name")?.text()?;
    let mut part = |key, range: &str, least: f64, most: f64| within(fields, key, range, least, most);
    let delay_ms = part("delay_ms", "from 0 to 10000", 0.0, 1e4)?;
    let jitter_ms = part("jitter_ms", "from 0 to 10000", 0.0, 1e4)?;
    let loss = part("loss", "from 0 to 0.5", 0.0, 0.5)?;
    let burst = part("loss_burst", "from 1 to 1000", 1.0, 1e3)?;
    let outage_ms = part("outage_ms", "from 0 to 900", 0.0, 900.0)?;
    let is_direct = [delay_ms, jitter_ms, loss, burst, outage_ms].iter().all(Option::is_none);
    let conditions = Conditions {
        round_trip_s: 2e-3 * delay_ms.unwrap_or(0.0),
        jitter_s: 1e-3 * jitter_ms.unwrap_or(0.0),
        loss: loss.unwrap_or(0.0),
        burst: burst.unwrap_or(1.0),
        outage_s: 1e-3 * outage_ms.unwrap_or(0.0),
        ..Conditions::default()
    };
    Ok(Wire { name, conditions: (!is_direct).then_some(conditions) })
}

fn phase(fields: &mut Fields<'_>, index: usize) -> Result<Phase> {
    let name = fields.text("name")?.unwrap_or_else(|| format!("phase {}", index + 1));
    let item = fields.required("seconds")?;
    let seconds = number("seconds", item.number()?, "from 0.5 to 86400", |value| (0.5..=86_400.0).contains(&value));
    let seconds = seconds.map_err(|refusal| Refusal { field: fields.path("seconds"), ..refusal })?;
    let item = fields.item("arrivals");
    let kind = item.as_ref().map_or("none", |item| item.as_text().unwrap_or_default());
    let rate = within(fields, "rate_per_s", "from 0.001 to 1000", 0.001, 1000.0)?;
    let users = fields.item("users").map(|item| count(&item, 10_000)).transpose()?;
    let needs = |fields: &Fields<'_>, key, value: Option<f64>| {
        value.ok_or_else(|| fields.refuse(Reason::Missing, key, format!("is missing: arrivals are `{kind}`")))
    };
    let arrivals = match (kind, &item) {
        ("steady", _) => Arrivals::Steady(needs(fields, "rate_per_s", rate)?),
        ("poisson", _) => Arrivals::Poisson(needs(fields, "rate_per_s", rate)?),
        ("spike", _) => {
            needs(fields, "users", users.map(f64::from))?;
            Arrivals::Spike(users.unwrap_or(0))
        }
        ("none", _) | (_, None) => Arrivals::None,
        (_, Some(item)) => return Err(item.wrong("one of \"steady\", \"poisson\", \"spike\", \"none\"")),
    };
    let useless = match arrivals {
        Arrivals::Steady(_) | Arrivals::Poisson(_) => users.map(|_| "users"),
        Arrivals::Spike(_) => rate.map(|_| "rate_per_s"),
        Arrivals::None | Arrivals::Gathering { .. } => users.map(|_| "users").or(rate.map(|_| "rate_per_s")),
    };
    if let Some(key) = useless {
        return Err(fields.refuse(Reason::WrongKind, key, format!("has no meaning where arrivals are `{kind}`")));
    }
    let stays_s = within(fields, "stays_s", "from 0.1 to 86400", 0.1, 86_400.0)?.unwrap_or(STAYS_S);
    let objective = objective(fields)?;
    Ok(Phase { name, seconds, arrivals, stays_s, objective })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const PLAN: &str = r#"
name = "a morning"
seed = 3
objective = "p99<1s"
[[scene]]
name = "liver"
share = 3
[[scene]]
name = "fibrotic"
[[hand]]
hand = "push"
[[hand]]
hand = "firm"
device = "touch"
deadband = 0.1
[[network]]
name = "near"
[[network]]
name = "far"
delay_ms = 20
[[script]]
name = "none"
[[script]]
name = "suture"
[[viewers]]
number = 2
rate_hz = 30
[[phase]]
seconds = 10
arrivals = "steady"
rate_per_s = 4
stays_s = 3
[[phase]]
name = "noon"
seconds = 100
arrivals = "poisson"
rate_per_s = 5
stays_s = 2
[[phase]]
seconds = 2
arrivals = "spike"
users = 7
[[phase]]
seconds = 5
"#;

    #[test]
    fn a_plan_says_who_comes_when_and_says_it_again_the_same() {
        let plan = LoadPlan::parse("plan.toml", PLAN).unwrap();
        let users = plan.users();
        assert_eq!(users, LoadPlan::parse("plan.toml", PLAN).unwrap().users());
        assert!((plan.lasts_s() - 117.0).abs() < 1e-9 && users.is_sorted_by(|a, b| a.at_s <= b.at_s));
        let of = |from: f64, to: f64| users.iter().filter(|user| (from..to).contains(&user.at_s)).collect::<Vec<_>>();
        assert!(of(0.0, 10.0).len() == 40 && of(0.0, 10.0).iter().all(|user| user.stays_s == 3.0));
        // Five a second, each for 2 s on average: with four standard deviations to spare.
        let random = of(10.0, 110.0);
        let mean_s = random.iter().map(|user| user.stays_s).sum::<f64>() / random.len() as f64;
        assert!((410..590).contains(&random.len()) && (1.6..2.4).contains(&mean_s), "{} {mean_s}", random.len());
        assert!(of(110.0, 111.0).len() == 7 && of(112.0, 200.0).is_empty());
        // Three of four are in the first scene.
        let first = users.iter().filter(|user| user.scene == 0).count() as f64 / users.len() as f64;
        assert!((0.68..0.82).contains(&first), "{first}");
        let lead = plan.leads[1].what.unwrap();
        assert_eq!((lead.hand.unwrap().name, lead.device.name, lead.deadbands.down), ("firm", "touch", 0.1));
        assert_eq!(
            plan.scripts.iter().map(|script| script.what.as_deref()).collect::<Vec<_>>(),
            [None, Some("suture")]
        );
        let sewn = users.iter().filter(|user| user.script == 1).count() as f64 / users.len() as f64;
        assert!((0.4..0.6).contains(&sewn), "{sewn}");
        assert!(plan.wires[0].what.conditions.is_none());
        assert!((plan.wires[1].what.conditions.unwrap().round_trip_s - 0.04).abs() < 1e-12);
    }

    #[test]
    fn what_is_wrong_in_a_plan_is_named_by_line_and_key() {
        let phase = "[[phase]]\nseconds = 1\n";
        for (text, place, field, says) in [
            ("", ":1", "phase", "is missing"),
            ("phase = 3", ":1", "phase", "a list"),
            ("[[phase]]\nname = \"x\"", ":1", "phase[0].seconds", "is missing"),
            ("[[phase]]\nseconds = 0.1", ":2", "phase[0].seconds", "from 0.5"),
            ("[[phase]]\nseconds = 1\narrivals = \"stedy\"", ":3", "phase[0].arrivals", "steady"),
            ("[[phase]]\nseconds = 1\narrivals = \"steady\"", "", "phase[0].rate_per_s", "is missing"),
            ("[[phase]]\nseconds = 1\narrivals = \"spike\"", "", "phase[0].users", "is missing"),
            ("[[phase]]\nseconds = 1\nusers = 3", ":3", "phase[0].users", "no meaning"),
            ("[[phase]]\nseconds = 1\nsecond = 3", ":3", "phase[0].second", "unknown key"),
            ("[[phase]]\nseconds = 1\nobjective = \"p98<2ms\"", ":3", "phase[0].objective", "unknown quantity"),
            (&format!("{phase}[[hand]]\nhand = \"frim\""), ":4", "hand[0].hand", "firm"),
            (&format!("{phase}[[hand]]\nhand = \"firm\"\ndevice = \"omega\""), ":5", "hand[0].device", "omega3"),
            (&format!("{phase}[[hand]]\nhand = \"push\"\ndeadband = 0.1"), ":5", "hand[0].deadband", "feels nothing"),
            (&format!("{phase}[[hand]]\nhand = \"firm\"\ninstrument = \"saw\""), ":5", "hand[0].instrument", "grasper"),
            (
                &format!("{phase}[[hand]]\nhand = \"push\"\ninstrument = \"shaft\""),
                ":5",
                "hand[0].instrument",
                "feels nothing",
            ),
            (
                &format!("{phase}[[hand]]\nhand = \"firm\"\ninstrument = \"shaft\"\ndevice = \"omega3\""),
                ":6",
                "hand[0].device",
                "renders nothing",
            ),
            (&format!("{phase}[[network]]\nname = \"x\"\nloss = 2"), ":5", "network[0].loss", "from 0 to 0.5"),
            (&format!("{phase}[[network]]\nname = \"x\"\ndelay = 2"), ":5", "network[0].delay", "delay_ms"),
            (&format!("{phase}[[script]]\nshare = 1"), ":3", "script[0].name", "is missing"),
            (&format!("{phase}[[viewers]]\nnumber = 99"), ":4", "viewers[0].number", "at most 16"),
            (&format!("{phase}[[scene]]\nname = \"x\"\nshare = 0"), "", "scene", "share above 0"),
            ("[[phase]]\nseconds = 80000\narrivals = \"steady\"\nrate_per_s = 1", "", "phase", "10000 users"),
        ] {
            let refusal = LoadPlan::parse("plan.toml", text).unwrap_err();
            assert_eq!(refusal.field, field, "{text}: {refusal}");
            assert!(refusal.to_string().contains(says), "{text}: {refusal}");
            let found = refusal.place.as_deref().unwrap_or_default();
            assert!(found.starts_with("plan.toml:") && found.ends_with(place), "{text}: {refusal}");
        }
    }
}
