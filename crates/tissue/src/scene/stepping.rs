//! How time advances, as a user asks for it: section `[stepping]` of a scene.

use palpate_refusal::{Reason, Result, number};

use super::named::{Named, named};
use super::toml_document::Item;
use crate::limits::Limits;

/// How time advances: rate, accuracy, scheme and number format, as a user asks for them. `default()` has the
/// defaults named below.
#[derive(Debug, Clone, PartialEq)]
pub struct Stepping {
    /// Steps per second, Hz, from 1e-3 to 1e7. Commands take effect and samples are taken once per step.
    /// Default: 1000.
    pub rate_hz: f64,
    /// Wanted error of displacement and force, each relative to the largest of its kind; above 0 and at most 1.
    /// Default: 1e-5, of a solid 1e-2 ([`BodyKind::usual_stepping`](super::BodyKind::usual_stepping)).
    pub tolerance: f64,
    /// The scheme that advances the points in time. Default: `auto`.
    pub integrator: Integrator,
    /// Substeps per step, from 1 to the limit `substeps`. If `None` (the default), the tolerance and the
    /// stability bound decide.
    pub substeps: Option<u32>,
    /// The number format of the state. Default: `auto`.
    pub precision: Precision,
    /// How many numbers the processor works on at once. Default: `auto`.
    pub lanes: Lanes,
    /// Whether the tissue is stepped more accurately after an audit finds an error above the tolerance.
    /// Default: false.
    pub correct: bool,
}

impl Default for Stepping {
    fn default() -> Self {
        Stepping {
            rate_hz: 1000.0,
            tolerance: 1e-5,
            integrator: Integrator::Auto,
            substeps: None,
            precision: Precision::Auto,
            lanes: Lanes::Auto,
            correct: false,
        }
    }
}

named! {
    /// The schemes that advance the points in time (see the module `scheme`).
    pub enum Integrator {
        /// Palpate chooses, among `central` (of a viscous tissue `stormer`) and the exponential schemes.
        Auto = "auto",
        /// Central differences, damping implicit: second order.
        Central = "central",
        /// The paper's scheme: damping with the velocity of the last step, first order.
        Lagged = "lagged",
        /// The classical scheme of Runge and Kutta: fourth order, four evaluations of the forces per substep.
        Rk4 = "rk4",
        /// Exponential multistep with the last 2 forces of the springs: third order.
        Exponential2 = "exponential2",
        /// Exponential multistep with the last 3 forces of the springs: fourth order.
        Exponential3 = "exponential3",
        /// Exponential multistep with the last 4 forces of the springs: fifth order.
        Exponential4 = "exponential4",
        /// Central differences with the springs' last 2 forces: second order, with a smaller error than `central`. For tissue
        /// without anchor springs.
        Stormer = "stormer",
    }
}

impl Integrator {
    /// Returns whether the integrator steps tissue with anchor springs.
    pub fn takes_anchor_springs(self) -> bool {
        self != Integrator::Stormer
    }

    /// Returns the integrators that step tissue with anchor springs, without `auto`, in the order of [`Named::NAMES`].
    pub fn of_anchored() -> impl Iterator<Item = Self> {
        let all = Self::NAMES.iter().map(|entry| entry.1);
        all.filter(|integrator| *integrator != Integrator::Auto && integrator.takes_anchor_springs())
    }
}

named! {
    /// The number format of the state.
    pub enum Precision {
        /// Palpate chooses for the tolerance.
        Auto = "auto",
        /// 4 bytes per number, single precision.
        F32 = "f32",
        /// 4 bytes per number, and 4 more that keep the rounding error of a displacement: for exponential
        /// schemes.
        Compensated = "compensated",
        /// 8 bytes per number, double precision.
        F64 = "f64",
    }
}

named! {
    /// How many numbers the processor works on at once. The bits of the results do not depend on it.
    pub enum Lanes {
        /// The widest that the machine has.
        Auto = "auto",
        /// Vectors of 64 bytes, on x86-64 with AVX-512.
        Avx512 = "avx512",
        /// Vectors of 32 bytes, on x86-64 with AVX2.
        Avx2 = "avx2",
        /// Vectors of 16 bytes, on ARM.
        Neon = "neon",
        /// One number at a time, on any machine; much slower.
        Plain = "plain",
    }
}

impl Stepping {
    /// Refuses numbers that are out of range.
    pub(super) fn check(&self, limits: &Limits) -> Result<()> {
        number("stepping.rate_hz", self.rate_hz, "from 1e-3 to 1e7", |v| (1e-3..=1e7).contains(&v))?;
        number("stepping.tolerance", self.tolerance, "above 0 and at most 1", |v| v > 0.0 && v <= 1.0)?;
        if let Some(substeps) = self.substeps {
            let range = format!("from 1 to {}", limits.substeps);
            let holds = |v| v >= 1.0 && v <= f64::from(limits.substeps);
            number("stepping.substeps", f64::from(substeps), &range, holds)?;
        }
        Ok(())
    }

    /// Reads a section; what it leaves out is as in `standard`.
    pub(super) fn read(item: &Item<'_>, standard: Stepping) -> Result<Stepping> {
        item.table(|fields| {
            Ok(Stepping {
                rate_hz: fields.number("rate_hz")?.unwrap_or(standard.rate_hz),
                tolerance: fields.number("tolerance")?.unwrap_or(standard.tolerance),
                integrator: match fields.text("integrator")? {
                    Some(name) => Integrator::named(&fields.path("integrator"), &name)?,
                    None => standard.integrator,
                },
                substeps: match fields.item("substeps") {
                    Some(item) if item.as_text() == Some("auto") => None,
                    Some(item) if item.as_text().is_some() => return Err(item.wrong("\"auto\" or a whole number")),
                    Some(item) => {
                        let whole = item.whole()?;
                        Some(u32::try_from(whole).map_err(|_| item.refuse(Reason::OutOfRange, "is too large"))?)
                    }
                    None => None,
                },
                precision: match fields.text("precision")? {
                    Some(name) => Precision::named(&fields.path("precision"), &name)?,
                    None => standard.precision,
                },
                lanes: match fields.text("lanes")? {
                    Some(name) => Lanes::named(&fields.path("lanes"), &name)?,
                    None => standard.lanes,
                },
                correct: fields.item("correct").map_or(Ok(standard.correct), |item| item.flag())?,
            })
        })
    }
}
