//! Measured curves, and their table as text: columns with units in their names, a row for each sample.

use glam::DVec3;
use palpate_haptics::TipShape;
use palpate_refusal::{Reason, Refusal, Result, did_you_mean, excerpt, unsigned_zero};
use palpate_session::press::ImposedPress;

/// Curves of a file, and their samples, at most.
const MAX_CURVES: usize = 256;
const MAX_SAMPLES: usize = 1 << 20;

/// A measured curve: a press, and the force at each of its times.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasuredCurve {
    /// Its name; empty if the file has one curve without a name.
    pub name: String,
    /// What the tip did.
    pub press: ImposedPress,
    /// Force of the tissue on the tip at each time, outward, N.
    pub force_n: Vec<f64>,
}

/// The tip of curves whose table does not give one.
#[derive(Debug, Clone, Copy)]
pub struct UsualTip {
    /// Its shape.
    pub shape: TipShape,
    /// Its radius, m.
    pub radius_m: f64,
}

/// What a column contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    Time,
    Depth,
    Force,
    Radius,
    Place(usize),
    Curve,
    Tip,
}

/// The names of columns without their unit. The first name of a column is that of refusals.
const COLUMNS: [(&str, Column); 15] = [
    ("time", Column::Time),
    ("t", Column::Time),
    ("depth", Column::Depth),
    ("displacement", Column::Depth),
    ("indentation", Column::Depth),
    ("compression", Column::Depth),
    ("force", Column::Force),
    ("load", Column::Force),
    ("tip_radius", Column::Radius),
    ("place_x", Column::Place(0)),
    ("place_y", Column::Place(1)),
    ("place_z", Column::Place(2)),
    ("curve", Column::Curve),
    ("tip", Column::Tip),
    ("tip_shape", Column::Tip),
];

/// Units in lower case, and their SI value. `mn` is a millinewton, since no lab presses tissue with meganewtons.
const TIMES: [(&str, f64); 4] = [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("min", 60.0)];
const LENGTHS: [(&str, f64); 5] = [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("um", 1e-6), ("µm", 1e-6)];
const FORCES: [(&str, f64); 6] =
    [("n", 1.0), ("mn", 1e-3), ("un", 1e-6), ("µn", 1e-6), ("gf", 9.806_65e-3), ("kgf", 9.806_65)];

impl Column {
    fn units(self) -> &'static [(&'static str, f64)] {
        match self {
            Column::Time => &TIMES,
            Column::Depth | Column::Radius | Column::Place(_) => &LENGTHS,
            Column::Force => &FORCES,
            Column::Curve | Column::Tip => &[],
        }
    }

    fn name(self) -> &'static str {
        COLUMNS.iter().find(|entry| entry.1 == self).map_or("", |entry| entry.0)
    }
}

/// A column of the table: what it contains, the SI value of its unit, and its name in the file.
struct NamedColumn {
    column: Column,
    unit: f64,
    name: String,
}

/// The place of a cell in refusals.
struct Place<'t> {
    file: &'t str,
    line: usize,
}

impl Place<'_> {
    fn refuse(&self, reason: Reason, column: &str, message: impl Into<String>) -> Refusal {
        let place = Some(format!("{}:{}", self.file, self.line));
        Refusal { place, ..Refusal::new(reason, excerpt(column), message) }
    }
}

/// Returns what the name of a column says: `depth_mm`, `Depth (mm)` or `depth [mm]`.
fn column_of(name: &str, at: &Place<'_>) -> Result<NamedColumn> {
    let lower = name.to_lowercase().replace(['(', '[', ')', ']'], " ");
    let words: Vec<&str> = lower.split([' ', '_']).filter(|word| !word.is_empty()).collect();
    let found = |words: &[&str]| COLUMNS.iter().find(|entry| entry.0 == words.join("_")).map(|entry| entry.1);
    if let Some(column) = found(&words) {
        if column.units().is_empty() {
            return Ok(NamedColumn { column, unit: 1.0, name: name.to_owned() });
        }
        let units: Vec<&str> = column.units().iter().map(|unit| unit.0).collect();
        let message = format!("has no unit: write {}_{}, or another of {}", column.name(), units[0], units.join(", "));
        return Err(at.refuse(Reason::WrongKind, name, message));
    }
    let (unit, words) = words.split_last().unwrap_or((&"", &[]));
    let Some(column) = found(words) else {
        let names =
            ["time_s", "depth_m", "force_n", "curve", "tip", "tip_radius_m", "place_x_m", "place_y_m", "place_z_m"];
        let meant = did_you_mean(&lower.replace(' ', "_"), names);
        let message = format!("unknown column{meant}; known are {}, with other units too", names.join(", "));
        return Err(at.refuse(Reason::UnknownKey, name, message));
    };
    let Some((_, unit)) = column.units().iter().find(|entry| entry.0 == *unit) else {
        let units: Vec<&str> = column.units().iter().map(|unit| unit.0).collect();
        let known = if units.is_empty() { "none".to_owned() } else { units.join(", ") };
        let message = format!("unknown unit `{}` of {}; known: {known}", excerpt(unit), column.name());
        return Err(at.refuse(Reason::WrongKind, name, message));
    };
    Ok(NamedColumn { column, unit: *unit, name: name.to_owned() })
}

