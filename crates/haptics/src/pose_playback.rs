//! Playback of a tool's path on the server: commands that arrive in bursts and gaps become a smooth movement.
//!
//! A client reports its tool's place and time a thousand times a second. If commands were played on arrival, a burst
//! would make the tool stop and then leap, and the tissue would respond to the leaps. So commands are played by their
//! own times: the played moment advances with the steps, stops when there is nothing newer, and catches up by a tenth
//! while something newer has always been available. With a constant delay this adds no latency.
//!
//! Old commands are never replayed: of a backlog of more than [`BACKLOG_S`] only the newest place counts, and the
//! tool moves there no faster than [`SPEED_M_PER_S`]. After [`RELEASE_S`] without a command the tool lets go. A
//! command without a time, or stamped with its step, takes effect at once, and the path does not wait for a
//! successor; but a tool never leaps.
//!
//! **Dead reckoning.** A command may contain the tool's velocity. Then its client sends the next one only when the
//! tool is not where this movement leads ([`crate::dead_reckoning`]), and over a gap the tool continues along it, for
//! at most [`EXTRAPOLATE_S`]. So the played moment need not stop when there is nothing newer. Instead it follows the
//! arrivals: it falls back by a tenth while commands arrive too late for it, and catches up as above.
//!
//! **Datagrams** may overtake each other and be lost. A place that arrives late fills its gap if it has not been
//! played; otherwise it is dropped ([`Path::fill`]).

use std::collections::VecDeque;

use glam::DVec3;

/// Largest speed at which a path moves a tool, m/s; a tool farther from its target follows at this speed.
pub const SPEED_M_PER_S: f64 = 0.5;
/// Length of the queue beyond which it is a backlog, s: only its newest place is then played.
pub const BACKLOG_S: f64 = 0.1;
/// Time without a command after which the tool is held in place and the client is informed, s.
pub const HOLD_S: f64 = 0.05;
/// Time without a command after which the tool lets go of the tissue, s. The next command begins a new touch.
pub const RELEASE_S: f64 = 0.25;
/// Longest time after a command with a velocity over which its movement is extrapolated, s; then the tool stays.
pub const EXTRAPOLATE_S: f64 = HOLD_S;
/// Lateness of commands with a velocity beyond which the played moment falls back, s.
const LATE_S: f64 = 0.002;
/// Fraction of a step by which the played moment catches up or falls back.
const CATCH_UP: f64 = 0.1;
/// Time for which something newer must have been available before the played moment catches up, s.
const WATCHED_S: f64 = 0.25;
/// Largest time of a path, s.
const LONGEST_S: f64 = 1e12;
/// Largest number of places in the queue; beyond it the oldest is dropped.
const MAX_POINTS: usize = 1024;

/// Action of a tool in one simulation step, as [`Path::step`] returns it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Play {
    /// Move to this place by the end of the step: m, in the frame of the commands (the tissue's, with z out of it).
    /// The second value is the time of this place by the client's clock, s.
    Pose(DVec3, f64),
    /// Let go of the tissue. Returned at each step from [`RELEASE_S`] after the newest command until the next one.
    Release,
}

/// Path of one tool on the server: the commands that are waiting, and the state of their playback. The default is the
/// path of a tool that touches: it begins above its first place, at a height of at least 2 mm. Places are in the frame
/// of the commands.
#[derive(Debug, Clone, Default)]
pub struct Path {
    /// Whether the tool begins at its first place, not above it.
    at_once: bool,
    /// The place where it begins, if it is neither the first place nor above that, m.
    begins_m: Option<DVec3>,
    waiting: VecDeque<(f64, DVec3)>,
    /// Client time, s, place, m, and velocity, m/s, of the newest command, if it contains a velocity.
    heading: Option<(f64, DVec3, DVec3)>,
    played: Option<(f64, DVec3)>,
    place_m: Option<DVec3>,
    arrived_s: f64,
    /// Smallest time available beyond the played moment, s, and the start of its measurement, s.
    spare_s: f64,
    watched_s: f64,
    limited: u64,
    dropped: u64,
    released: u64,
}

