//! Reads a script from TOML and binds it to a scene: converts times to whole steps and points to places.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};
use palpate_haptics::instrument::MAX_TIPS;
use palpate_haptics::instrument_pose::MAX_JAW_RAD;
use palpate_haptics::jaw_limit::MAX_JAW_TORQUE_LIMIT_N_M;
use palpate_haptics::port::{DEFAULT_HANDLE_M, HANDLE_M};
use palpate_haptics::{Coupling, Instrument, InstrumentPart, InstrumentPose, InstrumentTip, Port, Tip, TipShape};

use super::action::{MAX_MARKS, PlaceMark};
use super::exercise::MAX_PHASES;
use super::kind::TextKind;
use super::profile::{
    CentreProfile, InstrumentProfile, LoadProfile, Moment, MotionProfile, Move, PoseProfile, Profile, StrengthProfile,
    TieProfile, weights,
};
use super::script::Script;
use super::{Change, Scene};
use crate::files;
use crate::limits::Limits;
use crate::scene::action_check::{check_force, check_free, check_mark, check_reach, check_tie, check_tip};
use crate::scene::tie::{Bite, Tie, TieKind};
use crate::scene::toml_document::{Document, Fields, Item};
use crate::shape::{self, PointId};
use palpate_refusal::{Reason, Refusal, Result, did_you_mean, legible, not_negative, number, positive, unsigned_zero};

impl Script {
    /// Reads a script file and binds it to `scene`. The path may be a pipe. Its traces are in the file's
    /// folder.
    ///
    /// # Errors
    /// Refuses a file that can't be read, is not UTF-8 or has more than `limits.file_bytes` bytes
    /// ([`files::read_text`]), and everything that [`Script::parse`] refuses.
    pub fn load(path: &Path, scene: &Scene, limits: &Limits) -> Result<Self> {
        let text = files::read_text(path, limits.file_bytes)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse(&path.display().to_string(), &text, folder, scene, limits)
    }

    /// Reads a script from TOML text and binds it to `scene`: converts times to whole steps (with a warning
    /// where they aren't) and finds points and places. Refusals call the text `name`; it reads the traces that
    /// the text names from `folder`. A script made for other scenes is only warned of.
    ///
    /// # Errors
    /// Refuses
    ///
    /// - a text that is not TOML, a scene, unknown and missing keys, and values of the wrong kind;
    /// - a duration or sample interval of less than half a step, times that don't ascend, a move shorter than 1
    ///   µs;
    /// - a point or place that is not on the tissue, a fixed or twice grasped point;
    /// - a force above `limits.point_force_n`, a reach above `limits.reach_in_sides`, more tools than
    ///   `limits.tools`;
    /// - a tip that does not suit the tissue ([`check_tip`]), and a change after which [`Scene::check`] refuses
    ///   the scene;
    /// - a trace that can't be read, has more than `limits.trace_bytes` bytes, or is not a table of ascending
    ///   times and forces.
    pub fn parse(name: &str, text: &str, folder: &Path, scene: &Scene, limits: &Limits) -> Result<Self> {
        let document = Document::parse(name, text)?;
        TextKind::Script.check(&document)?;
        document.read(|fields| Binding { folder, scene, limits, warnings: Vec::new() }.script(fields))
    }
}

/// Shortest move, s. A shorter one would need accelerations beyond the number range.
const SHORTEST_MOVE_S: f64 = 1e-6;

/// The smallest allowed sum of the weights of a force with a radius.
const MIN_WEIGHT: f64 = 1e-3;

/// Highest frequency, Hz. Beyond it, a phase has no digits left.
const HIGHEST_HZ: f64 = 1e6;

/// The inputs of reading a script.
struct Binding<'s> {
    folder: &'s Path,
    scene: &'s Scene,
    limits: &'s Limits,
    warnings: Vec<String>,
}

