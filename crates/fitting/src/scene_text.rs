//! Writes fitted values into the text of a scene, and keeps all else of it.

use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use palpate_tissue::scene::{Body, Named, Scene};
use toml_edit::{DocumentMut, Item, Value, value};

/// Returns a value to six significant digits.
pub fn rounded(number: f64) -> f64 {
    format!("{number:.5e}").parse().unwrap_or(number)
}

/// Returns the text of a scene with the values that `fitted` has of some parameters, and with assignments (`key.path=value`, as
/// `--set` has them) made; comments and all other values stay. `head` are lines of a comment for its beginning, without `#`.
///
/// # Errors
/// Refuses a text that is not TOML ([`Reason::Unreadable`]), and a path through a value that is not a table.
pub fn with_values(
    text: &str,
    assignments: &[String],
    fitted: &Scene,
    parameters: &[TissueParameter],
    head: &[String],
) -> Result<String> {
    let mut document: DocumentMut =
        text.parse().map_err(|e: toml_edit::TomlError| Refusal::new(Reason::Unreadable, "", e.message().to_owned()))?;
    for assignment in assignments {
        let (path, text) = assignment.split_once('=').unwrap_or((assignment, ""));
        let given = text.trim().parse::<Value>().unwrap_or_else(|_| Value::from(text.trim()));
        set(&mut document, path.trim(), given)?;
    }
    for parameter in parameters {
        let number = parameter.value(fitted).unwrap_or(0.0);
        set(&mut document, parameter.name(), rounded(number).into())?;
        // What follows from the parameter by default, or goes with it.
        const SHEAR: &str = "springs.shear_stiffness_n_per_m";
        if *parameter == TissueParameter::SpringStiffness && get(&document, SHEAR) {
            set(&mut document, SHEAR, rounded(fitted.springs.shear_stiffness_n_per_m).into())?;
        }
    }
    const VISCOSITY: &str = "material.viscosity_pa_s";
    if let Body::Solid(solid) = &fitted.body
        && !get(&document, VISCOSITY)
        && solid.material.with_viscosity(None) != solid.material
    {
        set(&mut document, VISCOSITY, rounded(solid.material.viscosity_pa_s).into())?;
    }
    let head: String = head.iter().map(|line| format!("# {line}\n")).collect();
    Ok(head + &document.to_string())
}

/// The parts of a path: `branch[0].time_s` has the item 0 of a list.
fn parts(path: &str) -> impl Iterator<Item = &str> {
    path.split(['.', '[', ']']).filter(|part| !part.is_empty())
}

fn get(document: &DocumentMut, path: &str) -> bool {
    let mut item = document.as_item();
    for part in parts(path) {
        match item.get(part) {
            Some(inner) => item = inner,
            None => return false,
        }
    }
    true
}

/// Sets a value; its comment stays.
fn set(document: &mut DocumentMut, path: &str, given: Value) -> Result<()> {
    let refuse = || Refusal::new(Reason::WrongKind, path, "is within a value that is not a table");
    let mut item = document.as_item_mut();
    for part in parts(path) {
        item = match part.parse::<usize>() {
            Ok(index) => item.get_mut(index).ok_or_else(refuse)?,
            Err(_) if item.is_none() || item.is_table_like() => item_of(item, part).ok_or_else(refuse)?,
            Err(_) => return Err(refuse()),
        };
    }
    let decor = item.as_value().map(|before| before.decor().clone());
    *item = value(given);
    if let (Some(decor), Some(now)) = (decor, item.as_value_mut()) {
        *now.decor_mut() = decor;
    }
    Ok(())
}

/// Returns the item of a key, which it adds if there is none: a section becomes a table of its own.
fn item_of<'i>(item: &'i mut Item, key: &str) -> Option<&'i mut Item> {
    if item.is_none() {
        *item = toml_edit::table();
    }
    Some(item.as_table_like_mut()?.entry(key).or_insert(Item::None))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use palpate_tissue::limits::Limits;

    #[test]
    fn values_are_replaced_and_comments_stay() {
        let text = "# my tissue\n[sheet]\npoints = [5, 5]   # few\nspacing_m = 0.01\npoint_mass_kg = 0.01\n\n[springs]   # by hand\n\
                    stiffness_n_per_m = 10.0   # a guess\nshear_stiffness_n_per_m = 5.0\n\n[anchor_springs]\nstiffness_n_per_m = 5.0\n\
                    \n[damping]\ncoefficient_n_s_per_m = 0.5\n";
        let scene = Scene::parse("t", text, &[], &Limits::default()).unwrap();
        let fitted = TissueParameter::SpringStiffness.set(&scene, 12.345_678_9).unwrap();
        let written = with_values(
            text,
            &["stepping.tolerance=1e-4".into()],
            &fitted,
            &[TissueParameter::SpringStiffness],
            &["from lab.csv".into()],
        )
        .unwrap();
        let expected =
            text.replace("= 10.0 ", "= 12.3457 ").replace("per_m = 5.0\n\n[anchor", "per_m = 6.17284\n\n[anchor");
        assert_eq!(written, format!("# from lab.csv\n{expected}\n[stepping]\ntolerance = 1e-4\n"));
        let read = Scene::parse("t", &written, &[], &Limits::default()).unwrap();
        assert_eq!(read.springs.stiffness_n_per_m, 12.3457);
    }

    #[test]
    fn a_branch_and_a_viscosity_that_only_the_default_gave_are_written() {
        let text = "[solid]\norgan = { name = \"gallbladder\", edge_m = 0.0035, seed = 1 }\ncell_m = 0.008\nfixed = \"none\"\n\
                    foundation_n_per_m3 = 2e4\n[material]\nyoungs_modulus_pa = 8e3 # stiff\npoissons_ratio = 0.4\n\
                    [[branch]]\nshear_modulus_pa = 1e3\ntime_s = 0.3\n";
        let scene = Scene::parse("t", text, &[], &Limits::default()).unwrap();
        let parameters = [TissueParameter::YoungsModulus, TissueParameter::BranchTime(0)];
        let fitted = parameters[0].set(&scene, 800.0).unwrap();
        let fitted = parameters[1].set(&fitted, 0.5).unwrap();
        let written = with_values(text, &[], &fitted, &parameters, &[]).unwrap();
        let read = Scene::parse("t", &written, &[], &Limits::default()).unwrap();
        assert_eq!(read.body, fitted.body);
        assert!(written.contains("youngs_modulus_pa = 800.0 # stiff"), "{written}");
    }
}
