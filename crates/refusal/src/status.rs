//! Refusals as gRPC statuses with `google.rpc.ErrorInfo`.

use std::collections::HashMap;

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::printable::printable;
use crate::{Reason, Refusal};

/// `domain` of every `google.rpc.ErrorInfo` that a server sends.
pub const DOMAIN: &str = "palpate";

/// Metadata key of `ErrorInfo` for the URL of the server that has the session, in a refusal with reason
/// `ELSEWHERE`.
pub const ENDPOINT: &str = "endpoint";

/// Returns the URL of the server that has the session, if `status` refuses a call because another server has it
/// ([`Reason::Elsewhere`]). `None` for every other status, and if the refusal names no endpoint.
pub fn elsewhere(status: &Status) -> Option<String> {
    let info = status.get_details_error_info()?;
    (info.reason == Reason::Elsewhere.as_str()).then(|| info.metadata.get(ENDPOINT).cloned())?
}

/// Returns the gRPC status code of a reason: `InvalidArgument` for an input that is wrong in itself, `NotFound` for
/// an unknown or deleted one, `ResourceExhausted` for a limit or a load, `FailedPrecondition` for a state that must
/// change first, and the codes of the same meaning for the others.
pub fn code(reason: Reason) -> Code {
    match reason {
        Reason::Unreadable
        | Reason::UnknownKey
        | Reason::Missing
        | Reason::WrongKind
        | Reason::NotFinite
        | Reason::OutOfRange
        | Reason::ForceTooLarge
        | Reason::OffTissue
        | Reason::OutOfTurn => Code::InvalidArgument,
        Reason::TooLarge | Reason::QueueFull | Reason::TooMany | Reason::Overloaded | Reason::RateLimited => {
            Code::ResourceExhausted
        }
        Reason::TimedOut => Code::DeadlineExceeded,
        Reason::UnknownScene
        | Reason::UnknownScript
        | Reason::UnknownExercise
        | Reason::UnknownMesh
        | Reason::UnknownJournal
        | Reason::UnknownSession
        | Reason::SessionDeleted
        | Reason::UnknownViewer => Code::NotFound,
        Reason::SessionHeld | Reason::StaleSequence | Reason::NotAvailable | Reason::Elsewhere => {
            Code::FailedPrecondition
        }
        Reason::ToolHeld => Code::AlreadyExists,
        Reason::NotHolder | Reason::RoleMissing | Reason::NotForTrainee | Reason::OriginNotAllowed => {
            Code::PermissionDenied
        }
        Reason::Unauthenticated => Code::Unauthenticated,
        Reason::StepPassed => Code::OutOfRange,
        Reason::Cut | Reason::Recovered => Code::Aborted,
        Reason::ShuttingDown | Reason::Fenced => Code::Unavailable,
    }
}

impl From<Refusal> for Status {
    fn from(refusal: Refusal) -> Self {
        let refusal = refusal.without_folder();
        let mut metadata = HashMap::new();
        if !refusal.field.is_empty() {
            metadata.insert("field".to_owned(), refusal.field.clone());
        }
        if refusal.reason == Reason::Elsewhere {
            metadata.extend(refusal.place.iter().map(|endpoint| (ENDPOINT.to_owned(), endpoint.clone())));
        }
        let mut details = ErrorDetails::with_error_info(refusal.reason.as_str(), DOMAIN, metadata);
        if code(refusal.reason) == Code::InvalidArgument && !refusal.field.is_empty() {
            details.add_bad_request_violation(&refusal.field, &refusal.message);
        }
        Status::with_error_details(code(refusal.reason), refusal.to_string(), details)
    }
}

/// Returns the text that a client shows for a status: its message, followed in brackets by the reason of its
/// `google.rpc.ErrorInfo`, such as `(OUT_OF_RANGE)`, or by the code, such as `(Unavailable)`, if it has none.
/// Characters that act on a terminal, line breaks included, become `?`.
pub fn describe(status: &Status) -> String {
    match status.get_details_error_info() {
        Some(info) => printable(format_args!("{} ({})", status.message(), info.reason)),
        None => printable(format_args!("{} ({:?})", status.message(), status.code())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_guide_explains_every_reason() {
        let guide = include_str!("../../../docs/protocol.md");
        for reason in Reason::ALL {
            assert!(guide.contains(&format!("`{}`", reason.as_str())), "docs/protocol.md lacks {}", reason.as_str());
        }
    }

    #[test]
    fn a_refusal_keeps_its_reason_and_field() {
        let status = Status::from(Refusal::new(Reason::NotFinite, "force.force_n", "must be a finite number"));
        assert_eq!(status.code(), Code::InvalidArgument);
        let info = status.get_details_error_info().unwrap();
        assert_eq!((info.reason.as_str(), info.domain.as_str()), ("NOT_FINITE", DOMAIN));
        assert_eq!(info.metadata["field"], "force.force_n");
        let place = Some("/srv/secret/5e.1.mcap".to_owned());
        let status = Status::from(Refusal { place, ..Refusal::new(Reason::Unreadable, "", "is damaged") });
        assert_eq!(status.message(), "5e.1.mcap: is damaged");
    }
}