impl Binding<'_> {
    fn script(mut self, fields: &mut Fields<'_>) -> Result<Script> {
        let name = fields.text("name")?.unwrap_or_else(|| "unnamed".to_owned());
        let scenes = read_scenes(fields)?;
        if !is_made_for(&scenes, &self.scene.name) {
            let (made_for, is) = (scenes.join(", "), &self.scene.name);
            self.warnings.push(format!("scenes: made for {made_for}; on `{is}` it may be too strong or too weak"));
        }
        let duration_s = positive("duration_s", fields.required_number("duration_s")?)?;
        let steps = self.steps("duration_s", duration_s)?;
        let sample_every_s = positive("sample_every_s", fields.required_number("sample_every_s")?)?;
        let sample_every = self.steps("sample_every_s", sample_every_s)?;
        for (field, steps) in [("duration_s", steps), ("sample_every_s", sample_every)] {
            if steps == 0 {
                return Err(Refusal::new(Reason::OutOfRange, field, "is less than half a step"));
            }
        }
        let mut control_points = Vec::new();
        let forces = items(fields, "force")?
            .iter()
            .map(|item| self.force(item, &mut control_points))
            .collect::<Result<Vec<_>>>()?;
        for (index, profile) in forces.iter().enumerate() {
            let end = profile.at(Moment::start_of(steps), self.scene.stepping.rate_hz);
            if matches!(profile.centre, CentreProfile::Path { .. }) && !self.scene.shape().is_near(end.centre_m) {
                let message = "leaves the tissue; if the force is streamed (--held, a replay), it ends there";
                self.warnings.push(format!("force[{index}].path: {message}"));
            }
        }
        let (mut moves, mut poses) = (Vec::new(), Vec::new());
        let mut blades = Vec::new();
        for item in items(fields, "tool")? {
            if item.has("blade") {
                blades.push(item);
                continue;
            }
            match self.tool(&item)? {
                ToolTable::Moves(profile) => moves.push(profile),
                ToolTable::Poses(profile) => poses.push(profile),
            }
        }
        let mut instruments = Vec::new();
        for item in blades.into_iter().chain(items(fields, "instrument")?) {
            let first_tool = forces.len() + moves.len() + poses.len();
            let profile = Arc::new(self.instrument(&item, first_tool)?);
            poses.extend((0..profile.instrument.tips.len()).map(|tip| mounted(&profile, tip)));
            instruments.push(profile);
        }
        let ties = self.ties(fields)?;
        let marks = self.marks(fields, steps)?;
        let phase_ends = self.phase_ends(fields, steps)?;
        control_points.extend(moves.iter().map(|profile| profile.point));
        // A row of tips would make many.
        let of_tools = poses.iter().filter(|profile: &&PoseProfile| profile.mounted.is_none());
        let places_m = of_tools.flat_map(|profile| profile.poses.iter().map(|pose| pose.1));
        let of_instruments = instruments.iter().flat_map(|profile| profile.poses.iter().map(|pose| pose.1.place_m));
        control_points.extend(places_m.chain(of_instruments).map(|place_m| named_nearest(self.scene.shape(), place_m)));
        for (index, profile) in moves.iter().enumerate() {
            if moves[..index].iter().any(|other| other.point == profile.point) {
                let message = "is prescribed by two tools";
                return Err(Refusal::new(Reason::OutOfRange, format!("tool[{index}].point"), message));
            }
        }
        let changes = self.changes(&items(fields, "tissue")?)?;
        let tools = forces.len() + moves.len() + poses.len() + usize::from(!ties.is_empty() || !marks.is_empty());
        if tools > self.limits.tools as usize {
            let message = format!(
                "a script uses {tools} tools (one for each [[force]], each [[tool]] and each tip of an [[instrument]], and one for all \
                 threads, clips and marks), above the limit of {}",
                self.limits.tools
            );
            return Err(Refusal::new(Reason::TooLarge, "force", message));
        }
        let sample_points = match fields.item("sample_points") {
            None => control_points,
            Some(item) if item.as_text() == Some("all") => shape::points(self.scene.shape()).collect(),
            Some(item) if item.as_text().is_some() => return Err(item.wrong("\"all\" or a list of points")),
            Some(item) => item.list()?.iter().map(|item| self.point(item)).collect::<Result<Vec<_>>>()?,
        };
        let mut seen = BTreeSet::new();
        Ok(Script {
            name,
            steps,
            sample_every,
            sample_points: sample_points.into_iter().filter(|point| seen.insert(*point)).collect(),
            forces,
            moves,
            poses,
            instruments,
            ties,
            marks,
            phase_ends,
            changes,
            warnings: self.warnings,
            rate_hz: self.scene.stepping.rate_hz,
            shape: self.scene.shared_shape(),
        })
    }

    /// Returns a time as whole steps. Adds a warning if rounding moves it by more than a millionth of a step.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn steps(&mut self, field: &str, time_s: f64) -> Result<u64> {
        let exact = not_negative(field, time_s)? * self.scene.stepping.rate_hz;
        let whole = exact.round();
        number(field, whole, "less than 2^52 steps", |v| v < 4.5e15)?;
        if (exact - whole).abs() > 1e-6 {
            let rounded_s = whole / self.scene.stepping.rate_hz;
            self.warnings.push(format!("{field}: {time_s} s is not a whole number of steps; taken as {rounded_s} s"));
        }
        Ok(whole as u64)
    }

    /// Returns the point of the tissue that an item names.
    fn point(&self, item: &Item<'_>) -> Result<PointId> {
        self.scene.shape().find("", item.point_name()?).map_err(|refusal| item.refuse(refusal.reason, refusal.message))
    }

    /// Returns the point that a table names: `point` on a sheet, `vertex` on a mesh, or the one nearest to
    /// `at_m`.
    fn point_of(&self, fields: &mut Fields<'_>) -> Result<PointId> {
        if let Some(at) = fields.item("at_m") {
            let at_m = self.place(&at)?;
            self.scene.shape().check_place(&fields.path("at_m"), at_m)?;
            return Ok(self.scene.shape().nearest(at_m));
        }
        match fields.item("vertex") {
            Some(vertex) => self.point(&vertex),
            None => self.point(&fields.required("point")?),
        }
    }

    /// Returns a place on the tissue, m: [x, y] on a sheet, [x, y, z] on a mesh.
    fn place(&self, item: &Item<'_>) -> Result<DVec3> {
        item.place_in(self.scene.shape().dimensions())
    }

    /// Reads changes of the tissue. Each is checked together with those before it.
    fn changes(&mut self, list: &[Item<'_>]) -> Result<Vec<(u64, Change)>> {
        let mut scene = self.scene.clone();
        let mut changes: Vec<(u64, Change)> = Vec::new();
        for item in list {
            let (at, change) = item.table(|fields| {
                let at = self.steps(&fields.path("at_s"), fields.required_number("at_s")?)?;
                if changes.last().is_some_and(|last| last.0 >= at) {
                    return Err(fields.refuse(
                        Reason::OutOfRange,
                        "at_s",
                        "must be later than that of the change before",
                    ));
                }
                let change = Change {
                    stiffness_n_per_m: fields.number("stiffness_n_per_m")?,
                    damping_n_s_per_m: fields.number("damping_n_s_per_m")?,
                    anchor_stiffness_n_per_m: fields.number("anchor_stiffness_n_per_m")?,
                    volume_stiffness_pa: fields.number("volume_stiffness_pa")?,
                };
                Ok((at, change))
            })?;
            if change == Change::default() {
                return Err(item.refuse(Reason::Missing, Change::NOTHING));
            }
            scene = scene.changed(&change, self.scene);
            scene
                .check(self.limits)
                .map_err(|refusal| item.refuse(refusal.reason, format!("{}: {}", refusal.field, refusal.message)))?;
            changes.push((at, change));
        }
        Ok(changes)
    }

    fn force(&mut self, item: &Item<'_>, control_points: &mut Vec<PointId>) -> Result<LoadProfile> {
        item.table(|fields| {
            let centre = self.centre(item, fields, control_points)?;
            let ForceSpread { unit, key, falloff_per_m, falloff_offset } = self.field(fields, &centre)?;
            let factor = libm::exp(falloff_offset);
            let limit_n = self.limits.point_force_n;
            let within_limit = |field: &str, force_n: DVec3| check_force(field, force_n, factor, limit_n);
            let profile = fields.required("profile")?;
            let trace = profile.table(|fields| self.profile(fields))?;
            let strength = match trace {
                Ok(profile) => {
                    let force_n = unit * fields.required(key)?.vector()?;
                    within_limit(&fields.path(key), force_n)?;
                    StrengthProfile::Scaled(force_n, profile)
                }
                Err(rows) => {
                    // A trace replaces the force, which may be present all the same.
                    fields.item(key).map(|item| item.vector()).transpose()?;
                    let rows: Vec<_> = rows.into_iter().map(|(step, force_n)| (step, unit * force_n)).collect();
                    for (_, force_n) in &rows {
                        within_limit(&fields.path("profile.file"), *force_n)?;
                    }
                    StrengthProfile::Recorded(rows)
                }
            };
            Ok(LoadProfile { centre, strength, falloff_per_m, falloff_offset })
        })
    }

    /// Reads how a force spreads: as in the paper by `falloff_per_m` and `falloff_offset`, or by `radius_m`, at
    /// which the weight is 1/e. With `radius_m`, the script gives the total force on all points, at the first
    /// place.
    fn field(&self, fields: &mut Fields<'_>, centre: &CentreProfile) -> Result<ForceSpread> {
        let Some(radius_m) = fields.number("radius_m")? else {
            let falloff_per_m = not_negative(&fields.path("falloff_per_m"), fields.required_number("falloff_per_m")?)?;
            let falloff_offset = fields.required_number("falloff_offset")?;
            return Ok(ForceSpread { unit: 1.0, key: "force_n", falloff_per_m, falloff_offset });
        };
        positive(&fields.path("radius_m"), radius_m)?;
        for key in ["force_n", "falloff_per_m", "falloff_offset"] {
            if fields.item(key).is_some() {
                let message = "does not go with radius_m: a force in all (total_n) with a radius, or the paper's force_n with \
                               falloff_per_m and falloff_offset";
                return Err(fields.refuse(Reason::WrongKind, key, message));
            }
        }
        let shape = self.scene.shape();
        let sum = weights(shape, centre.begins_at_m(), radius_m.recip());
        if sum < MIN_WEIGHT {
            let message = format!("is so small that no point is reached: points are {} m apart", shape.edge_m());
            return Err(fields.refuse(Reason::OutOfRange, "radius_m", message));
        }
        Ok(ForceSpread { unit: sum.recip(), key: "total_n", falloff_per_m: radius_m.recip(), falloff_offset: 0.0 })
    }

    fn centre(
        &mut self,
        item: &Item<'_>,
        fields: &mut Fields<'_>,
        control_points: &mut Vec<PointId>,
    ) -> Result<CentreProfile> {
        let point = fields.item("point").or_else(|| fields.item("vertex"));
        let (hops, path) = (fields.item("hops"), fields.item("path"));
        let one = "must have just one of `point` (`vertex` on a mesh), `at_m`, `hops` and `path`";
        if let Some(at) = fields.item("at_m") {
            if point.is_some() || hops.is_some() || path.is_some() {
                return Err(item.refuse(Reason::OutOfRange, one));
            }
            let at_m = self.place(&at)?;
            self.scene.shape().check_place(&fields.path("at_m"), at_m)?;
            control_points.push(self.scene.shape().nearest(at_m));
            return Ok(CentreProfile::Hops(vec![(0, at_m)]));
        }
        match (point, hops, path) {
            (Some(point), None, None) => {
                let point = self.point(&point)?;
                control_points.push(point);
                Ok(CentreProfile::Points(vec![(0, (point, self.scene.shape().rest_m(point)))]))
            }
            (None, Some(hops), None) => {
                let mut entries = Vec::new();
                for hop in hops.list()? {
                    entries.push(hop.table(|fields| {
                        let at = self.steps(&fields.path("at_s"), fields.required_number("at_s")?)?;
                        let point = self.point_of(fields)?;
                        control_points.push(point);
                        Ok((at, (point, self.scene.shape().rest_m(point))))
                    })?);
                }
                rising(&hops, "at_s", &mut entries)?;
                Ok(CentreProfile::Points(entries))
            }
            (None, None, Some(path)) => path.table(|fields| {
                let from_m = self.place(&fields.required("from_m")?)?;
                let velocity_m_per_s = self.place(&fields.required("velocity_m_per_s")?)?;
                let speed = velocity_m_per_s.abs().max_element();
                number(&fields.path("velocity_m_per_s"), speed, "at most 1e6", |v| v <= 1e6)?;
                self.scene.shape().check_place(&fields.path("from_m"), from_m)?;
                control_points.push(self.scene.shape().nearest(from_m));
                Ok(CentreProfile::Path { from_m, velocity_m_per_s })
            }),
            (None, None, None) => Err(item.refuse(Reason::Missing, one)),
            _ => Err(item.refuse(Reason::OutOfRange, one)),
        }
    }

    /// Reads a profile, or the rows of a trace.
    #[allow(clippy::type_complexity)]
    fn profile(&mut self, fields: &mut Fields<'_>) -> Result<std::result::Result<Profile, Vec<(u64, DVec3)>>> {
        let kind = fields.required("type")?;
        Ok(Ok(match kind.text()?.as_str() {
            "constant" => Profile::Constant,
            "pulse" => {
                let on = self.steps(&fields.path("on_s"), fields.required_number("on_s")?)?;
                let off = self.steps(&fields.path("off_s"), fields.required_number("off_s")?)?;
                if off <= on {
                    return Err(fields.refuse(Reason::OutOfRange, "off_s", "must be at least a step after on_s"));
                }
                Profile::Pulse { on, off }
            }
            "ramp" => {
                let from_s = not_negative(&fields.path("from_s"), fields.required_number("from_s")?)?;
                let to_s = fields.required_number("to_s")?;
                if to_s < from_s {
                    return Err(fields.refuse(Reason::OutOfRange, "to_s", "must not be before from_s"));
                }
                if to_s > from_s {
                    Profile::Ramp { from_s, to_s }
                } else {
                    // A ramp of zero length is a jump, and jumps are at whole steps.
                    Profile::Pulse { on: self.steps(&fields.path("from_s"), from_s)?, off: u64::MAX }
                }
            }
            "sine" => {
                let frequency_hz = fields.required_number("frequency_hz")?;
                let range = format!("from 0 to {HIGHEST_HZ}");
                number(&fields.path("frequency_hz"), frequency_hz, &range, |v| (0.0..=HIGHEST_HZ).contains(&v))?;
                Profile::Sine { frequency_hz }
            }
            "trace" => {
                let file = fields.required("file")?;
                let path = self.folder.join(file.text()?);
                return Ok(Err(self.trace(&file, &path)?));
            }
            other => {
                let meant = did_you_mean(other, ["constant", "pulse", "ramp", "sine", "trace"]);
                let message = format!("must be one of constant, pulse, ramp, sine, trace, but is `{other}`{meant}");
                return Err(kind.refuse(Reason::WrongKind, message));
            }
        }))
    }

    fn trace(&mut self, item: &Item<'_>, path: &Path) -> Result<Vec<(u64, DVec3)>> {
        let text = files::read_regular_text(path, self.limits.trace_bytes)
            .map_err(|refusal| item.refuse(refusal.reason, format!("{} {}", path.display(), refusal.message)))?;
        let refuse = |line: usize, message: String| {
            let place = format!("{}:{line}", path.display());
            Refusal { place: Some(place), ..Refusal::new(Reason::Unreadable, "", message) }
        };
        const HEADER: &str = "time_s,fx_n,fy_n,fz_n";
        let mut lines = text.lines().enumerate().filter(|line| !line.1.trim().is_empty());
        let header = lines.next().map_or("", |line| line.1);
        if header.split(',').map(str::trim).ne(HEADER.split(',')) {
            return Err(refuse(1, format!("must begin with the line `{HEADER}`")));
        }
        let mut rows: Vec<(u64, DVec3)> = Vec::new();
        let (mut last_s, mut rounded) = (f64::NEG_INFINITY, 0_usize);
        for (index, line) in lines {
            let line_number = index + 1;
            let cells: Vec<&str> = line.split(',').map(str::trim).collect();
            let [time, x, y, z] = cells.as_slice() else {
                return Err(refuse(line_number, format!("must have the 4 columns {HEADER}, but has {}", cells.len())));
            };
            let mut numbers = [0.0; 4];
            for (number, cell) in numbers.iter_mut().zip([time, x, y, z]) {
                *number = cell
                    .parse()
                    .ok()
                    .filter(|number: &f64| number.is_finite())
                    .map(unsigned_zero)
                    .ok_or_else(|| refuse(line_number, format!("`{cell}` is not a finite number")))?;
            }
            let [time_s, x, y, z] = numbers;
            if time_s < 0.0 || time_s <= last_s {
                return Err(refuse(line_number, format!("time_s must rise from 0 on, but is {time_s} after {last_s}")));
            }
            last_s = time_s;
            let warnings = self.warnings.len();
            let step = self.steps("time_s", time_s).map_err(|refusal| refuse(line_number, refusal.message))?;
            rounded += self.warnings.len() - warnings;
            self.warnings.truncate(warnings);
            // Of several rows for one step, the last one applies.
            if rows.last().is_some_and(|row| row.0 == step) {
                rows.pop();
            }
            rows.push((step, DVec3::new(x, y, z)));
        }
        if rows.is_empty() {
            return Err(refuse(1, "has no rows".to_owned()));
        }
        if rounded > 0 {
            self.warnings.push(format!("{}: the times of {rounded} rows were rounded to whole steps", path.display()));
        }
        Ok(rows)
    }

    fn tool(&mut self, item: &Item<'_>) -> Result<ToolTable> {
        item.table(|fields| {
            if let Some(list) = fields.item("poses") {
                return self.poses(fields, &list).map(ToolTable::Poses);
            }
            let point = self.point_of(fields)?;
            check_free(&fields.path("point"), self.scene.shape(), point)?;
            let mut moves = Vec::new();
            let list = fields.required("moves")?;
            for entry in list.list()? {
                moves.push(entry.table(|fields| {
                    let from_s = not_negative(&fields.path("from_s"), fields.required_number("from_s")?)?;
                    let to_s = fields.required_number("to_s")?;
                    if to_s < from_s + SHORTEST_MOVE_S {
                        let message = format!("must be at least {SHORTEST_MOVE_S} s after from_s");
                        return Err(fields.refuse(Reason::OutOfRange, "to_s", message));
                    }
                    Ok(Move { from_s, to_s, by_m: fields.required("by_m")?.vector()? })
                })?);
            }
            let profile = MotionProfile { point, moves };
            // The displacement is largest at the end of a move. Where moves overlap, their sum is an upper bound.
            let farthest: f64 = profile.moves.iter().map(|m| m.by_m.length()).sum();
            check_reach(&fields.path("moves"), self.scene.shape(), farthest, self.limits)?;
            Ok(ToolTable::Moves(profile))
        })
    }

    /// Reads an instrument, whose first tip is tool `first_tool`.
    fn instrument(&mut self, item: &Item<'_>, first_tool: usize) -> Result<InstrumentProfile> {
        item.table(|fields| {
            let mut instrument = Instrument { port: self.port(fields)?, ..self.tips(item, fields)? };
            instrument.jaw_torque_limit_n_m = jaw_torque_limit_n_m(fields, &instrument)?;
            let list = fields.required("poses")?;
            let mut poses: Vec<(f64, InstrumentPose)> = Vec::new();
            for entry in list.list()? {
                poses.push(entry.table(|fields| {
                    let at_s = later(fields, poses.last().map(|pose| pose.0))?;
                    let place_m = fields.required("place_m")?.vector()?;
                    let orientation =
                        fields.item("orientation").map_or(Ok(DQuat::IDENTITY), |item| item.quaternion())?;
                    let jaw_rad = fields.number("jaw_rad")?.unwrap_or(0.0);
                    if jaw_rad != 0.0 && !instrument.has_jaws() {
                        return Err(fields.refuse(Reason::WrongKind, "jaw_rad", "is for an instrument with jaws"));
                    }
                    let range = format!("from 0 to {MAX_JAW_RAD:.4}");
                    number(&fields.path("jaw_rad"), jaw_rad, &range, |v| (0.0..=MAX_JAW_RAD).contains(&v))?;
                    let asked = InstrumentPose { place_m, orientation, jaw_rad };
                    if let Some(port) = &instrument.port {
                        let before_m = poses.last().map_or(place_m, |pose| pose.1.place_m);
                        check_way(&fields.path("place_m"), port, before_m, place_m)?;
                    }
                    let pose = instrument.lead(&asked);
                    for tip in 0..instrument.tips.len() {
                        let far_m = instrument.tip_m(tip, &pose).distance(self.scene.shape().extent().middle_m());
                        check_reach(&fields.path("place_m"), self.scene.shape(), far_m, self.limits)?;
                    }
                    Ok((at_s, asked))
                })?);
            }
            let until_s = until(fields, &list, poses.first().map(|pose| pose.0))?;
            Ok(InstrumentProfile { instrument, poses, until_s, first_tool })
        })
    }

    /// Reads the port of an instrument.
    fn port(&self, fields: &mut Fields<'_>) -> Result<Option<Port>> {
        let Some(port) = fields.item("port") else { return Ok(None) };
        port.table(|fields| {
            let place_m = fields.required("place_m")?.vector()?;
            let far_m = place_m.distance(self.scene.shape().extent().middle_m());
            check_reach(&fields.path("place_m"), self.scene.shape(), far_m, self.limits)?;
            let handle_m = fields.number("handle_m")?.unwrap_or(DEFAULT_HANDLE_M);
            let range = format!("from {} to {}", HANDLE_M.start(), HANDLE_M.end());
            number(&fields.path("handle_m"), handle_m, &range, |v| HANDLE_M.contains(&v))?;
            Ok(Some(Port { place_m, handle_m }))
        })
    }

    /// Reads the tips of an instrument: those that are listed, its shaft, and its jaws.
    fn tips(&self, item: &Item<'_>, fields: &mut Fields<'_>) -> Result<Instrument> {
        let shape = self.scene.shape();
        // A rigid instrument meets a solid with spheres; other tissues know discs alone.
        let usual =
            Tip { shape: if shape.takes_rigid_tips() { TipShape::Sphere } else { TipShape::Disc }, ..Tip::default() };
        let read = |fields: &mut Fields<'_>| {
            let tip = tip_of(fields, usual)?;
            if tip.grasps || tip.coupling != Coupling::Constraint {
                let key = if tip.grasps { "grasps" } else { "spring" };
                return Err(fields.refuse(Reason::WrongKind, key, "is for a [[tool]]: tips of an instrument touch"));
            }
            check_tip(fields.own_path(), shape, &tip).map(|()| tip)
        };
        let mut instrument = Instrument::default();
        if let Some(blade) = fields.item("blade") {
            instrument = Instrument::of_tip(blade_of(&blade, shape)?);
        }
        for tip in fields.item("tips").map_or(Ok(Vec::new()), |tips| tips.list())? {
            instrument.tips.push(tip.table(|fields| {
                let offset_m = fields.item("offset_m").map_or(Ok(DVec3::ZERO), |item| item.vector())?;
                let tip = match fields.item("blade") {
                    Some(blade) => blade_of(&blade, shape)?,
                    None => read(fields)?,
                };
                Ok(InstrumentTip { offset_m, tip, part: InstrumentPart::Body })
            })?);
        }
        if let Some(scissors) = fields.item("scissors") {
            let blade = blade_of(&scissors, shape)?;
            instrument.add_scissors(blade.edge_m.length(), blade);
        }
        let mut part = |key: &'static str| {
            let Some(part) = fields.item(key) else { return Ok(None) };
            let of_part = part.table(|fields| {
                let length_m = positive(&fields.path("length_m"), fields.required_number("length_m")?)?;
                Ok((length_m, read(fields)?))
            });
            of_part.map(Some)
        };
        let (jaws, shaft) = (part("jaws")?, part("shaft")?);
        if jaws.is_some() && instrument.has_jaws() {
            return Err(item.refuse(Reason::WrongKind, "has `jaws` and `scissors`: an instrument has one pair"));
        }
        instrument.add_parts(jaws, shaft);
        if instrument.tips.is_empty() {
            return Err(item.refuse(Reason::Missing, "must have `tips`, a `shaft`, `jaws`, `scissors` or a `blade`"));
        }
        if instrument.tips.len() > MAX_TIPS {
            let message = format!(
                "has {} tips, above the limit of {MAX_TIPS}: rows have one for each radius of their length",
                instrument.tips.len()
            );
            return Err(item.refuse(Reason::TooLarge, message));
        }
        Ok(instrument)
    }

    /// Reads the threads and then the clips.
    fn ties(&mut self, fields: &mut Fields<'_>) -> Result<Vec<TieProfile>> {
        let mut ties = Vec::new();
        for item in items(fields, "thread")? {
            ties.push(item.table(|fields| self.thread(fields))?);
        }
        for item in items(fields, "clip")? {
            ties.push(item.table(|fields| {
                let from_s = not_negative(&fields.path("from_s"), fields.number("from_s")?.unwrap_or(0.0))?;
                self.tie(fields, TieKind::Clip, vec![(from_s, 0.0)])
            })?);
        }
        if ties.len() > self.limits.ties as usize {
            let message = format!("{} threads and clips: above the limit of {}", ties.len(), self.limits.ties);
            return Err(Refusal::new(Reason::TooLarge, "thread", message));
        }
        Ok(ties)
    }

    /// Reads `at_s`, a time before the script ends, as a step.
    fn step_within(&mut self, fields: &mut Fields<'_>, steps: u64) -> Result<u64> {
        let at_s = not_negative(&fields.path("at_s"), fields.required_number("at_s")?)?;
        let step = self.steps(&fields.path("at_s"), at_s)?;
        if step >= steps {
            return Err(fields.refuse(Reason::OutOfRange, "at_s", "must be before the script ends (duration_s)"));
        }
        Ok(step)
    }

    /// Reads when a trainee ends phases of an exercise.
    fn phase_ends(&mut self, fields: &mut Fields<'_>, steps: u64) -> Result<Vec<(u64, u32)>> {
        let mut ends: Vec<(u64, u32)> = Vec::new();
        for item in items(fields, "phase_end")? {
            let end = item.table(|fields| {
                let step = self.step_within(fields, steps)?;
                let phase = fields.required("phase")?.whole()?;
                let known = u32::try_from(phase).ok().filter(|phase| (1..=MAX_PHASES).contains(&(*phase as usize)));
                let Some(phase) = known else {
                    let message = format!("{phase}: must be from 1 to {MAX_PHASES}");
                    return Err(fields.refuse(Reason::OutOfRange, "phase", message));
                };
                if ends.last().is_some_and(|last| last.1 >= phase || last.0 > step) {
                    let message = "must be above that of the end before, and its time not earlier";
                    return Err(fields.refuse(Reason::OutOfRange, "phase", message));
                }
                Ok((step, phase))
            })?;
            ends.push(end);
        }
        Ok(ends)
    }

    /// Reads the marks that a trainee makes.
    fn marks(&mut self, fields: &mut Fields<'_>, steps: u64) -> Result<Vec<(u64, PlaceMark)>> {
        let mut marks = Vec::new();
        for item in items(fields, "mark")? {
            marks.push(item.table(|fields| {
                let step = self.step_within(fields, steps)?;
                let place_m = fields.required("place_m")?.place_in(self.scene.shape().dimensions())?;
                let mark = PlaceMark { place_m, diameter_m: fields.number("diameter_m")? };
                check_mark(fields.own_path(), self.scene.shape(), &mark)?;
                Ok((step, mark))
            })?);
        }
        if marks.len() > MAX_MARKS {
            let message = format!("{} marks: more than {MAX_MARKS}", marks.len());
            return Err(Refusal::new(Reason::TooLarge, "mark", message));
        }
        Ok(marks)
    }

    /// Reads a thread, whose length is a number or a list of lengths over time.
    fn thread(&mut self, fields: &mut Fields<'_>) -> Result<TieProfile> {
        let friction = fields.number("friction")?.unwrap_or(0.0);
        let length = fields.required("length_m")?;
        let lengths_m = if let Ok(list) = length.list() {
            if fields.item("from_s").is_some() {
                let message = "is for a thread of one length: in a list, the first at_s says when it is laid";
                return Err(fields.refuse(Reason::WrongKind, "from_s", message));
            }
            let mut lengths_m: Vec<(f64, f64)> = Vec::new();
            for entry in list {
                lengths_m.push(entry.table(|fields| {
                    let at_s = later(fields, lengths_m.last().map(|length| length.0))?;
                    Ok((at_s, positive(&fields.path("length_m"), fields.required_number("length_m")?)?))
                })?);
            }
            lengths_m
        } else {
            let from_s = not_negative(&fields.path("from_s"), fields.number("from_s")?.unwrap_or(0.0))?;
            vec![(from_s, fields.required_number("length_m")?)]
        };
        let Some((_, length_m)) = lengths_m.first().copied() else {
            return Err(length.refuse(Reason::Missing, "must have at least one length"));
        };
        self.tie(fields, TieKind::Thread { length_m, friction }, lengths_m)
    }

    /// Reads what threads and clips have in common.
    fn tie(&mut self, fields: &mut Fields<'_>, kind: TieKind, lengths_m: Vec<(f64, f64)>) -> Result<TieProfile> {
        let shape = self.scene.shape();
        let name = fields.text("name")?.unwrap_or_default();
        let mut bites = Vec::new();
        for entry in fields.required("bites")?.list()? {
            bites.push(entry.table(|fields| {
                let place_m = shape.in_rest_space_m(fields.required("place_m")?.vector()?);
                let radius_m = fields.number("radius_m")?.unwrap_or(BITE_RADIUS_M);
                if shape.is_fixed(shape.nearest(place_m)) {
                    let message = "is at a fixed point: what is tied there does not move";
                    self.warnings.push(format!("{}: {message}", fields.path("place_m")));
                }
                Ok(Bite { place_m, radius_m })
            })?);
        }
        let tie = Tie { bites, kind, strength_n: fields.number("strength_n")? };
        let until_s = fields.number("until_s")?.unwrap_or(f64::INFINITY);
        if lengths_m.first().is_some_and(|first| until_s <= first.0) {
            return Err(fields.refuse(
                Reason::OutOfRange,
                "until_s",
                "must be later than the time at which it is laid",
            ));
        }
        for (_, length_m) in &lengths_m {
            let kind = match kind {
                TieKind::Thread { friction, .. } => TieKind::Thread { length_m: *length_m, friction },
                TieKind::Clip => TieKind::Clip,
            };
            check_tie(fields.own_path(), shape, &Tie { kind, ..tie.clone() }, self.limits)?;
        }
        Ok(TieProfile { name, tie, lengths_m, until_s })
    }

    /// Reads a tool with a tip.
    fn poses(&mut self, fields: &mut Fields<'_>, list: &Item<'_>) -> Result<PoseProfile> {
        let shape = self.scene.shape();
        let tip = fields.item("tip").map_or(Ok(Tip::default()), |item| item.table(read_tip))?;
        check_tip(&fields.path("tip"), shape, &tip)?;
        let mut poses: Vec<(f64, DVec3)> = Vec::new();
        for entry in list.list()? {
            poses.push(entry.table(|fields| {
                let at_s = later(fields, poses.last().map(|pose| pose.0))?;
                let place_m = fields.required("place_m")?.vector()?;
                let far_m = place_m.distance(shape.extent().middle_m());
                let field = fields.path("place_m");
                check_reach(&field, shape, far_m, self.limits)?;
                let beyond_m = shape.beyond_rim_m(place_m);
                if beyond_m > 0.0 {
                    let off_m = legible(beyond_m);
                    self.warnings.push(format!(
                        "{field}: is {off_m} m beside the tissue: a tip that touches drags the edge along"
                    ));
                }
                let touches = tip.grasps || place_m.z <= 0.0;
                if shape.extent().beside_m(place_m) == DVec2::ZERO && touches && shape.is_fixed(shape.nearest(place_m))
                {
                    let message = "is at a fixed point: the tissue does not move there, and the tool feels nothing";
                    self.warnings.push(format!("{field}: {message}"));
                }
                Ok((at_s, place_m))
            })?);
        }
        let until_s = until(fields, list, poses.first().map(|pose| pose.0))?;
        Ok(PoseProfile { tip, poses, until_s, mounted: None })
    }
}

