//! `palpate run SCENE indent`: presses a tip into a tissue and prints its force over its depth.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::TipShape;
use palpate_refusal::{Reason, Refusal, positive};
use palpate_session::indentation::{Indentation, Indented};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Body;
use palpate_tissue::scheme::Oscillator;

use super::{Failure, clock_s, say, with_progress, write_file};

/// The name that stands for an indentation in place of a script.
pub(crate) const NAME: &str = "indent";

/// Radius of a fingertip, m, and of a tip on a small tissue, divided by the size of the tissue.
const FINGERTIP_M: f64 = 0.005;
const PART: f64 = 0.1;

/// Default depth, in radii: beyond half a radius an even pressure may have no equilibrium with a solid.
const DEPTH: f64 = 0.4;

#[derive(clap::Args)]
pub(crate) struct IndentArguments {
    /// With `indent`: the place of the tip, m; it goes in at the nearest place of the surface. Default: the middle of a
    /// sheet, the top of a solid
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', allow_hyphen_values = true)]
    place: Option<Vec<f64>>,
    /// With `indent`: the tip: disc (an even pressure), rigid (a rigid disc) or sphere; the last two need a solid. Default: disc
    #[arg(long, value_name = "SHAPE")]
    tip: Option<TipShape>,
    /// With `indent`: the radius of the tip, mm. Default: 5, or less on a small tissue
    #[arg(long, value_name = "MM")]
    radius_mm: Option<f64>,
    /// With `indent`: the largest depth, mm; of an even pressure it is the mean over the disc. Default: 0.4 of the radius
    #[arg(long, value_name = "MM")]
    depth_mm: Option<f64>,
    /// With `indent`: the speed of the tip, mm/s. Default: 2
    #[arg(long, value_name = "MM/S")]
    speed_mm_per_s: Option<f64>,
}

impl IndentArguments {
    /// Refuses options of an indentation for a script.
    ///
    /// # Errors
    /// Names the first option that was given.
    pub(crate) fn refuse_without_indent(&self) -> Result<(), Failure> {
        let given = [
            ("--place", self.place.is_some()),
            ("--tip", self.tip.is_some()),
            ("--radius-mm", self.radius_mm.is_some()),
            ("--depth-mm", self.depth_mm.is_some()),
            ("--speed-mm-per-s", self.speed_mm_per_s.is_some()),
        ];
        match given.iter().find(|(_, is_given)| *is_given) {
            Some((option, _)) => Err(Failure::Refused(format!("{option}: goes with `palpate run SCENE {NAME}` alone"))),
            None => Ok(()),
        }
    }

    fn indentation(&self, model: &Model) -> Result<Indentation, Failure> {
        let in_m = |option: &str, given_mm: Option<f64>, default_m: f64| match given_mm {
            Some(given_mm) => positive(option, given_mm).map(|given_mm| given_mm * 1e-3),
            None => Ok(default_m),
        };
        let place_m = match self.place.as_deref() {
            None => None,
            Some([x, y, z]) if [x, y, z].iter().all(|v| v.is_finite()) => Some(DVec3::new(*x, *y, *z)),
            Some(_) => {
                let message = "must be three numbers of metres: X,Y,Z";
                return Err(Refusal::new(Reason::WrongKind, "--place", message).into());
            }
        };
        let size_m = model.shape().extent().size_m().length();
        let radius_m = in_m("--radius-mm", self.radius_mm, FINGERTIP_M.min(PART * size_m))?;
        Ok(Indentation {
            place_m,
            shape: self.tip.unwrap_or_default(),
            radius_m,
            depth_m: in_m("--depth-mm", self.depth_mm, DEPTH * radius_m)?,
            speed_m_per_s: in_m("--speed-mm-per-s", self.speed_mm_per_s, 0.002)?,
        })
    }
}

