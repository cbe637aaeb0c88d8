//! Converts refusals and failures to the exceptions of `palpate._errors`.

use palpate_refusal::printable::printable;
use palpate_refusal::{Reason, Refusal};
use palpate_session::simulation::SimulationFailure;
use pyo3::exceptions::{PyKeyboardInterrupt, PyOSError};
use pyo3::prelude::*;
use pyo3::types::PyType;
use tonic::Status;
use tonic_types::StatusExt;

use crate::ending;

/// Creates an exception of the package with `arguments`, on any thread.
fn raised(name: &str, arguments: impl for<'py> pyo3::call::PyCallArgs<'py>) -> PyErr {
    let made = |py: Python<'_>| {
        let made = || py.import("palpate._errors")?.getattr(name)?.cast_into::<PyType>()?.call1(arguments);
        made().map_or_else(|error| error, PyErr::from_value)
    };
    ending::attached(made).unwrap_or_else(ending::ended)
}

/// Returns `palpate.Refused` for a refusal.
pub(crate) fn refused(refusal: Refusal) -> PyErr {
    let Refusal { reason, field, message, place } = refusal;
    raised("Refused", (reason.as_str(), field, message, place))
}

/// Returns `palpate.Refused` for an argument of the wrong kind.
pub(crate) fn wrong(field: &str, message: impl Into<String>) -> PyErr {
    refused(Refusal::new(Reason::WrongKind, field, message))
}

/// Returns whether an exception is a refusal for this reason.
pub(crate) fn has_reason(error: &PyErr, reason: Reason) -> bool {
    let is = |py: Python<'_>| {
        let known = error.value(py).getattr("reason").and_then(|known| known.extract::<String>());
        known.is_ok_and(|known| known == reason.as_str())
    };
    ending::attached(is).unwrap_or(false)
}

/// Returns `palpate.Failed`: the tissue could not continue.
pub(crate) fn failed(message: &str) -> PyErr {
    raised("Failed", (message,))
}

/// Returns the exception for a run that ended early.
pub(crate) fn of_run(failure: SimulationFailure) -> PyErr {
    match failure {
        SimulationFailure::Refused(refusal) => refused(refusal),
        SimulationFailure::Held(message) => failed(&message),
        SimulationFailure::Output(error) if error.kind() == std::io::ErrorKind::Interrupted => {
            PyKeyboardInterrupt::new_err(())
        }
        SimulationFailure::Output(error) => PyOSError::new_err(error.to_string()),
    }
}

/// Returns the exception for a refusal of the server, or for a broken connection.
pub(crate) fn of_status(status: Status) -> PyErr {
    match status.get_details_error_info() {
        Some(info) => {
            let field = info.metadata.get("field").cloned().unwrap_or_default();
            // The server's text starts with the field.
            let message = status.message().strip_prefix(&format!("{field}: ")).unwrap_or(status.message());
            raised("Refused", (printable(info.reason), printable(field), printable(message), None::<String>))
        }
        None => raised("Disconnected", (palpate_client::describe(&status),)),
    }
}

/// Returns the exception for an error of the client library.
pub(crate) fn of_client(error: palpate_client::Error) -> PyErr {
    use palpate_client::Error;
    let text = error.to_string();
    match error {
        Error::Call(status) => of_status(status),
        Error::Argument(message) => refused(Refusal::new(Reason::OutOfRange, "", message)),
        Error::Connection(_) => raised("Disconnected", (text,)),
        // An exception that a Python device raised is raised again unchanged.
        Error::Device(error) => match error.downcast::<PyErr>() {
            Ok(error) => error,
            Err(error) => PyOSError::new_err(format!("the device: {error}")),
        },
        Error::Internal(_) => raised("Failed", (text,)),
    }
}
