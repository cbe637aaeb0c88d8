//! Reads an exercise from TOML, and checks it.

use glam::DVec3;

use super::collection::{Collection, is_name, name_in};
use super::exercise::{
    AvoidedRegion, CoverageTask, Criterion, CutLine, Exercise, ExerciseLimits, ExercisePhase, FeltLump, HiddenLumps,
    LiftTask, MAX_PARTS, MAX_PHASES, TraineeView,
};
use super::kind::TextKind;
use super::toml_document::{Document, Fields, Item};
use crate::files;
use crate::limits::Limits;
use palpate_haptics::Tip;
use palpate_refusal::{Reason, Refusal, Result, not_negative, number, positive};
use std::path::Path;

/// Folder of the exercises that a user of the programs can give by name.
pub const EXERCISES: &str = "exercises";

/// Returns the exercise that a user gave, as the name that refusals use for it and its text: the path of a file, or the name of one in
/// ./exercises or of a built-in one. A plain word that is not a file of the working directory is a name.
///
/// # Errors
/// Refuses an unknown name and a file that can't be read. The text is not checked ([`Exercise::parse`]).
pub fn find_exercise(path: &Path, limits: &Limits) -> Result<(String, String)> {
    match name_in(path) {
        Some(name) => {
            let scenes = Collection::new(TextKind::Scene, Path::new("scenes"));
            Collection::new(TextKind::Exercise, Path::new(EXERCISES)).for_user().text(name, &scenes, limits)
        }
        None => Ok((path.display().to_string(), files::read_text(path, limits.file_bytes)?)),
    }
}

impl Exercise {
    /// Reads an exercise from TOML text. Refusals call the text `name`.
    ///
    /// # Errors
    /// Refuses a text that is not TOML, a scene or a script, unknown and missing keys, values of the wrong kind or out of range, an
    /// exercise without a scene, names of criteria that occur twice, and lumps that have no room in their box.
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        let document = Document::parse(name, text)?;
        TextKind::Exercise.check(&document)?;
        document.read(read)
    }
}

fn read(fields: &mut Fields<'_>) -> Result<Exercise> {
    let name = fields.required("name")?.text()?;
    if !is_name(&name) {
        let message = "must have letters and digits of ASCII, `-` and `_` only, like the name of its file";
        return Err(fields.refuse(Reason::WrongKind, "name", message));
    }
    let exercise = Exercise {
        title: fields.text("title")?.unwrap_or_else(|| name.clone()),
        name,
        instructions: fields.required("instructions")?.text()?.trim().to_owned(),
        scenes: scenes(fields)?,
        set: fields.item("set").map_or(Ok(Vec::new()), |item| item.list()?.iter().map(Item::text).collect())?,
        seed: fields.item("seed").map_or(Ok(1), |item| item.whole())?,
        time_limit_s: positive_or_none(fields, "time_limit_s")?,
        phases: parts(fields, "phase", MAX_PHASES)?.iter().map(|item| item.table(phase)).collect::<Result<_>>()?,
        seen_along: seen_along(fields)?,
        lumps: fields.item("lumps").map(|item| item.table(lumps)).transpose()?,
        lines: parts(fields, "line", MAX_PARTS)?.iter().map(|item| item.table(line)).collect::<Result<_>>()?,
        avoid: parts(fields, "avoid", MAX_PARTS)?.iter().map(|item| item.table(avoided)).collect::<Result<_>>()?,
        lift: fields.item("lift").map(|item| item.table(lift)).transpose()?,
        coverage: fields.item("coverage").map(|item| item.table(coverage)).transpose()?,
        limits: fields.item("limits").map_or(Ok(ExerciseLimits::default()), |item| item.table(limits))?,
        criteria: criteria(fields)?,
        trainee: fields.item("trainee").map_or(Ok(TraineeView::default()), |item| item.table(trainee))?,
    };
    check_phases(&exercise)?;
    if exercise.lumps(exercise.seed).is_none() {
        let message = "have no room in the box from `from_m` to `to_m`: make it larger, or the lumps fewer, smaller or less apart";
        return Err(fields.refuse(Reason::OutOfRange, "lumps", message));
    }
    Ok(exercise)
}