/// Reads the limit of the torque between the jaws of an instrument.
fn jaw_torque_limit_n_m(fields: &mut Fields<'_>, instrument: &Instrument) -> Result<Option<f64>> {
    const KEY: &str = "jaw_torque_limit_n_m";
    let Some(limit_n_m) = fields.number(KEY)? else { return Ok(None) };
    if !instrument.has_jaws() {
        return Err(fields.refuse(Reason::WrongKind, KEY, "is for an instrument with jaws"));
    }
    let range = format!("above 0 and at most {MAX_JAW_TORQUE_LIMIT_N_M}");
    number(&fields.path(KEY), limit_n_m, &range, |v| v > 0.0 && v <= MAX_JAW_TORQUE_LIMIT_N_M).map(Some)
}

/// A table `[[tool]]`.
enum ToolTable {
    Moves(MotionProfile),
    Poses(PoseProfile),
}

/// How a force spreads over the points.
struct ForceSpread {
    /// The factor of the given force vector.
    unit: f64,
    /// The key of that vector.
    key: &'static str,
    falloff_per_m: f64,
    falloff_offset: f64,
}

/// Returns the tool that is a tip of an instrument.
fn mounted(profile: &Arc<InstrumentProfile>, number: usize) -> PoseProfile {
    let InstrumentProfile { instrument, poses, until_s, .. } = &**profile;
    PoseProfile {
        tip: instrument.tips[number].tip,
        poses: poses.iter().map(|(at_s, pose)| (*at_s, instrument.tip_m(number, &instrument.lead(pose)))).collect(),
        until_s: *until_s,
        mounted: Some((profile.clone(), number)),
    }
}

