//! What `palpate serve` logs: names and messages of others can neither act on a terminal nor begin a line.

use std::io::{Result, Write};

use palpate::printable::printable;

/// Writes records of a log, each of which is one call and ends in a new line of its own.
pub(super) struct Records<W> {
    pub(super) writer: W,
    /// Makes the text of a record printable.
    pub(super) printed: fn(&str) -> String,
}

impl<W: Write> Write for Records<W> {
    fn write(&mut self, record: &[u8]) -> Result<usize> {
        let text = String::from_utf8_lossy(record);
        let text = (self.printed)(text.strip_suffix('\n').unwrap_or(&text)) + "\n";
        self.writer.write_all(text.as_bytes())?;
        Ok(record.len())
    }

    fn flush(&mut self) -> Result<()> {
        self.writer.flush()
    }
}

/// Like [`printable`], but keeps ESC, which begins a colour of the log itself: `tracing-subscriber` escapes those of others.
pub(super) fn printable_in_colour(text: &str) -> String {
    text.split('\x1b').map(printable).collect::<Vec<_>>().join("\x1b")
}

#[cfg(test)]
mod tests {
    use palpate::printable::printable_json;

    use super::*;

    /// What a server logs of a hostile name, in `message` and as a field.
    fn logged(json: bool, colours: bool, printed: fn(&str) -> String) -> String {
        let (sent, received) = std::sync::mpsc::channel();
        struct Sent(std::sync::mpsc::Sender<Vec<u8>>);
        impl Write for Sent {
            fn write(&mut self, bytes: &[u8]) -> Result<usize> {
                let _ = self.0.send(bytes.to_vec());
                Ok(bytes.len())
            }
            fn flush(&mut self) -> Result<()> {
                Ok(())
            }
        }
        let subscriber = tracing_subscriber::fmt()
            .with_ansi(colours)
            .with_writer(move || Records { writer: Sent(sent.clone()), printed });
        let name = "a\x1b[2J\r\n\u{9b}2J\u{202e}\u{2066}\u{85}z";
        let log = || tracing::warn!(node = name, shown = %name, "{name}: is gone");
        if json {
            tracing::subscriber::with_default(subscriber.json().finish(), log);
        } else {
            tracing::subscriber::with_default(subscriber.finish(), log);
        }
        String::from_utf8(received.into_iter().flatten().collect()).unwrap_or_default()
    }

    #[test]
    fn a_record_is_one_line_that_acts_on_no_terminal() {
        let acts =
            |text: &str| text.trim_end_matches('\n').chars().any(|c| c.is_control() || "\u{202e}\u{2066}".contains(c));
        for (text, json) in [
            (logged(false, false, |text| printable(text)), false),
            (logged(true, false, |text| printable_json(text)), true),
        ] {
            assert!(text.ends_with('\n') && !acts(&text), "{text:?}");
            assert_eq!(serde_json::from_str::<serde_json::Value>(&text).is_ok(), json);
        }
        // The colours are those of the log: each is `ESC [ digits m`.
        let coloured = logged(false, true, printable_in_colour);
        assert!(coloured.contains('\x1b') && coloured.ends_with('\n'), "{coloured:?}");
        for part in coloured.split('\x1b').skip(1) {
            let end = part.find(|c: char| c != '[' && !c.is_ascii_digit());
            assert!(end.is_some_and(|end| part[end..].starts_with('m')), "{part:?}");
            assert!(!acts(part), "{part:?}");
        }
    }
}