/// Indents the tissue of a model; prints the curve, or writes it to `output` as CSV.
pub(crate) fn run(
    arguments: &IndentArguments,
    model: &Arc<Model>,
    limits: &Limits,
    output: Option<&Path>,
    quiet: bool,
) -> Result<(), Failure> {
    let indentation = arguments.indentation(model)?;
    model.warnings.iter().for_each(|warning| say!("palpate: warning: {warning}"));
    let estimate = indentation.steps(model.scene.stepping.rate_hz);
    let indented = with_progress("step", estimate, quiet, |progress| {
        indentation.run(model, limits, &clock_s, &mut |steps| progress(steps))
    })?;
    for warning in &indented.summary.warnings {
        say!("palpate: warning: {warning}");
    }
    // Where the tip turns, a force with branches relaxes.
    let turns_m = indented.curve.last().map(|row| row.depth_m).filter(|_| Oscillator::of(&model.scene).relaxes());
    if let Some(depth_m) = indented.gives_way_at_m().filter(|depth_m| Some(*depth_m) != turns_m) {
        say!(
            "palpate: warning: the tissue gives way at a depth of {:.2} mm, where the force falls: this tip presses it no deeper \
             without a jump. Use --tip sphere, a larger --radius-mm, or a smaller --depth-mm",
            1e3 * depth_m
        );
    }
    if let Some(path) = output {
        write_file(path, csv(&indented).as_bytes())?;
    }
    if !quiet || output.is_none() {
        // A closed output does not end the program.
        let _ = std::io::stdout().write_all(text(&indentation, &indented, model).as_bytes());
    }
    indented.summary.fault().map_or(Ok(()), |fault| Err(Failure::Failed(fault)))
}

fn csv(indented: &Indented) -> String {
    let mut text = "depth_m,loading_n,unloading_n\n".to_owned();
    for row in &indented.curve {
        let _ = writeln!(text, "{:.9},{:.9},{:.9}", row.depth_m, row.loading_n, row.unloading_n);
    }
    text
}

fn text(indentation: &Indentation, indented: &Indented, model: &Model) -> String {
    let [x, y, z] = indented.place_m.to_array().map(|v| 1e3 * v);
    let (radius_mm, speed) = (1e3 * indentation.radius_m, 1e3 * indentation.speed_m_per_s);
    let tip = match indentation.shape {
        TipShape::Disc => "even pressure on a disc",
        TipShape::RigidDisc => "rigid disc",
        TipShape::Sphere => "rigid sphere",
        TipShape::Blade => "blade",
    };
    let mut text = format!(
        "{} at ({x:.2}, {y:.2}, {z:.2}) mm, {tip} of radius {radius_mm:.3} mm, {speed:.3} mm/s\n\n\
         {:>9}  {:>12}  {:>12}\n",
        model.scene.name, "depth mm", "loading N", "unloading N"
    );
    for row in &indented.curve {
        let _ = writeln!(text, "{:>9.4}  {:>12.6}  {:>12.6}", 1e3 * row.depth_m, row.loading_n, row.unloading_n);
    }
    let _ = writeln!(text, "\nstiffness of the first tenth  {:.3} N/m", indented.stiffness_n_per_m);
    if let Body::Solid(solid) = &model.scene.body {
        let nu = solid.material.poissons_ratio;
        // The first depths of a sphere are those of a few triangles.
        let row = if indentation.shape == TipShape::Sphere { indented.curve.last() } else { indented.curve.get(2) };
        let apparent_pa = row.map_or(0.0, |row| indentation.apparent_modulus_pa(row, nu));
        let own_pa = solid.material.youngs_modulus_pa;
        let _ = writeln!(
            text,
            "as of a half space            {apparent_pa:.0} Pa at ν = {nu} (the material has {own_pa:.0} Pa; a thin tissue, a \
             lump and the size of the cells make it stiffer)"
        );
        if let Some(error) = indented.summary.mesh_error_estimate {
            let _ = writeln!(text, "of which by the cells         {:+.1} % (an estimate)", 100.0 * error);
        }
    }
    text
}