/// Complete state of a path as numbers, from which it can be continued in another process.
#[derive(Debug, Clone, PartialEq)]
pub struct PathState {
    /// Whether the tool begins at its first place, not above it.
    pub at_once: bool,
    /// Place where the tool begins, if it is neither the first place nor above that, m.
    pub begins_m: Option<DVec3>,
    /// Client times, s, and places, m, of the commands that are not played yet, by ascending time; at most 1024.
    pub waiting: Vec<(f64, DVec3)>,
    /// Client time, s, place, m, and velocity, m/s, of the newest command, if it contains a velocity.
    pub heading: Option<(f64, DVec3, DVec3)>,
    /// Client time, s, and place, m, of the played moment; `None` before the first command.
    pub played: Option<(f64, DVec3)>,
    /// Place of the tool, m; `None` before the first step and after a release.
    pub place_m: Option<DVec3>,
    /// Time of arrival of the newest command, s; infinite for one that took effect at once.
    pub arrived_s: f64,
    /// Smallest time available beyond the played moment since `watched_s`, s; infinite until it is measured.
    pub spare_s: f64,
    /// Start of the measurement of `spare_s`, s.
    pub watched_s: f64,
    /// Counts as [`Path::counts`] returns them: steps at the speed limit, commands refused or skipped, and releases.
    pub counts: [u64; 3],
}

impl PathState {
    /// Returns whether a path can have this state.
    fn is_sound(&self) -> bool {
        let is_time = |time_s: f64| time_s.abs() < LONGEST_S;
        let is_passed = |(time_s, place_m): &(f64, DVec3)| is_time(*time_s) && place_m.is_finite();
        let is_heading = |(time_s, place_m, velocity): &(f64, DVec3, DVec3)| {
            is_passed(&(*time_s, *place_m)) && velocity.length() <= 2.0 * SPEED_M_PER_S
        };
        self.waiting.len() <= MAX_POINTS
            && self.waiting.iter().chain(&self.played).all(is_passed)
            && self.waiting.is_sorted_by(|a, b| a.0 < b.0)
            && self.heading.iter().all(is_heading)
            && self.begins_m.iter().chain(&self.place_m).all(|place_m| place_m.is_finite())
            // A command that took effect at once arrives at infinity, and a spare time is infinite until it is
            // measured.
            && (is_time(self.arrived_s) || self.arrived_s == f64::INFINITY)
            && (is_time(self.spare_s) || self.spare_s == f64::INFINITY)
            && is_time(self.watched_s)
            && self.counts.iter().all(|count| *count < 1 << 48)
    }
}

impl Path {
    /// Returns a copy of the complete state of the path, from which [`Path::restored`] continues it.
    pub fn state(&self) -> PathState {
        let Path { at_once, begins_m, waiting, heading, played, place_m, arrived_s, spare_s, watched_s, .. } = self;
        PathState {
            at_once: *at_once,
            begins_m: *begins_m,
            waiting: waiting.iter().copied().collect(),
            heading: *heading,
            played: *played,
            place_m: *place_m,
            arrived_s: *arrived_s,
            spare_s: *spare_s,
            watched_s: *watched_s,
            counts: self.counts(),
        }
    }

    /// Creates a path that continues from `state`; `None` if no path can have this state: more than 1024 waiting
    /// places, waiting times that do not rise, a place or time that is not finite, a time of 10¹² s or more, a
    /// velocity above 2·[`SPEED_M_PER_S`], or a count of 2⁴⁸ or more.
    pub fn restored(state: PathState) -> Option<Self> {
        if !state.is_sound() {
            return None;
        }
        let PathState { at_once, begins_m, waiting, heading, played, place_m, arrived_s, spare_s, watched_s, counts } =
            state;
        let (waiting, [limited, dropped, released]) = (waiting.into(), counts);
        Some(Path {
            at_once,
            begins_m,
            waiting,
            heading,
            played,
            place_m,
            arrived_s,
            spare_s,
            watched_s,
            limited,
            dropped,
            released,
        })
    }

    /// Creates the path of a grasp, which takes hold at its first place. The tool of another path begins above its
    /// first place, so that it meets the tissue from outside, as a hand does.
    pub fn of_grasp() -> Self {
        Path { at_once: true, ..Path::default() }
    }

    /// Creates the path of a tool that begins at `place_m`, m, because above its first place it might be inside the
    /// tissue (the tissue is not below the tool).
    pub fn beginning_at(place_m: DVec3) -> Self {
        Path { begins_m: Some(place_m), ..Path::default() }
    }