/// Returns the entries of `[[key]]`, at most `most`; none if the key is absent.
fn parts<'a>(fields: &mut Fields<'a>, key: &'static str, most: usize) -> Result<Vec<Item<'a>>> {
    let items = fields.item(key).map_or(Ok(Vec::new()), |item| item.tables())?;
    if items.len() > most {
        let message = format!("has {} entries, more than {most}", items.len());
        return Err(fields.refuse(Reason::TooLarge, key, message));
    }
    Ok(items)
}

fn positive_or_none(fields: &mut Fields<'_>, key: &'static str) -> Result<Option<f64>> {
    let path = fields.path(key);
    fields.number(key)?.map(|value| positive(&path, value)).transpose()
}

fn required_positive(fields: &mut Fields<'_>, key: &'static str) -> Result<f64> {
    let path = fields.path(key);
    positive(&path, fields.required_number(key)?)
}

/// Reads a number that is 0 or more.
fn distance(fields: &mut Fields<'_>, key: &'static str, default: f64) -> Result<f64> {
    let path = fields.path(key);
    not_negative(&path, fields.number(key)?.unwrap_or(default))
}

fn scenes(fields: &mut Fields<'_>) -> Result<Vec<String>> {
    let item = fields.required("scenes")?;
    let scenes = item.list()?.iter().map(Item::text).collect::<Result<Vec<_>>>()?;
    if scenes.is_empty() {
        return Err(item.refuse(Reason::Missing, "must name at least one scene"));
    }
    Ok(scenes)
}

/// Reads a range: one number, or [least, most].
fn range(fields: &mut Fields<'_>, key: &'static str, [least, most]: [f64; 2]) -> Result<[f64; 2]> {
    let item = fields.required(key)?;
    let ends = match item.number() {
        Ok(value) => [value; 2],
        Err(_) if item.list().is_err() => return Err(item.wrong("a whole number, or [least, most]")),
        Err(_) => match item.list()?.iter().map(Item::number).collect::<Result<Vec<_>>>()?.as_slice() {
            [least, most] => [*least, *most],
            _ => return Err(item.wrong("a number, or [least, most]")),
        },
    };
    let path = fields.path(key);
    for end in ends {
        number(&path, end, &format!("from {least} to {most}"), |v| (least..=most).contains(&v))?;
    }
    if ends[0] > ends[1] {
        return Err(item.refuse(Reason::OutOfRange, "must be [least, most], but the first is larger"));
    }
    Ok(ends)
}

fn count(fields: &mut Fields<'_>) -> Result<[u64; 2]> {
    let item = fields.required("count")?;
    let ends = match item.whole() {
        Ok(count) => [count; 2],
        Err(_) => match item.list()?.iter().map(Item::whole).collect::<Result<Vec<_>>>()?.as_slice() {
            [least, most] => [*least, *most],
            _ => return Err(item.wrong("a whole number, or [least, most]")),
        },
    };
    if ends[0] > ends[1] || ends[1] > MAX_PARTS as u64 {
        let message = format!("must be [least, most], both from 0 to {MAX_PARTS}, and least at most most");
        return Err(item.refuse(Reason::OutOfRange, message));
    }
    Ok(ends)
}

/// Reads the direction along which the trainee looks; downwards by default.
fn seen_along(fields: &mut Fields<'_>) -> Result<DVec3> {
    let Some(item) = fields.item("seen_along") else { return Ok(DVec3::NEG_Z) };
    let direction = item.vector()?.try_normalize();
    direction.ok_or_else(|| item.refuse(Reason::OutOfRange, "must not be 0: it is a direction"))
}

/// Smallest and largest radius of a lump, m.
const MIN_RADIUS_M: f64 = 1e-6;
const MAX_RADIUS_M: f64 = 1.0;

/// Range of a lump's stiffness inside over that outside.
const STIFFNESS_FACTORS: [f64; 2] = [0.01, 100.0];

