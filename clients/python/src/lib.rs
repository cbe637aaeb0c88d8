//! Palpate from Python: the module `palpate._native`, which the package `palpate` wraps.
//!
//! Long work runs without the interpreter's lock, and Ctrl-C ends it. Arrays are passed to NumPy without a copy:
//! their memory is allocated and filled here, and owned by the array.

// Programs of one user run in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]
// What Python sees is documented here for `help`, and word for word in palpate/__init__.pyi for editors.
#![allow(clippy::needless_pass_by_value)]
// A method of a type with a lifetime is for one lifetime, a closure for all.
#![allow(clippy::redundant_closure_for_method_calls)]

mod arrays;
mod client;
mod device;
mod ending;
mod error;
mod exercise;
mod fit;
mod hand;
mod instrument;
mod journal;
mod load;
mod offline;
mod play;
mod run;
mod scene;
mod sent;
mod session;
mod streams;
mod tip;
mod told;
mod waiting;

use pyo3::prelude::*;

#[pymodule(name = "_native")]
fn native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    ending::register(module)?;
    module.add_class::<scene::Scene>()?;
    module.add_class::<scene::Script>()?;
    module.add_class::<scene::Tissue>()?;
    module.add_class::<session::Session>()?;
    module.add_class::<tip::Tip>()?;
    module.add_class::<instrument::Instrument>()?;
    module.add_class::<hand::Hand>()?;
    module.add_class::<journal::Journal>()?;
    module.add_class::<client::Server>()?;
    module.add_class::<client::RemoteSession>()?;
    module.add_class::<offline::Offline>()?;
    module.add_class::<streams::Samples>()?;
    module.add_class::<streams::FrameStream>()?;
    module.add_class::<exercise::LiveMeasures>()?;
    module.add_function(wrap_pyfunction!(scene::scenes, module)?)?;
    module.add_function(wrap_pyfunction!(scene::scripts, module)?)?;
    module.add_function(wrap_pyfunction!(fit::fit, module)?)?;
    module.add_function(wrap_pyfunction!(run::run, module)?)?;
    module.add_function(wrap_pyfunction!(run::study, module)?)?;
    module.add_function(wrap_pyfunction!(device::devices, module)?)?;
    module.add_function(wrap_pyfunction!(hand::two_hands, module)?)?;
    Ok(())
}
