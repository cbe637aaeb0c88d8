//! Limits how long a program that shows a server waits for one that does not answer.

use palpate_client::describe;
use tonic::{Code, Status};

/// Number of successive queries without an answer. A program waits for a server that restarts, but not for one that
/// is gone.
#[derive(Default)]
pub(crate) struct Unanswered(u32);

impl Unanswered {
    /// Number of queries after which a program gives up: half a minute for a server that refuses connections, five
    /// minutes for a silent one.
    const MAX_UNANSWERED: u32 = 30;

    /// Counts a query that failed. Returns whether to ask once more, after telling the user.
    pub(crate) fn may_ask_again(&mut self, status: &Status) -> bool {
        self.0 += 1;
        let may = status.code() == Code::Unavailable && self.0 < Self::MAX_UNANSWERED;
        if may {
            crate::warn(&format!("{}; trying again ({} of {})", describe(status), self.0, Self::MAX_UNANSWERED - 1));
        }
        may
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_is_gone_is_not_asked_for_ever() {
        let (gone, refused) = (Status::unavailable("gone"), Status::permission_denied("no"));
        let mut unanswered = Unanswered::default();
        let asked = (0..1000).take_while(|_| unanswered.may_ask_again(&gone)).count();
        assert_eq!(asked, 29);
        assert!(!Unanswered::default().may_ask_again(&refused));
    }
}