fn lumps(fields: &mut Fields<'_>) -> Result<HiddenLumps> {
    let from_m = fields.required("from_m")?.vector()?;
    let to_m = fields.required("to_m")?.vector()?;
    if from_m.cmpgt(to_m).any() {
        let message = "must not be below `from_m` along any axis: they are the least and the greatest corner of a box";
        return Err(fields.refuse(Reason::OutOfRange, "to_m", message));
    }
    Ok(HiddenLumps {
        count: count(fields)?,
        radius_m: range(fields, "radius_m", [MIN_RADIUS_M, MAX_RADIUS_M])?,
        stiffness_factor: range(fields, "stiffness_factor", STIFFNESS_FACTORS)?,
        from_m,
        to_m,
        apart_m: distance(fields, "apart_m", 0.0)?,
        found_within_m: distance(fields, "found_within_m", 0.0)?,
    })
}

fn phase(fields: &mut Fields<'_>) -> Result<ExercisePhase> {
    Ok(ExercisePhase {
        title: fields.required("title")?.text()?,
        instructions: fields.required("instructions")?.text()?.trim().to_owned(),
        time_limit_s: positive_or_none(fields, "time_limit_s")?,
    })
}

/// Refuses criteria of phases that the exercise has not.
fn check_phases(exercise: &Exercise) -> Result<()> {
    for (index, criterion) in exercise.criteria.iter().enumerate() {
        let count = exercise.phases.len();
        if criterion.phase.is_some_and(|phase| phase == 0 || phase as usize > count) {
            let message = match count {
                0 => "names a phase of an exercise that has no [[phase]]".to_owned(),
                _ => format!("must be a phase, from 1 to {count}"),
            };
            return Err(Refusal::new(Reason::OutOfRange, format!("criterion[{index}].phase"), message));
        }
    }
    Ok(())
}

fn line(fields: &mut Fields<'_>) -> Result<CutLine> {
    let item = fields.required("points_m")?;
    let points_m = item.list()?.iter().map(Item::vector).collect::<Result<Vec<_>>>()?;
    if !(2..=MAX_PARTS).contains(&points_m.len()) || points_m.windows(2).any(|ends| ends[0] == ends[1]) {
        let message = format!("must be 2 to {MAX_PARTS} places, each other than the one before it");
        return Err(item.refuse(Reason::OutOfRange, message));
    }
    Ok(CutLine { points_m, within_m: required_positive(fields, "within_m")? })
}

fn avoided(fields: &mut Fields<'_>) -> Result<AvoidedRegion> {
    Ok(AvoidedRegion {
        centre_m: fields.required("centre_m")?.vector()?,
        radius_m: required_positive(fields, "radius_m")?,
    })
}

fn lift(fields: &mut Fields<'_>) -> Result<LiftTask> {
    Ok(LiftTask {
        place_m: fields.required("place_m")?.vector()?,
        height_m: required_positive(fields, "height_m")?,
        hold_s: required_positive(fields, "hold_s")?,
    })
}

fn coverage(fields: &mut Fields<'_>) -> Result<CoverageTask> {
    let lump = fields.item("lump").map(|item| item.table(felt_lump)).transpose()?;
    match (positive_or_none(fields, "pressure_pa")?, lump) {
        (Some(pressure_pa), None) => Ok(CoverageTask::Pressure(pressure_pa)),
        (None, Some(lump)) => Ok(CoverageTask::Lump(lump)),
        (None, None) => Err(fields.refuse(Reason::Missing, "pressure_pa", "is missing, or else `lump`")),
        (Some(_), Some(_)) => Err(fields.refuse(
            Reason::WrongKind,
            "lump",
            "does not go with `pressure_pa`: the pressure follows from the lump",
        )),
    }
}

fn felt_lump(fields: &mut Fields<'_>) -> Result<FeltLump> {
    let default_m = Tip::default().radius_m;
    Ok(FeltLump {
        radius_m: within(fields, "radius_m", [MIN_RADIUS_M, MAX_RADIUS_M], None)?,
        depth_m: distance(fields, "depth_m", 0.0)?,
        stiffness_factor: within(fields, "stiffness_factor", STIFFNESS_FACTORS, None)?,
        tip_radius_m: within(fields, "tip_radius_m", [MIN_RADIUS_M, MAX_RADIUS_M], Some(default_m))?,
    })
}

