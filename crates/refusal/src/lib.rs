//! The refusal of an input. Files, commands and requests share one type, so an input is refused in the same words
//! wherever it enters. [`printable`] makes text of other parties safe to show; `status` (a feature of this crate)
//! turns refusals into gRPC statuses.

pub mod printable;
#[cfg(feature = "status")]
pub mod status;

use std::fmt;

use crate::printable::{acts, printable};

macro_rules! reasons {
    ($($(#[$doc:meta])* $variant:ident = $name:literal,)*) => {
        /// Reason for which an input was refused. Programs may rely on these names: they are stable.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Reason { $($(#[$doc])* $variant,)* }

        impl Reason {
            /// Every reason, in the order of declaration.
            pub const ALL: &[Reason] = &[$(Reason::$variant,)*];

            /// Returns the name that clients see (`google.rpc.ErrorInfo.reason`): the variant's name in capitals, its
            /// words joined by `_`.
            pub fn as_str(self) -> &'static str {
                match self { $(Reason::$variant => $name,)* }
            }
        }
    };
}

reasons! {
    /// A file that can't be read, or a text that is not valid TOML, CSV or UTF-8.
    Unreadable = "UNREADABLE",
    /// A key that no scene, script or configuration has.
    UnknownKey = "UNKNOWN_KEY",
    /// A required field is absent.
    Missing = "MISSING",
    /// A value of the wrong type, or a name that is not among those allowed.
    WrongKind = "WRONG_KIND",
    /// A number is NaN or infinite.
    NotFinite = "NOT_FINITE",
    /// A value lies outside the range in which it is meaningful.
    OutOfRange = "OUT_OF_RANGE",
    /// A value is meaningful, but above a limit of the configuration.
    TooLarge = "TOO_LARGE",
    /// A force is above the limit for one point.
    ForceTooLarge = "FORCE_TOO_LARGE",
    /// A point, a control point or a place does not lie on the tissue.
    OffTissue = "OFF_TISSUE",
    /// No scene has this name.
    UnknownScene = "UNKNOWN_SCENE",
    /// No script has this name.
    UnknownScript = "UNKNOWN_SCRIPT",
    /// No exercise has this name.
    UnknownExercise = "UNKNOWN_EXERCISE",
    /// No session has this ID.
    UnknownSession = "UNKNOWN_SESSION",
    /// The session existed and has been deleted.
    SessionDeleted = "SESSION_DELETED",
    /// The guard, which checks each step for blow-ups and faults, has stopped the session.
    SessionHeld = "SESSION_HELD",
    /// The guard took the tissue back to an earlier state, and the effect of the command was lost.
    Recovered = "RECOVERED",
    /// This caller has no mesh of this ID, or the mesh has expired.
    UnknownMesh = "UNKNOWN_MESH",
    /// This caller has sent no journal of this ID, or the journal has expired.
    UnknownJournal = "UNKNOWN_JOURNAL",
    /// No viewer has this ID.
    UnknownViewer = "UNKNOWN_VIEWER",
    /// Another stream holds the tool.
    ToolHeld = "TOOL_HELD",
    /// The caller does not hold the tool that it commands, or no longer holds it.
    NotHolder = "NOT_HOLDER",
    /// The call carries no credentials that the server knows.
    Unauthenticated = "UNAUTHENTICATED",
    /// The caller lacks the role that the call requires.
    RoleMissing = "ROLE_MISSING",
    /// The session's ID is a trainee's, which does not open this call: the answer would show what the exercise hides, or the call is the
    /// trainer's.
    NotForTrainee = "NOT_FOR_TRAINEE",
    /// The request comes from a web page of an origin that is not allowed.
    OriginNotAllowed = "ORIGIN_NOT_ALLOWED",
    /// The sequence number is not above the previous one.
    StaleSequence = "STALE_SEQUENCE",
    /// The session's queue of waiting commands is full.
    QueueFull = "QUEUE_FULL",
    /// The requested step has already been computed.
    StepPassed = "STEP_PASSED",
    /// More sessions, streams or tools than the configuration allows.
    TooMany = "TOO_MANY",
    /// One more session would make the steps of others late.
    Overloaded = "OVERLOADED",
    /// Commands or calls arrive faster than the configuration allows.
    RateLimited = "RATE_LIMITED",
    /// An administrator of the server has ended the session, stream or call.
    Cut = "CUT",
    /// The awaited answer or event did not arrive in time.
    TimedOut = "TIMED_OUT",
    /// A stream must begin with exactly one opening message, and no later message may be one.
    OutOfTurn = "OUT_OF_TURN",
    /// This machine lacks a required feature.
    NotAvailable = "NOT_AVAILABLE",
    /// The server is shutting down.
    ShuttingDown = "SHUTTING_DOWN",
    /// Another server of the fleet has the session; [`Refusal::place`] is its endpoint.
    Elsewhere = "ELSEWHERE",
    /// The server may not step its sessions or answer for them: it has not heard from etcd for too long.
    Fenced = "FENCED",
}

/// A refusal of an input: what was refused and why. A refused input has changed nothing.
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
    /// The reason, for programs, which may rely on its name.
    pub reason: Reason,
    /// The offending field, as a path such as `sheet.spacing_m` or `force[0].profile.on_s`. Empty if no field is at
    /// fault.
    pub field: String,
    /// The problem and what would be right, for people.
    pub message: String,
    /// Where the input was written, such as `scenes/paper.toml:5` or `--set`; with [`Reason::Elsewhere`], the URL of
    /// the server that has the session. `None` for input that came over the network.
    pub place: Option<String>,
}

/// Result of a function that may refuse its input: its value, or the [`Refusal`].
pub type Result<T> = std::result::Result<T, Refusal>;