/// Refuses a place to which an instrument can't go in its port, and a way from the place before that passes the port.
fn check_way(field: &str, port: &Port, from_m: DVec3, to_m: DVec3) -> Result<()> {
    let (depths_m, depth_m) = (port.depths_m(), to_m.distance(port.place_m));
    let [least, most] = [*depths_m.start(), *depths_m.end()].map(legible);
    number(field, depth_m, &format!("from {least} to {most} m from the port"), |v| depths_m.contains(&v))?;
    let text = format!("at least {least} m from the port on the way from the pose before");
    number(field, port.way_depth_m(from_m, to_m), &text, |v| v >= *depths_m.start()).map(drop)
}

/// Reads the time of a pose, which must be later than that of the pose before, s.
fn later(fields: &mut Fields<'_>, before_s: Option<f64>) -> Result<f64> {
    let at_s = not_negative(&fields.path("at_s"), fields.required_number("at_s")?)?;
    if before_s.is_some_and(|before_s| at_s < before_s + SHORTEST_MOVE_S) {
        return Err(fields.refuse(Reason::OutOfRange, "at_s", "must be later than that of the pose before"));
    }
    Ok(at_s)
}

/// Reads the time at which a tool is taken away, s; `list` are its poses, which begin at `begin_s`.
fn until(fields: &mut Fields<'_>, list: &Item<'_>, begin_s: Option<f64>) -> Result<f64> {
    let Some(begin_s) = begin_s else { return Err(list.refuse(Reason::Missing, "must have at least one pose")) };
    let until_s = fields.number("until_s")?.unwrap_or(f64::INFINITY);
    if until_s <= begin_s {
        return Err(fields.refuse(Reason::OutOfRange, "until_s", "must be later than the first pose"));
    }
    Ok(until_s)
}