/// The samples of a curve while it is read.
struct ReadCurve {
    curve: MeasuredCurve,
    lines: Vec<usize>,
    /// The cells that are the same in all rows of a curve, and their columns: of a radius, a shape and a place.
    constant: Vec<String>,
}

/// Reads curves from the text of a table: see docs/fitting.md. `name` is the file in refusals; `usual` is the tip of a table without
/// columns for it.
///
/// # Errors
/// Refuses, with the line and the column, an unknown column or unit, a missing column, a cell that is no finite number, rows of
/// another length, times that do not ascend in a curve, a tip or a place that changes in a curve, a depth that no machine reaches in
/// the time ([`ImposedPress::check`]), more than 256 curves and more than 2^20 samples.
pub fn read_curves(name: &str, text: &str, usual: UsualTip) -> Result<Vec<MeasuredCurve>> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let is_row = |line: &(usize, &str)| !line.1.trim().is_empty() && !line.1.trim_start().starts_with('#');
    let mut lines = text.lines().enumerate().map(|(index, line)| (index + 1, line)).filter(is_row);
    let (line, header) = lines.next().unwrap_or((1, ""));
    let at = Place { file: name, line };
    let separator = [',', ';', '\t'].into_iter().find(|separator| header.contains(*separator)).unwrap_or(',');
    let cells_of = |line| str::split(line, separator).map(|cell| cell.trim().trim_matches('"').trim());
    let columns = cells_of(header).map(|name| column_of(name, &at)).collect::<Result<Vec<NamedColumn>>>()?;
    for (index, column) in columns.iter().enumerate() {
        if columns[..index].iter().any(|other| other.column == column.column) {
            let message = format!("is a second column of {}", column.column.name());
            return Err(at.refuse(Reason::WrongKind, &column.name, message));
        }
    }
    for (column, example) in [(Column::Time, "time_s"), (Column::Depth, "depth_m"), (Column::Force, "force_n")] {
        if columns.iter().all(|other| other.column != column) {
            let message = "the table needs this column, or the same in another unit";
            return Err(at.refuse(Reason::Missing, example, message));
        }
    }
    let mut curves: Vec<ReadCurve> = Vec::new();
    for (samples, (line, text)) in lines.enumerate() {
        let at = Place { file: name, line };
        if samples == MAX_SAMPLES {
            return Err(at.refuse(Reason::TooLarge, "", format!("has more than {MAX_SAMPLES} samples")));
        }
        read_row(&columns, &cells_of(text).collect::<Vec<_>>(), &at, usual, &mut curves)?;
    }
    if curves.is_empty() {
        return Err(at.refuse(Reason::Unreadable, "", "has no rows"));
    }
    for ReadCurve { curve, lines, .. } in &curves {
        curve.press.check().map_err(|refusal| {
            // The field is `depth_m[7]`, say.
            let (field, rest) = refusal.field.split_once('[').unwrap_or((&refusal.field, ""));
            let index = rest.trim_end_matches(']').parse::<usize>().unwrap_or(0);
            let wanted = match field {
                "time_s" => Column::Time,
                "radius_m" => Column::Radius,
                "tip" => Column::Tip,
                _ => Column::Depth,
            };
            let column = columns.iter().find(|column| column.column == wanted);
            let line = lines.get(index).copied().unwrap_or(1);
            let column = column.map_or(field, |column| column.name.as_str());
            Place { file: name, line }.refuse(refusal.reason, column, refusal.message)
        })?;
    }
    Ok(curves.into_iter().map(|read| read.curve).collect())
}

