//! The definition of a measure, and a figure: its value.

/// Whether a measure has a value for each tool, one for all tools together, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// One value for each tool.
    Tool,
    /// One value for all tools together.
    Total,
    /// One value for each tool, and one for all.
    Both,
}

/// What a measure is: the row of the register.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasureDefinition {
    /// Its name, with the unit at the end if it has one.
    pub name: &'static str,
    /// Its unit; `1` if it has none.
    pub unit: &'static str,
    /// For what it has values.
    pub scope: Scope,
    /// The smallest and the largest possible value; infinite if there is none.
    pub range: [f64; 2],
    /// How it is computed.
    pub formula: &'static str,
    /// Who has defined it, with a DOI where there is one; `Palpate` for what needs no source.
    pub source: &'static str,
    /// What it tells, as a sentence for people.
    pub meaning: &'static str,
}

impl MeasureDefinition {
    /// Returns a measure of all tools that needs the truth of an exercise, from 0 to `most`.
    pub(crate) const fn of_truth(
        name: &'static str,
        unit: &'static str,
        most: f64,
        formula: &'static str,
        meaning: &'static str,
    ) -> Self {
        MeasureDefinition { name, unit, scope: Scope::Total, range: [0.0, most], formula, source: "Palpate", meaning }
    }
}

/// The value of a measure. A measure without a defined value, such as the mean force without a contact, has no figure; a
/// value is always finite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figure {
    /// The measure.
    pub definition: &'static MeasureDefinition,
    /// Its value, in the unit of the measure.
    pub value: f64,
    /// The tool; `None` for all tools together.
    pub tool: Option<u32>,
}

/// Figures of one tool, or of all together, while they are collected.
#[derive(Debug)]
pub(crate) struct Figures {
    tool: Option<u32>,
    pub(crate) list: Vec<Figure>,
}

impl Figures {
    pub(crate) fn of(tool: Option<u32>) -> Self {
        Figures { tool, list: Vec::new() }
    }

    /// Adds a value, if it is some and finite.
    pub(crate) fn add(&mut self, definition: &'static MeasureDefinition, value: impl Into<Option<f64>>) {
        if let Some(value) = value.into().filter(|value| value.is_finite()) {
            // One zero: + 0.0 removes the sign of −0.
            self.list.push(Figure { definition, value: value + 0.0, tool: self.tool });
        }
    }
}