/// Radius of the part of the surface that a blade feels, m, if a script gives none.
const BLADE_RADIUS_M: f64 = 0.001;

/// Radius of the disc of a bite, m, if a script gives none.
const BITE_RADIUS_M: f64 = 0.001;

/// Reads a blade. Its edge runs from the tip along the instrument's −x.
fn blade_of(item: &Item<'_>, shape: &dyn shape::RestShape) -> Result<Tip> {
    item.table(|fields| {
        let length_m = positive(&fields.path("length_m"), fields.required_number("length_m")?)?;
        let radius_m = fields.number("radius_m")?.unwrap_or(BLADE_RADIUS_M);
        let tip = Tip { shape: TipShape::Blade, radius_m, edge_m: -length_m * DVec3::X, ..Tip::default() };
        // A script gives the length of the edge alone.
        let as_given = |refusal: Refusal| {
            let field = refusal.field.strip_suffix(".edge_m").map(|blade| format!("{blade}.length_m"));
            Refusal { field: field.unwrap_or(refusal.field), ..refusal }
        };
        check_tip(fields.own_path(), shape, &tip).map_err(as_given).map(|()| tip)
    })
}

fn read_tip(fields: &mut Fields<'_>) -> Result<Tip> {
    tip_of(fields, Tip::default())
}