fn read_row(
    columns: &[NamedColumn],
    cells: &[&str],
    at: &Place<'_>,
    usual: UsualTip,
    curves: &mut Vec<ReadCurve>,
) -> Result<()> {
    if cells.len() != columns.len() {
        let message = format!("must have {} cells, as the header, but has {}", columns.len(), cells.len());
        return Err(at.refuse(Reason::Unreadable, "", message));
    }
    let (mut name, mut constant) = ("", Vec::new());
    let (mut time_s, mut depth_m, mut force_n) = (0.0, 0.0, 0.0);
    let (mut shape, mut radius_m, mut place_m) = (usual.shape, usual.radius_m, [None; 3]);
    for (cell, NamedColumn { column, unit, name: column_name }) in cells.iter().zip(columns) {
        let number = || {
            let found = cell.parse::<f64>().ok().filter(|number| number.is_finite());
            found.map(|number| unsigned_zero(number * unit)).ok_or_else(|| {
                let hint = if cell.contains(',') { ": write a point in place of the comma" } else { "" };
                let message = format!("`{}` is not a finite number{hint}", excerpt(cell));
                at.refuse(Reason::Unreadable, column_name, message)
            })
        };
        match column {
            Column::Time => time_s = number()?,
            Column::Depth => depth_m = number()?,
            Column::Force => force_n = number()?,
            Column::Radius => radius_m = number()?,
            Column::Place(axis) => place_m[*axis] = Some(number()?),
            Column::Curve => name = cell,
            Column::Tip => {
                shape = cell.parse().map_err(|message: String| at.refuse(Reason::WrongKind, column_name, message))?;
            }
        }
        if matches!(column, Column::Radius | Column::Place(_) | Column::Tip) {
            constant.push((*cell).to_owned());
        }
    }
    palpate_refusal::label("curve", name).map_err(|refusal| at.refuse(refusal.reason, "curve", refusal.message))?;
    if curves.last().is_none_or(|last| last.curve.name != name) {
        // A curve whose rows are apart would be found by its times; names are few.
        if curves.iter().any(|other| other.curve.name == name) {
            let message = format!("`{}` comes again: the rows of a curve must follow one another", excerpt(name));
            return Err(at.refuse(Reason::WrongKind, "curve", message));
        }
        if curves.len() == MAX_CURVES {
            return Err(at.refuse(Reason::TooLarge, "curve", format!("is one more than {MAX_CURVES} curves")));
        }
        let place_m = place_m.iter().any(Option::is_some).then(|| DVec3::from_array(place_m.map(|x| x.unwrap_or(0.0))));
        let press = ImposedPress { place_m, shape, radius_m, time_s: Vec::new(), depth_m: Vec::new() };
        let curve = MeasuredCurve { name: name.to_owned(), press, force_n: Vec::new() };
        curves.push(ReadCurve { curve, lines: Vec::new(), constant: constant.clone() });
    }
    let Some(ReadCurve { curve, lines, constant: first }) = curves.last_mut() else { return Ok(()) };
    if let Some(index) = first.iter().zip(&constant).position(|(first, now)| first != now) {
        let is_constant =
            |column: &&NamedColumn| matches!(column.column, Column::Radius | Column::Place(_) | Column::Tip);
        let column = columns.iter().filter(is_constant).nth(index).map_or("", |column| column.name.as_str());
        let message = format!(
            "changes within a curve, from `{}`: give each curve its own name in a column `curve`",
            excerpt(&first[index])
        );
        return Err(at.refuse(Reason::WrongKind, column, message));
    }
    if let Some(last_s) = curve.press.time_s.last().filter(|last_s| **last_s >= time_s) {
        let column = columns.iter().find(|column| column.column == Column::Time).map_or("", |column| &column.name);
        let hint = if columns.iter().any(|column| column.column == Column::Curve) {
            ""
        } else {
            ": several curves in one table need a column `curve` with their names"
        };
        let message = format!("must ascend, but is {time_s} s after {last_s} s{hint}");
        return Err(at.refuse(Reason::OutOfRange, column, message));
    }
    curve.press.time_s.push(time_s);
    curve.press.depth_m.push(depth_m);
    curve.force_n.push(force_n);
    lines.push(at.line);
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const USUAL: UsualTip = UsualTip { shape: TipShape::Disc, radius_m: 0.005 };

    fn read(text: &str) -> Result<Vec<MeasuredCurve>> {
        read_curves("lab.csv", text, USUAL)
    }

    #[test]
    fn units_of_a_labs_header_are_converted_and_curves_are_told_apart_by_their_name() {
        let text = "# machine 7\nCurve;Tip;Tip radius (mm);Time (ms);Depth [um];Force (mN)\n\
                    a;sphere;4;0;0;0\na;sphere;4;500;250;31.5\n\nb;rigid;6;0;0;0\nb;rigid;6;100;-20;0\n";
        let curves = read(text).unwrap();
        assert_eq!(curves.len(), 2);
        let MeasuredCurve { name, press, force_n } = &curves[0];
        assert_eq!((name.as_str(), press.shape, press.radius_m, press.place_m), ("a", TipShape::Sphere, 0.004, None));
        assert_eq!((&press.time_s, &press.depth_m, force_n), (&vec![0.0, 0.5], &vec![0.0, 2.5e-4], &vec![0.0, 0.0315]));
        assert_eq!((curves[1].press.shape, curves[1].press.depth_m[1]), (TipShape::RigidDisc, -20.0 * 1e-6));
        let placed = read("time_s,depth_m,force_n,place_x_mm,place_y_mm\n0,0,0,12,-3\n1,0.001,1,12,-3\n").unwrap();
        assert!((placed[0].press.place_m.unwrap() - DVec3::new(0.012, -0.003, 0.0)).length() < 1e-15);
        assert_eq!((placed[0].press.shape, placed[0].press.radius_m), (TipShape::Disc, 0.005));
    }

    #[test]
    fn every_refusal_names_line_and_column() {
        let good = "time_s,depth_m,force_n\n0,0,0\n";
        for (text, expected) in [
            ("time_s,depth_m\n", "lab.csv:1: force_n: the table needs this column"),
            ("time_s,depth_m,force_lb\n", "lab.csv:1: force_lb: unknown unit `lb` of force; known: n, mn"),
            ("time_s,depth,force_n\n", "lab.csv:1: depth: has no unit: write depth_m"),
            ("time_s,dept_m,force_n\n", "lab.csv:1: dept_m: unknown column; did you mean `depth_m`?"),
            ("time_s,depth_m,depth_mm,force_n\n", "lab.csv:1: depth_mm: is a second column of depth"),
            ("time_s,depth_m,force_n\n", "lab.csv:1: has no rows"),
            ("time_s,depth_m,force_n\n0,0,0\n", "lab.csv:2: time_s: must be 2 to 1048576 times"),
            (&format!("{good}1,0.001\n"), "lab.csv:3: must have 3 cells, as the header, but has 2"),
            (&format!("{good}1,x,0\n"), "lab.csv:3: depth_m: `x` is not a finite number"),
            (&format!("{good}1,inf,0\n"), "lab.csv:3: depth_m: `inf` is not a finite number"),
            (&format!("{good}0,0.001,0\n"), "lab.csv:3: time_s: must ascend, but is 0 s after 0 s: several curves"),
            (&format!("{good}1,0.9,0\n"), "lab.csv:3: depth_m: must be reached with at most 0.5 m/s"),
            ("time_s;depth_m;force_n\n0;0;0,5\n", "lab.csv:2: force_n: `0,5` is not a finite number: write a point"),
            ("time_s,depth_m,force_n,tip\n0,0,0,cube\n", "lab.csv:2: tip: must be one of disc, rigid, sphere"),
            (
                "time_s,depth_m,force_n,tip\n0,0,0,disc\n1,0,0,rigid\n",
                "lab.csv:3: tip: changes within a curve, from `disc`",
            ),
            ("time_s,depth_m,force_n,tip_radius_m\n0,0,0,-1\n1,0,0,-1\n", "lab.csv:2: tip_radius_m: must be above 0"),
            (
                "curve,time_s,depth_m,force_n\na,0,0,0\nb,0,0,0\na,1,0,0\n",
                "lab.csv:4: curve: `a` comes again: the rows of a curve must follow one another",
            ),
        ] {
            let refusal = read(text).unwrap_err().to_string();
            assert!(refusal.starts_with(expected), "{refusal}\nis not\n{expected}");
        }
    }
}