    /// Queues a command that arrived at `now_s` by the server's clock, s: the tool's place, m, at client time
    /// `time_s`, s. Returns true; or false, and counts a refusal, if a value is not finite or `time_s` is not above
    /// that of the newest waiting place (of the played moment if none waits). Ends a movement by
    /// [`Path::receive_moving`]. Beyond 1024 waiting places the oldest is dropped.
    pub fn receive(&mut self, time_s: f64, place_m: DVec3, now_s: f64) -> bool {
        let newest_s = self.waiting.back().or(self.played.as_ref()).map_or(f64::NEG_INFINITY, |place| place.0);
        if !place_m.is_finite() || !time_s.is_finite() || time_s <= newest_s {
            self.dropped += 1;
            return false;
        }
        self.wait(self.waiting.len(), time_s, place_m);
        (self.heading, self.arrived_s) = (None, now_s);
        true
    }

    /// Queues a command that arrived at `now_s` by the server's clock, s: the tool's place, m, and velocity, m/s, at
    /// client time `time_s`, s. Until a newer command arrives, but at most for [`EXTRAPOLATE_S`], the tool continues
    /// at this velocity, shortened to [`SPEED_M_PER_S`]. Returns true; or false, and counts a refusal, if a value is
    /// not finite or `time_s` is not above [`Path::newest_s`]. Beyond 1024 waiting places the oldest is dropped.
    pub fn receive_moving(&mut self, time_s: f64, place_m: DVec3, velocity_m_per_s: DVec3, now_s: f64) -> bool {
        let newest_s = self.newest_s().unwrap_or(f64::NEG_INFINITY);
        let is_finite = place_m.is_finite() && velocity_m_per_s.is_finite() && time_s.is_finite();
        if !is_finite || time_s <= newest_s {
            self.dropped += 1;
            return false;
        }
        if let Some((played_s, _)) = self.played {
            self.spare_s = self.spare_s.min(time_s - played_s);
        }
        // The played moment may be beyond it already, by extrapolation.
        if self.played.is_none_or(|played| time_s > played.0) {
            self.wait(self.waiting.len(), time_s, place_m);
        }
        let velocity_m_per_s = velocity_m_per_s.clamp_length_max(SPEED_M_PER_S);
        (self.heading, self.arrived_s) = (Some((time_s, place_m, velocity_m_per_s)), now_s);
        true
    }

    /// Inserts a place that arrived late, m, at client time `time_s`, s. Returns true; or false, and counts a refusal,
    /// if nothing was played yet, if this time has been played, is known or is newer than all waiting places, or if a
    /// value is not finite. It does not count as a new command ([`Path::is_held`]).
    pub fn fill(&mut self, time_s: f64, place_m: DVec3) -> bool {
        let is_due = time_s.is_finite() && self.played.is_some_and(|played| time_s > played.0);
        let at = self.waiting.partition_point(|waiting| waiting.0 < time_s);
        // A time beyond all waiting places is not a gap, and a place that is known fills none.
        let fills = is_due && place_m.is_finite() && self.waiting.get(at).is_some_and(|after| after.0 > time_s);
        if fills {
            self.wait(at, time_s, place_m);
        } else {
            self.dropped += 1;
        }
        fills
    }

    /// Returns the client time of the newest command, s, or of the played moment if no command waits or moves the
    /// tool; `None` before the first.
    pub fn newest_s(&self) -> Option<f64> {
        let known = [self.heading.map(|heading| heading.0), self.waiting.back().map(|waiting| waiting.0)];
        known.into_iter().flatten().reduce(f64::max).or(self.played.map(|played| played.0))
    }

    fn wait(&mut self, at: usize, time_s: f64, place_m: DVec3) {
        self.waiting.insert(at, (time_s, place_m));
        if self.waiting.len() > MAX_POINTS {
            self.waiting.pop_front();
        }
    }

    /// Sets the tool's target, m, at client time `time_s`, s, with effect from the next step, and drops all waiting
    /// commands, which are not counted. The tool still moves there no faster than [`SPEED_M_PER_S`]. Until the next
    /// command arrives, it is neither held nor released for lack of commands. Nothing is checked.
    pub fn go_to(&mut self, time_s: f64, place_m: DVec3) {
        self.waiting.clear();
        (self.played, self.heading, self.arrived_s) = (Some((time_s, place_m)), None, f64::INFINITY);
    }