/// Reads a tip; what is absent is that of `standard`.
fn tip_of(fields: &mut Fields<'_>, standard: Tip) -> Result<Tip> {
    let coupling = match fields.item("spring") {
        None => standard.coupling,
        Some(item) => item.table(|fields| {
            let stiffness_n_per_m = fields.required_number("stiffness_n_per_m")?;
            let damping_n_s_per_m = fields.required_number("damping_n_s_per_m")?;
            Ok(Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m })
        })?,
    };
    let shape = fields.item("shape").map_or(Ok(standard.shape), |item| {
        item.text()?.parse::<TipShape>().map_err(|message| item.refuse(Reason::OutOfRange, message))
    })?;
    Ok(Tip {
        shape,
        radius_m: fields.number("radius_m")?.unwrap_or(standard.radius_m),
        friction: fields.number("friction")?.unwrap_or(standard.friction),
        grasps: fields.item("grasps").map_or(Ok(standard.grasps), |item| item.flag())?,
        coupling,
        edge_m: standard.edge_m,
        burn_s: fields.number("burn_s")?.unwrap_or(standard.burn_s),
    })
}

/// Reads the names of the scenes that a script is made for; empty means all.
fn read_scenes(fields: &mut Fields<'_>) -> Result<Vec<String>> {
    let Some(item) = fields.item("scenes") else { return Ok(Vec::new()) };
    item.list()?.iter().map(Item::text).collect()
}

