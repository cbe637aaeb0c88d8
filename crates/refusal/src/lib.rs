//! The refusal of an input: one type for files, commands and requests. So an input is refused in the same words wherever
//! it enters. [`printable`] shows text of others; `status` (a feature of the crate) has refusals as gRPC statuses.

pub mod printable;
#[cfg(feature = "status")]
pub mod status;

use std::fmt;

use crate::printable::{acts, printable};

macro_rules! reasons {
    ($($(#[$doc:meta])* $variant:ident = $name:literal,)*) => {
        /// Why an input was refused: stable names, for programs.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Reason { $($(#[$doc])* $variant,)* }

        impl Reason {
            /// All of them.
            pub const ALL: &[Reason] = &[$(Reason::$variant,)*];

            /// Returns the name that clients see (`google.rpc.ErrorInfo.reason`).
            pub fn as_str(self) -> &'static str {
                match self { $(Reason::$variant => $name,)* }
            }
        }
    };
}

reasons! {
    /// A file that can't be read or a text that is not TOML, CSV or UTF-8.
    Unreadable = "UNREADABLE",
    /// A key that no scene, script or configuration has.
    UnknownKey = "UNKNOWN_KEY",
    /// A required field that is not there.
    Missing = "MISSING",
    /// A value of the wrong kind, or a name that is none of those allowed.
    WrongKind = "WRONG_KIND",
    /// NaN or infinite.
    NotFinite = "NOT_FINITE",
    /// Outside the range that makes sense.
    OutOfRange = "OUT_OF_RANGE",
    /// Sensible, but above a limit of the configuration.
    TooLarge = "TOO_LARGE",
    /// A force above the limit on a point.
    ForceTooLarge = "FORCE_TOO_LARGE",
    /// A point or a control point that is not on the sheet.
    OffTissue = "OFF_TISSUE",
    /// No scene of that name.
    UnknownScene = "UNKNOWN_SCENE",
    /// No script of that name.
    UnknownScript = "UNKNOWN_SCRIPT",
    /// No session of that id.
    UnknownSession = "UNKNOWN_SESSION",
    /// The session was there, and has been deleted.
    SessionDeleted = "SESSION_DELETED",
    /// The guard has ended the session.
    SessionHeld = "SESSION_HELD",
    /// The guard took the tissue back to an earlier state, and the effect of the command was lost.
    Recovered = "RECOVERED",
    /// No mesh of that id, of this caller; or it has expired.
    UnknownMesh = "UNKNOWN_MESH",
    /// No journal of that id was sent by this caller; or it has expired.
    UnknownJournal = "UNKNOWN_JOURNAL",
    /// No viewer of that id.
    UnknownViewer = "UNKNOWN_VIEWER",
    /// Another holds the tool.
    ToolHeld = "TOOL_HELD",
    /// The tool is not held by who commands it, or no longer.
    NotHolder = "NOT_HOLDER",
    /// A call by nobody that the server knows.
    Unauthenticated = "UNAUTHENTICATED",
    /// Who calls has not got the role that the call asks for.
    RoleMissing = "ROLE_MISSING",
    /// A page of another site.
    OriginNotAllowed = "ORIGIN_NOT_ALLOWED",
    /// The sequence number is not above the last one.
    StaleSequence = "STALE_SEQUENCE",
    /// More commands are waiting than the session keeps.
    QueueFull = "QUEUE_FULL",
    /// The moment asked for is over.
    StepPassed = "STEP_PASSED",
    /// More sessions, streams or tools than the configuration allows.
    TooMany = "TOO_MANY",
    /// A further session would make the steps of others late.
    Overloaded = "OVERLOADED",
    /// Commands or calls come faster than the configuration allows.
    RateLimited = "RATE_LIMITED",
    /// Whoever administers the server has ended it.
    Cut = "CUT",
    /// What was waited for did not come in time.
    TimedOut = "TIMED_OUT",
    /// The first message of a stream must open it, and only the first.
    OutOfTurn = "OUT_OF_TURN",
    /// Something that this machine has not got.
    NotAvailable = "NOT_AVAILABLE",
    /// The server is going down.
    ShuttingDown = "SHUTTING_DOWN",
    /// Another server of the fleet has the session; [`Refusal::place`] is its endpoint.
    Elsewhere = "ELSEWHERE",
    /// The server may not speak for its sessions: it has not heard from etcd for too long.
    Fenced = "FENCED",
}

/// What was refused and why. It changed nothing.
///
/// A refusal has a reason for programs, and a field and a message for people:
///
/// ```
/// use palpate_refusal::{Reason, positive};
///
/// let refusal = positive("spacing_m", -0.01).expect_err("no sheet has points -10 mm apart").within("sheet");
/// assert_eq!((refusal.reason, refusal.reason.as_str()), (Reason::OutOfRange, "OUT_OF_RANGE"));
/// assert_eq!(refusal.to_string(), "sheet.spacing_m: must be above 0, but is -0.01");
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Refusal {
    /// For programs.
    pub reason: Reason,
    /// The offending field, as a path: `sheet.spacing_m`, `force[0].profile.on_s`. Empty if none is.
    pub field: String,
    /// For people: what is wrong, and what would be right.
    pub message: String,
    /// Where it was written: `scenes/paper.toml:5`, `--set`. Absent for what came over the network.
    pub place: Option<String>,
}

/// What most functions here return.
pub type Result<T> = std::result::Result<T, Refusal>;

impl Refusal {
    /// Creates a refusal of `field`.
    pub fn new(reason: Reason, field: impl Into<String>, message: impl Into<String>) -> Self {
        Refusal { reason, field: field.into(), message: message.into(), place: None }
    }

    /// Returns the same, of a field of `parent`.
    #[must_use]
    pub fn within(mut self, parent: &str) -> Self {
        self.field = match (parent, self.field.as_str()) {
            (parent, "") => parent.to_owned(),
            ("", field) => field.to_owned(),
            (parent, field) => format!("{parent}.{field}"),
        };
        self
    }
}

impl Refusal {
    /// Returns it for others than who runs the server: of the place only the file's name, and not in which folder of this machine it is.
    #[must_use]
    pub fn without_folder(self) -> Self {
        let name = |place: String| match place.rsplit_once(['/', '\\']) {
            Some((_, name)) if self.reason != Reason::Elsewhere => name.to_owned(),
            _ => place,
        };
        Refusal { place: self.place.map(name), ..self }
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Each part may quote what others have written.
        if let Some(place) = &self.place {
            write!(f, "{}: ", printable(place))?;
        }
        if !self.field.is_empty() {
            write!(f, "{}: ", printable(&self.field))?;
        }
        f.write_str(&printable(&self.message))
    }
}

impl std::error::Error for Refusal {}

/// Returns a number with 0 in place of −0. They are equal in all that a number here means, but not in their bits, which
/// hashes compare; and protobuf leaves out a field that equals 0, so that −0 comes back as 0. What enters a tissue or a
/// session goes through this.
pub fn unsigned_zero(value: f64) -> f64 {
    value + 0.0
}

/// Returns the value with at most ten digits, to show to people: what was computed, or was a f32, has up to 17, and
/// most are rounding.
pub fn legible(value: f64) -> f64 {
    format!("{value:.9e}").parse().unwrap_or(value)
}

/// Returns `value`, if it is finite and `holds` is true for it; `range` describes those values. −0 comes back as 0.
///
/// # Errors
/// Refuses a number that is not finite, or for which `holds` is false.
pub fn number(field: &str, value: f64, range: &str, holds: impl Fn(f64) -> bool) -> Result<f64> {
    if !value.is_finite() {
        return Err(Refusal::new(Reason::NotFinite, field, format!("must be a finite number, but is {value}")));
    }
    if !holds(value) {
        // All digits where fewer would seem to be in range.
        let value = Some(legible(value)).filter(|value| !holds(*value)).unwrap_or(value);
        return Err(Refusal::new(Reason::OutOfRange, field, format!("must be {range}, but is {value}")));
    }
    Ok(unsigned_zero(value))
}

/// Returns `value` if it is finite.
///
/// # Errors
/// Refuses infinity and NaN.
pub fn finite(field: &str, value: f64) -> Result<f64> {
    number(field, value, "finite", |_| true)
}

/// Returns `value` if it is finite and above 0.
///
/// # Errors
/// Refuses a number that is not finite, 0 or below.
pub fn positive(field: &str, value: f64) -> Result<f64> {
    number(field, value, "above 0", |v| v > 0.0)
}

/// Returns `value` if it is finite and 0 or more.
///
/// # Errors
/// Refuses a number that is not finite or below 0.
pub fn not_negative(field: &str, value: f64) -> Result<f64> {
    number(field, value, "0 or more", |v| v >= 0.0)
}

/// Returns `value` if its three components are finite. −0 comes back as 0.
///
/// # Errors
/// Refuses a vector with a component that is not finite.
pub fn finite_vector(field: &str, value: glam::DVec3) -> Result<glam::DVec3> {
    for component in value.to_array() {
        finite(field, component)?;
    }
    Ok(value + glam::DVec3::ZERO)
}

/// Checks a text for people: it is short, on one line, and without what acts on a terminal.
///
/// # Errors
/// Refuses a text that is too long or has control characters.
pub fn label(field: &str, label: &str) -> Result<()> {
    const MAX_BYTES: usize = 128;
    if label.len() > MAX_BYTES || label.chars().any(acts) {
        let message = format!("must be at most {MAX_BYTES} bytes, without control characters");
        return Err(Refusal::new(Reason::OutOfRange, field, message));
    }
    Ok(())
}

/// Returns the name that `given` is probably meant to be: one that begins with it, or the nearest by its letters, of
/// which the last may be left out. None if no name is near.
pub fn nearest<'n>(given: &str, names: impl IntoIterator<Item = &'n str>) -> Option<&'n str> {
    // A shorter beginning could be that of anything.
    const MIN_BEGINNING: usize = 3;
    const MIN_MISSPELT: usize = 5;
    let given = given.trim().to_lowercase();
    let letters = given.chars().count();
    let most = (letters / 3).clamp(1, 3);
    let misses = |name: &str| {
        let begins = letters >= MIN_BEGINNING && name.starts_with(&given);
        // A beginning is nearer than any misspelling.
        let apart = if begins { 0 } else { strsim::damerau_levenshtein(&given, &name.to_lowercase()) };
        let beginning = |count: usize| name.chars().take(count).collect::<String>().to_lowercase();
        let of_beginning = if letters < MIN_MISSPELT {
            usize::MAX
        } else {
            let counts = [letters - 1, letters, letters + 1].into_iter();
            counts.map(|count| 1 + strsim::damerau_levenshtein(&given, &beginning(count))).min().unwrap_or(usize::MAX)
        };
        let apart = apart.min(of_beginning);
        (apart <= most && apart < name.chars().count().max(letters)).then_some(apart)
    };
    let near = names.into_iter().filter_map(|name| Some((misses(name)?, name)));
    near.min_by_key(|(apart, _)| *apart).map(|(_, name)| name)
}

