//! What the measures are computed from: a row for each tool and step, and the thresholds that the caller chooses.

use glam::DVec3;
use palpate_refusal::{Reason, Refusal, Result, positive};

use crate::limit::{LimitKind, ToolLimits};

/// The part of the surface that a tool presses with an area, at the end of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PressedDisc {
    /// Place of its middle on the tissue at rest, m.
    pub rest_m: DVec3,
    /// Unit normal of the surface at rest there, towards the tool.
    pub normal: DVec3,
    /// Radius, m, above 0.
    pub radius_m: f64,
    /// Mean pressure on it, Pa: the part of the force along the present normal over the area; 0 while the tool pulls.
    pub pressure_pa: f64,
}

/// What one tool does at the end of a step. Vectors are in the tissue's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolRow {
    /// The tool's number.
    pub tool: u32,
    /// Place of the tool, m.
    pub place_m: DVec3,
    /// Force of the tissue on the tool, N.
    pub force_n: DVec3,
    /// Whether the tool touches, holds or pushes the tissue.
    pub is_in_contact: bool,
    /// How far the tissue under the tool is pressed in from rest, m; negative where it is pulled out.
    pub indentation_m: f64,
    /// The disc that it presses; `None` for a tool without an area, and without contact.
    pub disc: Option<PressedDisc>,
    /// The largest strain of the tissue near the tool, (L − L₀)/L₀ of what joins neighbours; `None` if it is not measured.
    pub strain: Option<f64>,
}

impl ToolRow {
    /// Returns the value that a limit is compared with: 0 without contact, and where the tool has none.
    pub(crate) fn limited(&self, kind: LimitKind) -> f64 {
        let value = match kind {
            LimitKind::Force => Some(self.force_n.length()),
            LimitKind::Pressure => self.disc.map(|disc| disc.pressure_pa),
            LimitKind::Strain => self.strain,
        };
        value.filter(|_| self.is_in_contact).unwrap_or(0.0)
    }
}

/// The thresholds of measures, and which tools belong to one hand.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasureOptions {
    /// The limits of a tool. Without one there is no share above it, such as `force_above_limit_share`.
    pub limits: ToolLimits,
    /// The pressure, Pa, from which a place counts as pressed ([`DEFAULT_COVERAGE_PA`](Self::DEFAULT_COVERAGE_PA)).
    pub coverage_pa: f64,
    /// The force, N, from which a contact counts as a press ([`DEFAULT_PRESS_N`](Self::DEFAULT_PRESS_N)).
    pub press_n: f64,
    /// The direction, of length 1, along which somebody looks at the surface: only the part of it that faces this within 60° counts for
    /// coverage. `None`: all of it.
    pub seen_along: Option<DVec3>,
    /// The tools of each hand. Empty: each tool is a hand of its own.
    pub hands: Vec<Vec<u32>>,
}

impl MeasureOptions {
    /// The default of `coverage_pa`: with it, a fingertip of 5 mm radius is 2 mm deep in a liver (71 N/m). Deep lumps of a
    /// breast need about 20 kPa: physicians who pressed with less than 10 N, on about 5 cm² of three fingers, missed them
    /// (Laufer et al. 2015, doi:10.1056/NEJMc1414210).
    pub const DEFAULT_COVERAGE_PA: f64 = 2000.0;
    /// The default of `press_n`: a light touch of a fingertip is weaker.
    pub const DEFAULT_PRESS_N: f64 = 0.1;

    /// Checks the thresholds and the hands.
    ///
    /// # Errors
    /// Refuses a threshold that is not above 0 or not finite, a hand without a tool, a tool in two hands, and one hand
    /// or more than two. `field` is the name of the option; of a limit, that of [`ToolLimits::check`].
    pub fn check(&self) -> Result<()> {
        self.limits.check()?;
        positive("coverage_pa", self.coverage_pa)?;
        positive("press_n", self.press_n)?;
        let refuse = |message: &str| Err(Refusal::new(Reason::OutOfRange, "hands", message));
        if ![0, 2].contains(&self.hands.len()) {
            return refuse("must be two hands, each with the numbers of its tools");
        }
        let mut tools: Vec<u32> = self.hands.concat();
        let count = tools.len();
        tools.sort_unstable();
        tools.dedup();
        match () {
            () if self.hands.iter().any(Vec::is_empty) => refuse("a hand must have a tool"),
            () if tools.len() < count => refuse("a tool must be in one hand only"),
            () => Ok(()),
        }
    }
}

impl Default for MeasureOptions {
    fn default() -> Self {
        MeasureOptions {
            limits: ToolLimits::default(),
            coverage_pa: Self::DEFAULT_COVERAGE_PA,
            press_n: Self::DEFAULT_PRESS_N,
            seen_along: None,
            hands: Vec::new(),
        }
    }
}