fn is_made_for(scenes: &[String], name: &str) -> bool {
    scenes.is_empty() || scenes.iter().any(|scene| scene == name)
}

/// Returns the names of the scenes that a script's text is made for, in the order of its key `scenes`. Empty if
/// the script is for all scenes, or if the text is not TOML or the key not a list: playing the script reports
/// the error.
pub fn made_for(text: &str) -> Vec<String> {
    let Ok(table) = text.parse::<toml::Table>() else { return Vec::new() };
    let scenes = table.get("scenes").and_then(|scenes| scenes.as_array());
    scenes.into_iter().flatten().filter_map(|name| name.as_str().map(str::to_owned)).collect()
}

/// Returns whether a script's text is made for the scene of that name: it names it, or no scene at all
/// ([`made_for`]). True for a text that is not TOML.
pub fn fits(text: &str, scene: &str) -> bool {
    is_made_for(&made_for(text), scene)
}

/// Returns the entries of `[[key]]`; empty if the key is absent.
fn items<'a>(fields: &mut Fields<'a>, key: &'static str) -> Result<Vec<Item<'a>>> {
    fields.item(key).map_or(Ok(Vec::new()), |item| item.tables())
}

/// Requires ascending times. If two entries round to the same step, the later one applies.
fn rising<T>(list: &Item<'_>, key: &str, entries: &mut Vec<(u64, T)>) -> Result<()> {
    if entries.is_empty() {
        return Err(list.refuse(Reason::Missing, "must have at least one entry"));
    }
    if let Some(index) = entries.windows(2).position(|pair| pair[1].0 < pair[0].0) {
        let message = format!("{key} of entry {} is before that of the entry before it", index + 1);
        return Err(list.refuse(Reason::OutOfRange, message));
    }
    let mut index = 0;
    while index + 1 < entries.len() {
        if entries[index].0 == entries[index + 1].0 {
            entries.remove(index);
        } else {
            index += 1;
        }
    }
    Ok(())
}

/// Returns the point nearest to a place, m, or of a solid, where several points have the name of one vertex, the one that is found by
/// that name: a server must sample the point that a run does.
fn named_nearest(of: &dyn shape::RestShape, place_m: DVec3) -> PointId {
    let mut point = of.nearest(place_m);
    // What is found may have the name of a third one.
    for _ in 0..8 {
        match of.find("point", of.name(point)) {
            Ok(found) if found != point => point = found,
            _ => break,
        }
    }
    point
}