/// Returns "; did you mean `NAME`?", to be put behind a refusal of `given`; empty if no name is near.
pub fn did_you_mean<'n>(given: &str, names: impl IntoIterator<Item = &'n str>) -> String {
    nearest(given, names).map_or(String::new(), |name| format!("; did you mean `{name}`?"))
}

/// Returns the beginning of what a client sent: a message is no place for megabytes.
pub fn excerpt(text: &str) -> String {
    text.chars().take(64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_told_have_ten_digits_unless_they_would_seem_to_be_in_range() {
        let told = |value: f64| number("x", value, "below 0.3", |v| v < 0.3).unwrap_err().to_string();
        assert_eq!(told(0.75), "x: must be below 0.3, but is 0.75");
        assert_eq!(told(f64::from(0.7_f32)), "x: must be below 0.3, but is 0.6999999881");
        let below = number("x", 0.1 + 0.2, "at most 0.3", |v| v <= 0.3).unwrap_err().to_string();
        assert_eq!(below, "x: must be at most 0.3, but is 0.30000000000000004");
        assert_eq!(legible(f64::INFINITY), f64::INFINITY);
    }

    #[test]
    fn a_name_is_meant_that_begins_so_or_differs_by_a_letter_or_two() {
        let names = ["edges", "corners", "vertical-60", "exponential2", "exponential4", "k"];
        for (given, meant) in [
            ("edge", Some("edges")),
            ("Edges", Some("edges")),
            ("cornres", Some("corners")),
            ("vertcal-60", Some("vertical-60")),
            ("vertical", Some("vertical-60")),
            ("vertcal", Some("vertical-60")),
            ("exponentail4", Some("exponential4")),
            ("middle", None),
            ("c", None),
            ("", None),
        ] {
            assert_eq!(nearest(given, names), meant, "{given}");
        }
        assert_eq!(did_you_mean("edge", names), "; did you mean `edges`?");
        assert_eq!(did_you_mean("middle", names), "");
    }

    #[test]
    fn what_a_client_sent_moves_no_cursor_and_begins_no_line() {
        let refusal = Refusal::new(Reason::UnknownScene, "scene_name", "there is no `a\x1b[2J\r\nINFO\u{9b}`");
        assert_eq!(refusal.to_string(), "scene_name: there is no `a?[2J??INFO?`");
        let of_file =
            Refusal { place: Some("a\n.toml:1".into()), ..Refusal::new(Reason::Unreadable, "b\u{202e}", "two\nlines") };
        assert_eq!(of_file.to_string(), "a?.toml:1: b?: two?lines");
        assert!(label("name", "a\u{202e}b").is_err());
    }

    #[test]
    fn others_are_told_a_files_name_and_not_its_folder() {
        let of = |reason, place: &str| Refusal { place: Some(place.to_owned()), ..Refusal::new(reason, "", "why") };
        let told = |reason, place: &str| of(reason, place).without_folder().to_string();
        assert_eq!(told(Reason::Unreadable, "/srv/secret/5e.1.mcap"), "5e.1.mcap: why");
        assert_eq!(told(Reason::Unreadable, "scenes/paper.toml:5"), "paper.toml:5: why");
        assert_eq!(told(Reason::Unreadable, "--set"), "--set: why");
        assert_eq!(told(Reason::Elsewhere, "http://127.0.0.1:7117"), "http://127.0.0.1:7117: why");
    }
}