    /// Returns three counts since the path began, in this order: steps in which the speed limit acted; commands that
    /// were refused, or skipped in a backlog; and releases (each once, however many steps it lasts).
    pub fn counts(&self) -> [u64; 3] {
        [self.limited, self.dropped, self.released]
    }

    /// Returns whether the newest command arrived more than [`HOLD_S`] before `now_s` (server's clock, s), so that the
    /// tool is held in place. False after [`Path::go_to`]. Before the first command, the server's time 0 counts as the
    /// arrival.
    pub fn is_held(&self, now_s: f64) -> bool {
        now_s - self.arrived_s > HOLD_S
    }

    /// Advances the path by a step of `step_s`, s, that ends at `now_s` by the server's clock, s. Returns the action
    /// of the tool; `None` before the first command. More than [`RELEASE_S`] after the newest command it is
    /// [`Play::Release`]. The tool moves towards its target by at most [`SPEED_M_PER_S`]·`step_s`. Between two
    /// commands the target is on a straight line, x₀ + (x₁ − x₀)·(t − t₀)/(t₁ − t₀); beyond the newest command with a
    /// velocity it is x + v·(t − t₀), for at most [`EXTRAPOLATE_S`].
    pub fn step(&mut self, now_s: f64, step_s: f64) -> Option<Play> {
        let newest = self.waiting.back().copied();
        if let Some(heading) = self.heading {
            self.go_on(heading, now_s, step_s);
        } else if let Some(newest) = newest {
            self.play(newest, now_s, step_s);
        } else {
            self.spare_s = 0.0;
            self.watched_s = now_s;
        }
        let (time_s, target_m) = self.played?;
        if now_s - self.arrived_s > RELEASE_S {
            if self.place_m.take().is_some() {
                self.released += 1;
            }
            return Some(Play::Release);
        }
        let above_m = DVec3::new(target_m.x, target_m.y, target_m.z.max(ABOVE_M));
        let begins_m = if self.at_once { target_m } else { self.begins_m.unwrap_or(above_m) };
        let from_m = self.place_m.unwrap_or(begins_m);
        let way_m = target_m - from_m;
        let most_m = SPEED_M_PER_S * step_s;
        if way_m.length() > most_m {
            self.limited += 1;
        }
        let place_m = from_m + way_m.clamp_length_max(most_m);
        self.place_m = Some(place_m);
        Some(Play::Pose(place_m, time_s))
    }

    fn play(&mut self, newest: (f64, DVec3), now_s: f64, step_s: f64) {
        let Some((played_s, _)) = self.played.filter(|played| newest.0 - played.0 <= BACKLOG_S) else {
            self.dropped += self.waiting.len() as u64 - 1;
            self.waiting.clear();
            (self.played, self.spare_s, self.watched_s) = (Some(newest), f64::INFINITY, now_s);
            return;
        };
        self.spare_s = self.spare_s.min(newest.0 - played_s - step_s);
        let mut next_s = played_s + step_s;
        if now_s - self.watched_s >= WATCHED_S {
            if self.spare_s > 0.5 * step_s {
                next_s += (CATCH_UP * step_s).min(self.spare_s);
                // Measure anew after catching up.
                self.spare_s -= CATCH_UP * step_s;
            } else {
                (self.spare_s, self.watched_s) = (f64::INFINITY, now_s);
            }
        }
        let next_s = next_s.min(newest.0);
        let before = self.pass(next_s).unwrap_or(newest);
        self.played = Some(match self.waiting.front() {
            Some(after) if next_s > before.0 => (next_s, between(before, *after, next_s)),
            _ => before,
        });
    }