impl Refusal {
    /// Creates a refusal of `field`, which may be empty, with a `message` for people. Its place is `None`.
    pub fn new(reason: Reason, field: impl Into<String>, message: impl Into<String>) -> Self {
        Refusal { reason, field: field.into(), message: message.into(), place: None }
    }

    /// Puts `parent` and a dot before the refused field's path. An empty `parent` leaves the path as it is; an
    /// empty path becomes `parent`.
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
    /// Reduces the place to what follows its last `/` or `\`, the name of its file, for callers other than the
    /// server's operator: they must not learn the folders of this machine. An endpoint ([`Reason::Elsewhere`]) stays
    /// whole; field and message do not change.
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
        // Each part may quote text of other parties.
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

/// Returns `value` with 0 in place of −0. The two are equal in every meaning here but differ in their bits, which
/// hashes compare; and protobuf omits a field that equals 0, so −0 would come back as 0. All input of a tissue or a
/// session passes through this function. Every other value, NaN included, is returned as it is.
pub fn unsigned_zero(value: f64) -> f64 {
    value + 0.0
}

/// Rounds a value to ten significant digits, to show it to people. A computed value, or one that was a f32, has up
/// to 17 digits, most of which are rounding errors. Infinity and NaN are returned as they are.
pub fn legible(value: f64) -> f64 {
    format!("{value:.9e}").parse().unwrap_or(value)
}

/// Returns `value` if it is finite and `holds` is true for it; −0 becomes 0. `field` is the path that the refusal
/// names; `range` describes the accepted values in its message ("must be {range}, but is …").
///
/// # Errors
/// Refuses a number that is not finite ([`Reason::NotFinite`]), or for which `holds` is false
/// ([`Reason::OutOfRange`]).
pub fn number(field: &str, value: f64, range: &str, holds: impl Fn(f64) -> bool) -> Result<f64> {
    if !value.is_finite() {
        return Err(Refusal::new(Reason::NotFinite, field, format!("must be a finite number, but is {value}")));
    }
    if !holds(value) {
        // All digits, if the rounded value would seem to be in range.
        let value = Some(legible(value)).filter(|value| !holds(*value)).unwrap_or(value);
        return Err(Refusal::new(Reason::OutOfRange, field, format!("must be {range}, but is {value}")));
    }
    Ok(unsigned_zero(value))
}

/// Returns `value` if it is finite; −0 becomes 0. `field` is the path that the refusal names.
///
/// # Errors
/// Refuses infinity and NaN ([`Reason::NotFinite`]).
pub fn finite(field: &str, value: f64) -> Result<f64> {
    number(field, value, "finite", |_| true)
}

/// Returns `value` if it is finite and above 0. `field` is the path that the refusal names.
///
/// # Errors
/// Refuses a number that is not finite ([`Reason::NotFinite`]), and 0 or below ([`Reason::OutOfRange`]).
pub fn positive(field: &str, value: f64) -> Result<f64> {
    number(field, value, "above 0", |v| v > 0.0)
}

/// Returns `value` if it is finite and 0 or more; −0 becomes 0. `field` is the path that the refusal names.
///
/// # Errors
/// Refuses a number that is not finite ([`Reason::NotFinite`]) or below 0 ([`Reason::OutOfRange`]).
pub fn not_negative(field: &str, value: f64) -> Result<f64> {
    number(field, value, "0 or more", |v| v >= 0.0)
}

/// Returns `value` if its three components are finite; −0 becomes 0 in each. `field` is the path that the refusal
/// names; it does not name the component.
///
/// # Errors
/// Refuses a vector with a component that is infinite or NaN ([`Reason::NotFinite`]).
pub fn finite_vector(field: &str, value: glam::DVec3) -> Result<glam::DVec3> {
    for component in value.to_array() {
        finite(field, component)?;
    }
    Ok(value + glam::DVec3::ZERO)
}

/// Checks a text for people: at most 128 bytes of UTF-8, without characters that act on a terminal (control
/// characters, line breaks, text direction, most characters without width). It may be empty. `field` is the path
/// that the refusal names.
///
/// # Errors
/// Refuses a text that is too long or has such a character ([`Reason::OutOfRange`]).
pub fn label(field: &str, label: &str) -> Result<()> {
    const MAX_BYTES: usize = 128;
    if label.len() > MAX_BYTES || label.chars().any(acts) {
        let message = format!("must be at most {MAX_BYTES} bytes, without control characters");
        return Err(Refusal::new(Reason::OutOfRange, field, message));
    }
    Ok(())
}

/// Returns the name of `names` that `given` was probably meant to be: one that begins with it (from 3 letters), or
/// the one with the fewest misspelt letters (missing, added, replaced, or exchanged with the next). At most a third
/// of the letters of `given` may be misspelt, but at least 1 and at most 3. From 5 letters, the end of a name may be
/// missing, which counts as one misspelt letter. Of equally near names the first is returned; `None` if no name is
/// near. Spaces around `given` and its capitals do not count.
pub fn nearest<'n>(given: &str, names: impl IntoIterator<Item = &'n str>) -> Option<&'n str> {
    // A shorter text could begin too many names.
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

/// Returns "; did you mean `NAME`?" with the name that [`nearest`] finds in `names`, to append to a refusal of
/// `given`; empty if no name is near.
pub fn did_you_mean<'n>(given: &str, names: impl IntoIterator<Item = &'n str>) -> String {
    nearest(given, names).map_or(String::new(), |name| format!("; did you mean `{name}`?"))
}

/// Returns the first 64 characters of a client's text, to quote in a message. Characters that act on a terminal
/// stay; a [`Refusal`] replaces them when it is shown.
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