/// Reads a number from `least` to `most`, required without a default.
fn within(fields: &mut Fields<'_>, key: &'static str, [least, most]: [f64; 2], default: Option<f64>) -> Result<f64> {
    let path = fields.path(key);
    let given = if default.is_some() { fields.number(key)? } else { Some(fields.required_number(key)?) };
    number(&path, given.or(default).unwrap_or(least), &format!("from {least} to {most}"), |v| {
        (least..=most).contains(&v)
    })
}

fn limits(fields: &mut Fields<'_>) -> Result<ExerciseLimits> {
    Ok(ExerciseLimits {
        force_n: positive_or_none(fields, "force_n")?,
        pressure_pa: positive_or_none(fields, "pressure_pa")?,
        strain: positive_or_none(fields, "strain")?,
    })
}

fn trainee(fields: &mut Fields<'_>) -> Result<TraineeView> {
    let names = |item: Item<'_>| item.list()?.iter().map(Item::text).collect::<Result<Vec<_>>>();
    Ok(TraineeView {
        live_measures: fields.item("live_measures").map(names).transpose()?,
        sees_result: fields.item("sees_result").map_or(Ok(true), |item| item.flag())?,
    })
}

fn criteria(fields: &mut Fields<'_>) -> Result<Vec<Criterion>> {
    let criterion = |fields: &mut Fields<'_>| {
        let (poor, good) = (fields.required_number("poor")?, fields.required_number("good")?);
        if poor == good {
            let message = "must differ from `poor`: between both the points are in proportion";
            return Err(fields.refuse(Reason::OutOfRange, "good", message));
        }
        let path = fields.path("weight");
        let weight = positive(&path, fields.number("weight")?.unwrap_or(1.0))?;
        // Saturating: a number beyond all phases is refused.
        let phase = |item: Item<'_>| item.whole().map(|phase| u32::try_from(phase).unwrap_or(u32::MAX));
        let phase = fields.item("phase").map(phase).transpose()?;
        Ok(Criterion { measure: fields.required("measure")?.text()?, phase, weight, poor, good })
    };
    let criteria =
        parts(fields, "criterion", MAX_PARTS)?.iter().map(|item| item.table(criterion)).collect::<Result<Vec<_>>>()?;
    for (index, criterion) in criteria.iter().enumerate() {
        let is_same = |other: &Criterion| other.measure == criterion.measure && other.phase == criterion.phase;
        if criteria[..index].iter().any(is_same) {
            let field = format!("criterion[{index}].measure");
            return Err(Refusal::new(Reason::OutOfRange, field, "occurs twice: give each measure one weight"));
        }
    }
    Ok(criteria)
}

#[cfg(test)]
mod tests {
    use super::super::exercise::BUILT_IN;
    use super::*;

    const LUMPS: &str = r#"
name = "mine"
instructions = "Find them."
scenes = ["phantom"]
[lumps]
count = [1, 3]
radius_m = [0.005, 0.008]
stiffness_factor = 5
from_m = [-0.03, -0.03, 0.02]
to_m = [0.03, 0.03, 0.03]
apart_m = 0.01
"#;

    #[test]
    fn shipped_exercises_are_read_and_have_the_names_of_their_files() {
        for (name, text) in BUILT_IN {
            let exercise = Exercise::parse(name, text).unwrap_or_else(|refusal| panic!("{refusal}"));
            assert_eq!(exercise.name, name);
            assert!(!exercise.criteria.is_empty() && exercise.instructions.len() > 40, "{name}");
        }
        assert!(BUILT_IN.is_sorted_by_key(|(name, _)| *name));
    }