    /// Plays commands that contain a velocity; `heading` is the newest.
    fn go_on(&mut self, heading: (f64, DVec3, DVec3), now_s: f64, step_s: f64) {
        let (newest_s, newest_m, velocity_m_per_s) = heading;
        let Some((played_s, _)) = self.played.filter(|played| newest_s - played.0 <= BACKLOG_S) else {
            self.waiting.clear();
            (self.played, self.spare_s, self.watched_s) = (Some((newest_s, newest_m)), f64::INFINITY, now_s);
            return;
        };
        let mut pace = 1.0;
        if self.spare_s < -LATE_S {
            pace -= CATCH_UP;
        } else if now_s - self.watched_s >= WATCHED_S && self.spare_s.is_finite() && self.spare_s > 0.5 * step_s {
            pace += CATCH_UP;
        }
        if pace != 1.0 {
            self.spare_s += (1.0 - pace) * step_s;
        } else if now_s - self.watched_s >= WATCHED_S {
            (self.spare_s, self.watched_s) = (f64::INFINITY, now_s);
        }
        let next_s = (played_s + pace * step_s).min((newest_s + EXTRAPOLATE_S).max(played_s));
        let before = self.pass(next_s);
        self.played = Some(match (before, self.waiting.front()) {
            (Some(before), Some(after)) => (next_s, between(before, *after, next_s)),
            // Beyond the newest command.
            _ => (next_s, newest_m + velocity_m_per_s * (next_s - newest_s)),
        });
    }

    /// Removes the places up to a moment from the queue. Returns the last of them, or what was played before.
    fn pass(&mut self, until_s: f64) -> Option<(f64, DVec3)> {
        let mut before = self.played;
        while let Some(place) = self.waiting.front().copied().filter(|place| place.0 <= until_s + 1e-9) {
            before = Some(place);
            self.waiting.pop_front();
        }
        before
    }
}

/// Returns the place on the straight line between two places, at a time between theirs.
fn between(before: (f64, DVec3), after: (f64, DVec3), at_s: f64) -> DVec3 {
    before.1.lerp(after.1, (at_s - before.0) / (after.0 - before.0))
}

/// Smallest height above the sheet at rest at which a new tool that touches begins, m.
const ABOVE_M: f64 = 0.002;

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_S: f64 = 1e-3;

    /// Plays one command per millisecond. At step k, those before `arrival(k)` arrive. Returns the client time of the
    /// tool at each step.
    fn played(steps: u32, arrival: impl Fn(u32) -> u32) -> Vec<f64> {
        let (mut path, mut sent, mut times) = (Path::default(), 0, Vec::new());
        for step in 0..steps {
            let now_s = f64::from(step) * STEP_S;
            while sent < arrival(step) {
                path.receive(f64::from(sent) * STEP_S, DVec3::ZERO, now_s);
                sent += 1;
            }
            if let Some(Play::Pose(_, time_s)) = path.step(now_s, STEP_S) {
                times.push(time_s);
            }
        }
        times
    }

    #[test]
    fn bursts_that_leave_nothing_to_spare_are_played_at_the_clients_own_pace() {
        // Bursts of ten: the last command of each is played as the next arrives.
        let times = played(1500, |step| step / 10 * 10);
        for pair in times[20..].windows(2) {
            assert!((pair[1] - pair[0] - STEP_S).abs() < 1e-9, "{pair:?}");
        }
    }

    #[test]
    fn a_tool_catches_up_with_commands_that_are_always_there_and_no_faster_than_by_a_tenth() {
        // The first commands are late by 40 ms, the others by 5 ms.
        let times = played(3000, |step| if step < 41 { u32::from(step == 40) } else { step - 5 });
        let last = times.last().map_or(0.0, |time_s| 2999.0 * STEP_S - time_s);
        assert!(last < 0.008, "{last} s late");
        for pair in times.windows(2) {
            let passed_s = pair[1] - pair[0];
            assert!((0.0..=1.1 * STEP_S + 1e-9).contains(&passed_s), "{pair:?}");
        }
    }

    #[test]
    fn a_place_within_a_nanosecond_of_the_played_moment_is_played_as_it_is() {
        let mut path = Path::of_grasp();
        let places = [(0.0, 0.0), (0.001 + 5e-10, 0.0003), (0.0025, 0.0007)].map(|(time_s, x)| (time_s, x * DVec3::X));
        path.receive(places[0].0, places[0].1, 0.0);
        assert_eq!(path.step(0.0, STEP_S), Some(Play::Pose(places[0].1, 0.0)));
        for (time_s, place_m) in &places[1..] {
            path.receive(*time_s, *place_m, 0.0);
        }
        assert_eq!(path.step(0.001, STEP_S), Some(Play::Pose(places[1].1, places[1].0)));
    }
}
