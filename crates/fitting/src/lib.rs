//! Fits the parameters of a tissue to measured curves of force over depth: least squares over runs of the product itself.
//!
//! Numbers enter and leave: [`curve_file`] reads the text of a table, [`fit`](fn@fit::fit) searches, [`residual`] compares forces
//! with measured ones, [`scene_text`] writes values into the text of a scene. Runs are spread over threads; the result does not
//! depend on their number.

pub mod curve_file;
pub mod fit;
mod noise;
pub mod options;
mod parallel;
pub mod residual;
mod runs;
pub mod scale;
pub mod scene_text;
mod search;
pub mod uncertainty;
