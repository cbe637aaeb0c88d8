//! Text of other parties in a terminal and in a log: names, addresses, keys of etcd, messages of servers. It must
//! not move the cursor, begin a line, or reorder the text beside it.

use std::fmt::Display;

/// Returns whether a character does something other than show itself: control characters (C0, DEL, C1), line
/// separators, direction marks, and characters without width. The joiners U+200C and U+200D are not among them,
/// because some scripts need them.
pub(crate) fn acts(c: char) -> bool {
    c.is_control()
        || matches!(
            c,
            '\u{061c}' // direction
                | '\u{200b}' | '\u{200e}' | '\u{200f}' // no width, direction
                | '\u{2028}'..='\u{202e}' // lines, paragraphs, direction
                | '\u{2060}'..='\u{206f}' // no width, direction
                | '\u{feff}' | '\u{fff9}'..='\u{fffb}' // byte order, annotations
                | '\u{e0000}'..='\u{e007f}' // tags
        )
}

/// Returns `text` for use within a line: replaces each character that acts on a terminal by one `?`. These are control
/// characters, line breaks included, marks of text direction, and characters without width, except the joiners
/// U+200C and U+200D.
pub fn printable(text: impl Display) -> String {
    text.to_string().replace(acts, "?")
}

/// Returns `text` with each character that acts on a terminal ([`printable`]), except `\n`, replaced by `?`: for text
/// whose line breaks are our own.
pub fn printable_lines(text: impl Display) -> String {
    text.to_string().replace(|c| acts(c) && c != '\n', "?")
}

/// Returns `json` with each character that acts on a terminal ([`printable`]), except `\n`, escaped as `\uXXXX` in
/// UTF-16 units, so that a JSON parser still reads the same value. `json` must be valid JSON, which is not checked,
/// and have such characters only in strings: a tab or `\r` between values would be escaped as well.
pub fn printable_json(json: impl Display) -> String {
    let json = json.to_string();
    let is_rare = |c: char| acts(c) && c != '\n';
    if !json.contains(is_rare) {
        return json;
    }
    let mut text = String::with_capacity(json.len() + 64);
    for c in json.chars() {
        if is_rare(c) {
            let mut units = [0; 2];
            text.extend(c.encode_utf16(&mut units).iter().map(|unit| format!("\\u{unit:04x}")));
        } else {
            text.push(c);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const HOSTILE: &str = "a\x1b[2J\r\n\x07\u{7f}\u{9b}2J\u{85}\u{202e}\u{2066}\u{2028}\u{200b}\u{feff}\u{e0041}z";

    #[test]
    fn what_acts_on_a_terminal_is_replaced_and_nothing_else() {
        assert_eq!(printable(HOSTILE), "a?[2J?????2J???????z");
        assert_eq!(printable_lines("a\nb\rc"), "a\nb?c");
        for fine in ["Leber größer 肝臓", "می\u{200c}خواهم", "👩\u{200d}⚕\u{fe0f}", "a b\u{a0}c\u{ad}d"]
        {
            assert_eq!(printable(fine), fine);
        }
    }

    #[test]
    fn json_keeps_its_meaning() {
        let value = serde_json::json!({ "name": HOSTILE });
        for json in [value.to_string(), serde_json::to_string_pretty(&value).unwrap()] {
            let text = printable_json(&json);
            assert!(text.chars().all(|c| !acts(c) || c == '\n'), "{text:?}");
            assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap(), value);
        }
    }
}
