//! For how long a program that shows a server asks one that does not answer.

use palpate_client::describe;
use tonic::{Code, Status};

/// Queries in a row without an answer: a server that starts again is waited for, one that is gone is not.
#[derive(Default)]
pub(crate) struct Unanswered(u32);

impl Unanswered {
    /// After so many a program gives up: half a minute of a server that refuses connections, five minutes of a silent one.
    const MAX_UNANSWERED: u32 = 30;

    /// Counts a query that failed. Whether to ask once more, of which the user is told.
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
