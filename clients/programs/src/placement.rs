//! Placement of a device over the tissue, from a file and options.

use std::path::PathBuf;

use glam::DVec3;
use palpate_client::devices::{Enables, Placement};
use palpate_refusal::{Reason, Result};
use palpate_tissue::files::read_text;
use palpate_tissue::scene::toml_document::{Document, Fields};

/// Largest placement file, bytes.
const MAX_BYTES: u64 = 1 << 16;

/// Options of the placement, which override the file.
#[derive(clap::Args)]
pub(crate) struct PlacementOptions {
    /// File (TOML) with the placement of the device over the tissue, and its clutch; the options below override it
    #[arg(long, value_name = "FILE")]
    placement: Option<PathBuf>,
    /// Offset of the middle of the device's workspace from the top of the tissue, m [default: 0,0,0]
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true)]
    offset_m: Option<DVec3>,
    /// Turn the device about the tissue's x, then y, then z axis, degrees [default: 0,0,0]
    #[arg(long, value_name = "X,Y,Z", value_parser = vector, allow_hyphen_values = true)]
    rotation_deg: Option<DVec3>,
    /// Metres of the tissue for each metre of the device [default: 1]
    #[arg(long, value_name = "FACTOR")]
    scale: Option<f64>,
    /// Newtons at the device for each newton of the tissue, at most 1 [default: 1]
    #[arg(long, value_name = "FACTOR")]
    force_scale: Option<f64>,
    /// Forces return by themselves: for devices without a button
    #[arg(long)]
    enable_always: bool,
    /// The button that lets the device move without the tool, while it is held; the first is 0 [default: 1]
    #[arg(long, value_name = "NUMBER")]
    clutch_button: Option<u32>,
    /// No clutch
    #[arg(long, conflicts_with = "clutch_button")]
    no_clutch: bool,
}

/// Parses three numbers with commas between them.
pub(crate) fn vector(text: &str) -> std::result::Result<DVec3, String> {
    let numbers: std::result::Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let numbers = numbers.map_err(|_| "must be three numbers, as in 0,0,0.01".to_owned())?;
    <[f64; 3]>::try_from(numbers).map(DVec3::from_array).map_err(|_| "must be three numbers, as in 0,0,0.01".to_owned())
}

impl PlacementOptions {
    /// Returns the placement from file and options.
    ///
    /// # Errors
    /// Returns a refusal if the file can't be read, or with the key of a value that is out of range.
    pub(crate) fn placement(&self) -> Result<Placement> {
        let mut placement = match &self.placement {
            Some(path) => parse(&path.display().to_string(), &read_text(path, MAX_BYTES)?)?,
            None => Placement::default(),
        };
        placement.offset_m = self.offset_m.unwrap_or(placement.offset_m);
        placement.rotation_deg = self.rotation_deg.unwrap_or(placement.rotation_deg);
        placement.scale = self.scale.unwrap_or(placement.scale);
        placement.force_scale = self.force_scale.unwrap_or(placement.force_scale);
        if self.enable_always {
            placement.enable = Enables::Always;
        }
        placement.clutch_button = self.clutch_button.or(placement.clutch_button).filter(|_| !self.no_clutch);
        placement.check()?;
        Ok(placement)
    }
}

fn parse(name: &str, text: &str) -> Result<Placement> {
    let document = Document::parse(name, text)?;
    let placement = document.read(fields)?;
    placement.check().map_err(|refusal| document.locate(refusal))?;
    Ok(placement)
}

fn fields(fields: &mut Fields<'_>) -> Result<Placement> {
    let normal = Placement::default();
    let vector = |fields: &mut Fields<'_>, key| fields.item(key).map_or(Ok(DVec3::ZERO), |item| item.vector());
    let button = |fields: &mut Fields<'_>, key| {
        let whole = fields.item(key).map(|item| item.whole()).transpose()?;
        // A value that does not fit the type is out of range.
        Ok(whole.map(|whole| u32::try_from(whole).unwrap_or(u32::MAX)))
    };
    let (offset_m, rotation_deg) = (vector(fields, "offset_m")?, vector(fields, "rotation_deg")?);
    let scale = fields.number("scale")?.unwrap_or(normal.scale);
    let force_scale = fields.number("force_scale")?.unwrap_or(normal.force_scale);
    let enable = fields.item("enable").map(|item| match item.as_text() {
        Some("device") => Ok(Enables::Device),
        Some("always") => Ok(Enables::Always),
        _ => Err(item.wrong("\"device\" or \"always\"")),
    });
    let enable = enable.transpose()?;
    let enable_button = button(fields, "enable_button")?;
    if enable.is_some() && enable_button.is_some() {
        return Err(fields.refuse(Reason::WrongKind, "enable_button", "leave out either this or `enable`"));
    }
    let enable = enable_button.map(Enables::Button).or(enable).unwrap_or_default();
    let clutch = fields.item("clutch").map_or(Ok(true), |item| item.flag())?;
    let clutch_button = button(fields, "clutch_button")?.or(normal.clutch_button).filter(|_| clutch);
    Ok(Placement { offset_m, rotation_deg, scale, force_scale, enable, clutch_button })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_file_says_what_differs_from_the_middle_of_the_tissue() {
        assert_eq!(parse("place.toml", "").unwrap(), Placement::default());
        let told = parse(
            "place.toml",
            "offset_m = [0, 0, 0.01]\nrotation_deg = [0, 0, 90]\nscale = 0.5\nenable = \"always\"\nclutch = false",
        )
        .unwrap();
        let expected = Placement {
            offset_m: 0.01 * DVec3::Z,
            rotation_deg: 90.0 * DVec3::Z,
            scale: 0.5,
            enable: Enables::Always,
            clutch_button: None,
            ..Placement::default()
        };
        assert_eq!(told, expected);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        for (text, place, field) in [
            ("scale = 0.0", ":1", "scale"),
            ("\nforce_scale = 2.0", ":2", "force_scale"),
            ("offset_m = [0, 0]", ":1", "offset_m"),
            ("offset = [0, 0, 0]", ":1", "offset"),
            ("scale = 1.0\nclutch_button = 99", ":2", "clutch_button"),
            ("enable = \"never\"", ":1", "enable"),
            ("enable = \"always\"\nenable_button = 0", ":2", "enable_button"),
            ("clutch_button = -1", ":1", "clutch_button"),
        ] {
            let refusal = parse("place.toml", text).unwrap_err();
            assert_eq!(refusal.field, field, "{refusal}");
            assert!(refusal.place.as_ref().unwrap().ends_with(place), "{refusal}");
        }
    }
}
