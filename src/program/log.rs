//! Log of `palpate serve`: names and messages of others can neither control a terminal nor begin a line.

use std::io::{Result, Write};

use palpate_refusal::printable::{printable, printable_json};
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::format::{FormatFields, debug_fn};

/// Parses a filter: a level for everything, `target=level` for one part, or several of both, separated by commas.
/// [`Targets`] alone would take a misspelled level for the name of a target.
///
/// # Errors
/// Names the part that is neither.
pub(super) fn filter(text: &str) -> std::result::Result<Targets, String> {
    let level = |part: &str, name: &str| {
        // An empty text would be a level too.
        let level = name.parse::<LevelFilter>().ok().filter(|_| !name.is_empty());
        level.ok_or_else(|| {
            format!("`{part}` is neither a level (off, error, warn, info, debug, trace) nor target=level")
        })
    };
    text.split(',').map(str::trim).try_fold(Targets::new(), |filter, part| match part.split_once('=') {
        Some((target, name)) if !target.is_empty() => Ok(filter.with_target(target, level(part, name)?)),
        _ => Ok(filter.with_default(level(part, part)?)),
    })
}

/// Format of a record's fields, which come from others, including the message.
pub(super) fn fields() -> impl for<'w> FormatFields<'w> + 'static {
    let write = |writer: &mut tracing_subscriber::fmt::format::Writer<'_>,
                 field: &tracing::field::Field,
                 value: &dyn std::fmt::Debug| {
        let value = printable(format_args!("{value:?}"));
        if field.name() == "message" { writer.write_str(&value) } else { write!(writer, "{field}={value}") }
    };
    debug_fn(write).delimited(" ")
}

/// Writer of records in JSON. Each record is one call and ends in a new line.
pub(super) struct JsonRecords<W>(pub(super) W);

impl<W: Write> Write for JsonRecords<W> {
    fn write(&mut self, record: &[u8]) -> Result<usize> {
        self.0.write_all(printable_json(String::from_utf8_lossy(record)).as_bytes())?;
        Ok(record.len())
    }

    fn flush(&mut self) -> Result<()> {
        self.0.flush()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::sync::mpsc::{Sender, channel};

    use super::*;

    #[test]
    fn a_filter_names_levels_and_targets() {
        let chosen = filter("warn, palpate=debug,tonic=off").unwrap();
        for (target, level, enabled) in [
            ("hyper", tracing::Level::WARN, true),
            ("hyper", tracing::Level::INFO, false),
            ("palpate::server", tracing::Level::DEBUG, true),
            ("tonic", tracing::Level::ERROR, false),
        ] {
            assert_eq!(chosen.would_enable(target, &level), enabled, "{target} {level}");
        }
        for (text, wrong) in
            [("=,=", "`=`"), ("", "``"), ("inof", "`inof`"), ("info,", "``"), ("palpate=", "`palpate=`")]
        {
            assert!(filter(text).unwrap_err().starts_with(wrong), "{text}");
        }
    }

    struct SentLine(Sender<Vec<u8>>);

    impl Write for SentLine {
        fn write(&mut self, bytes: &[u8]) -> Result<usize> {
            let _ = self.0.send(bytes.to_vec());
            Ok(bytes.len())
        }

        fn flush(&mut self) -> Result<()> {
            Ok(())
        }
    }

    /// Returns the log of a hostile name: in the message, as fields, and as a field of a span.
    fn logged(json: bool, colours: bool) -> String {
        let (sent, received) = channel();
        let builder = tracing_subscriber::fmt().with_ansi(colours);
        let name = "a\x1b[2J\r\n\u{9b}2J\u{202e}\u{2066}\u{85}z";
        let log = || {
            let _span = tracing::info_span!("call", path = %name).entered();
            tracing::warn!(node = name, shown = %name, "{name}: is gone");
        };
        if json {
            let builder = builder.json().with_writer(move || JsonRecords(SentLine(sent.clone())));
            tracing::subscriber::with_default(builder.finish(), log);
        } else {
            let builder = builder.fmt_fields(fields()).with_writer(move || SentLine(sent.clone()));
            tracing::subscriber::with_default(builder.finish(), log);
        }
        String::from_utf8(received.into_iter().flatten().collect()).unwrap()
    }

    #[test]
    fn a_record_is_one_line_that_acts_on_no_terminal() {
        let acts = |text: &str| text.chars().any(|c| c.is_control() || "\u{202e}\u{2066}".contains(c));
        for json in [false, true] {
            let text = logged(json, false);
            let line = text.strip_suffix('\n').unwrap();
            assert!(!acts(line) && line.contains("is gone"), "{text:?}");
            assert_eq!(serde_json::from_str::<serde_json::Value>(line).is_ok(), json);
        }
        // The colours are those of the log: each is `ESC [ digits m`.
        let text = logged(false, true);
        let parts: Vec<&str> = text.strip_suffix('\n').unwrap().split('\x1b').collect();
        assert!(parts.len() > 1 && parts.iter().all(|part| !acts(part)), "{text:?}");
        for part in &parts[1..] {
            let end = part.find(|c: char| c != '[' && !c.is_ascii_digit());
            assert!(end.is_some_and(|end| part[end..].starts_with('m')), "{part:?}");
        }
    }
}