    #[test]
    fn lumps_of_a_seed_are_the_same_and_keep_their_distance_in_their_box() {
        let exercise = Exercise::parse("mine.toml", LUMPS).unwrap();
        let hidden = exercise.lumps.as_ref().unwrap();
        let mut counts = [0; 4];
        for seed in 0..200 {
            let lumps = exercise.lumps(seed).unwrap();
            assert_eq!(lumps, exercise.lumps(seed).unwrap());
            counts[lumps.len()] += 1;
            for (index, lump) in lumps.iter().enumerate() {
                assert!(lump.centre_m.cmpge(hidden.from_m).all() && lump.centre_m.cmple(hidden.to_m).all(), "{lump:?}");
                assert!((0.005..=0.008).contains(&lump.radius_m) && lump.stiffness_factor == 5.0, "{lump:?}");
                for other in &lumps[..index] {
                    let gap_m = other.centre_m.distance(lump.centre_m) - other.radius_m - lump.radius_m;
                    assert!(gap_m >= 0.01, "{gap_m}");
                }
            }
        }
        assert!(counts[0] == 0 && counts[1..].iter().all(|count| *count > 40), "{counts:?}");
        // A scene takes what is drawn.
        let assignments = exercise.assignments(&exercise.lumps(1).unwrap());
        let scene = super::super::collection::find_scene(
            Path::new("phantom"),
            Path::new("no-such-folder"),
            &assignments,
            &Limits::default(),
        );
        assert!(scene.is_ok(), "{scene:?}");
    }

    #[test]
    fn what_is_wrong_in_an_exercise_is_named_with_its_line() {
        for (from, to, wanted) in [
            ("count = [1, 3]", "count = [3, 1]", "mine.toml:6: lumps.count: must be [least, most]"),
            ("count = [1, 3]", "count = [1, 3]\ncolour = 1", "mine.toml:7: lumps.colour: unknown key"),
            (
                "radius_m = [0.005, 0.008]",
                "radius_m = [0.005]",
                "mine.toml:7: lumps.radius_m: must be a number, or [least, most]",
            ),
            ("apart_m = 0.01", "apart_m = 1.0", "mine.toml:5: lumps: have no room in the box"),
            ("apart_m = 0.01", "apart_m = -1.0", "mine.toml:11: lumps.apart_m"),
            ("scenes = [\"phantom\"]", "scenes = []", "mine.toml:4: scenes: must name at least one scene"),
            ("scenes = [\"phantom\"]", "", "mine.toml:1: scenes: is missing"),
            ("name = \"mine\"", "name = \"my own\"", "mine.toml:2: name: must have letters"),
            (
                "[lumps]",
                "[[criterion]]\nmeasure = \"time_s\"\npoor = 1\ngood = 1\n[lumps]",
                "mine.toml:8: criterion[0].good: must differ",
            ),
            ("[lumps]", "[[phase]]\ntitle = \"One\"\n[lumps]", "mine.toml:5: phase[0].instructions: is missing"),
            (
                "[lumps]",
                "[[phase]]\ntitle = \"One\"\ninstructions = \"Do.\"\n[[criterion]]\nmeasure = \"time_s\"\nphase = 2\npoor = 1\ngood = 2\n[lumps]",
                "mine.toml:10: criterion[0].phase: must be a phase, from 1 to 1",
            ),
            (
                "[lumps]",
                "[coverage]\npressure_pa = 1\nlump = { radius_m = 0.01, stiffness_factor = 5 }\n[lumps]",
                "mine.toml:7: coverage.lump: does not go with `pressure_pa`",
            ),
            ("[lumps]", "[coverage]\n[lumps]", "mine.toml:5: coverage.pressure_pa: is missing, or else `lump`"),
            (
                "[lumps]",
                "[coverage]\nlump = { radius_m = 2, stiffness_factor = 5 }\n[lumps]",
                "mine.toml:6: coverage.lump.radius_m",
            ),
            (
                "[lumps]",
                "[[criterion]]\nmeasure = \"time_s\"\nphase = 1\npoor = 1\ngood = 2\n[lumps]",
                "mine.toml:7: criterion[0].phase: names a phase of an exercise that has no",
            ),
        ] {
            assert!(LUMPS.contains(from), "{from}");
            let refusal = Exercise::parse("mine.toml", &LUMPS.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(refusal.starts_with(wanted), "{refusal}\nwanted {wanted}");
        }
        let scene = Exercise::parse("mine.toml", "[sheet]\npoints = [3, 3]\n").unwrap_err().to_string();
        assert!(scene.starts_with("mine.toml: is a scene"), "{scene}");
    }
}
