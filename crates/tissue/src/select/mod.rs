//! Chooses the scheme of a tissue: rehearsal, selection, audit, and correction.

pub mod audit;
pub(crate) mod calibration;
pub(crate) mod correction;
pub mod scheme_selection;
