//! Reports recoveries to a haptic stream: a rejection for each of its tools that a recovery released.

use palpate_proto::pb;

use palpate_refusal::{Reason, Refusal};
use palpate_session::Sample;
use palpate_session::recovery::describe;
use palpate_session::wire;

/// The recoveries that were already reported to one stream.
#[derive(Debug)]
pub(super) struct Notices {
    tools: Vec<u32>,
    /// The step since which the stream holds its tools. Earlier recoveries released tools of other holders.
    since_step: u64,
    /// Number of recoveries already reported.
    told: u64,
}

impl Notices {
    /// Creates the notices of a stream that holds `tools` from step `since_step` on.
    pub(super) fn new(tools: Vec<u32>, since_step: u64) -> Self {
        Notices { tools, since_step, told: 0 }
    }

    /// Returns the rejections to send before `sample`: one for each tool of the stream that the newest recovery
    /// released, once.
    pub(super) fn of(&mut self, sample: &Sample) -> Vec<pb::Rejection> {
        let Some(recovered) = sample.recovered.as_ref().filter(|_| sample.recoveries > self.told) else {
            return Vec::new();
        };
        self.told = sample.recoveries;
        let recovery = &recovered.recovery;
        let is_ours = |tool: u32| recovery.step > self.since_step && self.tools.contains(&tool);
        let refusal = Refusal::new(Reason::Recovered, "", describe(recovery));
        let ended = recovered.tools.iter().filter(|ended| is_ours(ended.tool));
        ended.map(|ended| wire::sample::rejection(ended.tool, ended.sequence, &refusal)).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use palpate_session::recovery::{Ended, Recovered};
    use palpate_tissue::scene::record::Recovery;

    fn sample(recoveries: u64, step: u64) -> Sample {
        let (state_of_step, reason) = (step - 9, "it grew".to_owned());
        let recovery =
            Recovery { step, state_of_step, at_rest: false, undone_commands: 3, paused_until_step: None, reason };
        let tools = [1, 2].map(|tool| Ended { tool, sequence: 10 + u64::from(tool), undone_commands: 1 }).to_vec();
        Sample {
            step,
            simulation_time_s: 0.0,
            awake_points: 0,
            late_commands: 0,
            held: false,
            cuts_exhausted: false,
            topology_version: 0,
            recoveries,
            recovered: (recoveries > 0).then(|| Arc::new(Recovered { recovery, tools })),
            tools: Vec::new(),
            other_tools: Vec::new(),
        }
    }

    #[test]
    fn a_holder_is_told_once_of_each_recovery_that_released_its_tools() {
        let mut notices = Notices::new(vec![0, 2], 100);
        assert!(notices.of(&sample(0, 101)).is_empty());
        let told = notices.of(&sample(1, 102));
        let [rejection] = &told[..] else { panic!("{told:?}") };
        assert_eq!((rejection.tool, rejection.sequence, &*rejection.reason), (2, 12, "RECOVERED"));
        assert!(rejection.message.contains("it grew") && rejection.message.contains("step 93"), "{rejection:?}");
        assert!(notices.of(&sample(1, 102)).is_empty());
        assert_eq!(notices.of(&sample(2, 300)).len(), 1);
        // A recovery before the stream took its tools does not concern it.
        assert!(Notices::new(vec![2], 100).of(&sample(1, 100)).is_empty());
        assert!(Notices::new(vec![5], 0).of(&sample(1, 100)).is_empty());
    }
}
