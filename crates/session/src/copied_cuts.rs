//! The cuts of a client's copy of a tissue, beside those of the server's tissue.
//!
//! The blade of the client's own tool cuts the copy at once; the server reports what was severed in its tissue, by whom ever. So a
//! spring that the copy has severed by itself is *unconfirmed* until a report has it. The server may never sever it: its blade
//! was a little beside the client's, or a command was lost. The server is right then: a spring that has been unconfirmed for long shows
//! that the copy has to begin anew.

use std::collections::BTreeMap;

use palpate_haptics::{ReportedCuts, ReportedSpring};
use palpate_tissue::Cuts;

/// What tells a spring from others ([`ReportedSpring::name`]).
type SpringKey = (u32, u32);

/// The severed springs of a copy, as far as they come from the server.
#[derive(Debug, Default)]
pub(crate) struct CopiedCuts {
    /// The version of the topology of the server's tissue by the last report.
    pub(crate) version: u32,
    /// All springs that are severed in the server's tissue, by the reports.
    reported: BTreeMap<SpringKey, f64>,
    /// Those that only the copy has severed, with the copy's time at which they were noticed, s, ascending.
    unconfirmed: Vec<(SpringKey, f64)>,
    /// Version and number of springs of the copy's own topology as of the last look.
    seen: (u32, usize),
}

impl CopiedCuts {
    /// Returns whether a report takes back a spring of an earlier one: the server has undone a cut.
    pub(crate) fn is_undone_by(&self, cuts: &ReportedCuts) -> bool {
        if cuts.continues {
            return false;
        }
        let mut kept: Vec<SpringKey> = cuts.springs.iter().map(ReportedSpring::name).collect();
        kept.sort_unstable();
        self.reported.keys().any(|name| kept.binary_search(name).is_err())
    }

    /// Adds the springs of a report that undoes nothing.
    pub(crate) fn add(&mut self, cuts: &ReportedCuts) {
        self.version = cuts.version;
        self.reported.extend(cuts.springs.iter().map(|spring| (spring.name(), spring.part)));
        let reported = &self.reported;
        self.unconfirmed.retain(|(name, _)| !reported.contains_key(name));
    }

    /// Replaces all springs by those of a report, for a copy that begins anew.
    pub(crate) fn replace(&mut self, cuts: &ReportedCuts) {
        *self = CopiedCuts::default();
        self.add(cuts);
    }

    /// Returns all springs that are severed in the server's tissue, for a copy that begins anew.
    pub(crate) fn reported(&self) -> ReportedCuts {
        let springs = self.reported.iter().map(|((place, number), part)| ReportedSpring {
            place: *place,
            number: *number,
            part: *part,
        });
        ReportedCuts { version: self.version, continues: false, springs: springs.collect() }
    }

    /// Looks for springs that the copy has severed by itself since the last look, at `time_s` of the copy.
    pub(crate) fn look(&mut self, cuts: &Cuts, time_s: f64) {
        let (version, count) = self.seen;
        if version == cuts.version() {
            return;
        }
        // The copy's guard may have undone a cut.
        let from = if cuts.continues(version) { count } else { 0 };
        if from == 0 {
            self.unconfirmed.clear();
        }
        let own = cuts.reported(from).map(|(spring, _)| spring.name()).filter(|name| !self.reported.contains_key(name));
        self.unconfirmed.extend(own.map(|name| (name, time_s)));
        self.seen = (cuts.version(), cuts.len());
    }

    /// Returns the time of the copy since which a spring is unconfirmed, s; `None` if there is none.
    pub(crate) fn unconfirmed_since_s(&self) -> Option<f64> {
        self.unconfirmed.first().map(|(_, since_s)| *since_s)
    }
}
