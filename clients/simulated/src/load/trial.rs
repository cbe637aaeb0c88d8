//! A trial of load: a plan of one phase, made from a few numbers.

use super::plan::{Arrivals, LoadPlan, Phase, STAYS_S, Viewers, Wire, only};
use super::tip::{Deadbands, Lead, default_device};

/// Parameters of a trial: a load test in which equal sessions start, are measured together, and stay to the end. A
/// session that the server refuses ends the trial. No value is checked.
#[derive(Debug, Clone)]
pub struct LoadTrial {
    /// Name of a scene of the server, or the path of a scene file, which ends in .toml.
    pub scene: String,
    /// Number of clients of each session, with one tool each. With 0, commands that are sent beforehand keep each
    /// session awake.
    pub clients_per_session: u32,
    /// Number of viewers of each session.
    pub viewers: u32,
    /// Duration of the measurement, once all clients are connected, s.
    pub seconds: f64,
    /// Time over which the sessions with their clients start, at even intervals, s.
    pub ramp_s: f64,
    /// Commands per second of each client; with `touch`, ticks per second.
    pub rate_hz: f64,
    /// Frames per second of each viewer.
    pub frame_rate_hz: f64,
    /// If present, clients lead tools with a tip and render forces, with these deadbands; if `None`, they push with
    /// forces.
    pub touch: Option<Deadbands>,
    /// Number of clients that share a connection, at least 1.
    pub clients_per_connection: u32,
    /// Number of threads of this generator that clients share; at least one, and at most one per session.
    pub threads: u32,
}

impl LoadTrial {
    /// Returns the plan of a trial with this many sessions, one for each of its users: they connect over `ramp_s`,
    /// are measured together for `seconds`, and stay to the end. The clients reach the server directly; with `touch`,
    /// their device is the `omega3`. The plan has no objective.
    pub fn plan(&self, sessions: u32) -> LoadPlan {
        let lead =
            self.touch.map(|deadbands| Lead { deadbands, device: default_device(), hand: None, instrument: None });
        let phase = Phase {
            name: "trial".to_owned(),
            seconds: self.seconds,
            arrivals: Arrivals::Gathering { users: sessions, over_s: self.ramp_s },
            stays_s: STAYS_S,
            objective: None,
        };
        LoadPlan {
            name: "trial".to_owned(),
            seed: 0,
            rate_hz: self.rate_hz,
            clients_per_user: self.clients_per_session,
            clients_per_connection: self.clients_per_connection,
            threads: self.threads,
            scenes: only(self.scene.clone()),
            leads: only(lead),
            wires: only(Wire::direct()),
            scripts: only(None),
            viewers: only(Viewers { number: self.viewers, rate_hz: self.frame_rate_hz }),
            phases: vec![phase],
            objective: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_sessions_of_a_trial_gather_over_the_ramp_and_stay() {
        let mut trial = LoadTrial {
            scene: "paper".to_owned(),
            clients_per_session: 2,
            viewers: 1,
            seconds: 0.0,
            ramp_s: 3.0,
            rate_hz: 1000.0,
            frame_rate_hz: 60.0,
            touch: None,
            clients_per_connection: 1,
            threads: 2,
        };
        for (ramp_s, expected_s) in [(3.0, [0.0, 1.0, 2.0]), (0.0, [0.0; 3])] {
            trial.ramp_s = ramp_s;
            let plan = trial.plan(3);
            let users = plan.users();
            assert_eq!(users.iter().map(|user| user.at_s).collect::<Vec<_>>(), expected_s);
            assert!(users.iter().all(|user| user.stays_s > trial.seconds));
            assert_eq!((plan.gathers_over_s(), plan.lasts_s()), (Some(ramp_s), trial.seconds));
        }
    }
}
