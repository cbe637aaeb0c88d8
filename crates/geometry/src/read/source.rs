//! A file's bytes from front to back: words, lines and numbers, in text and binary, with the place for messages.

use crate::{Element, MeshError, Problem};

/// The type of a number in a binary file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

/// The order of a number's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    Little,
    Big,
}

impl Scalar {
    pub(super) fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }

    /// The first `size` bytes as an unsigned number; missing ones are 0.
    fn bits(self, bytes: &[u8], order: Order) -> u64 {
        let bytes = &bytes[..self.size().min(bytes.len())];
        let join = |bits: u64, byte: &u8| bits << 8 | u64::from(*byte);
        match order {
            Order::Little => bytes.iter().rev().fold(0, join),
            Order::Big => bytes.iter().fold(0, join),
        }
    }

    /// The number that the first bytes are.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub(super) fn real(self, bytes: &[u8], order: Order) -> f64 {
        match self {
            Scalar::F32 => f64::from(f32::from_bits(self.bits(bytes, order) as u32)),
            Scalar::F64 => f64::from_bits(self.bits(bytes, order)),
            _ => self.integer(bytes, order) as f64,
        }
    }

    /// The integer that the first bytes are; floating-point numbers are truncated.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    pub(super) fn integer(self, bytes: &[u8], order: Order) -> i64 {
        let bits = self.bits(bytes, order);
        match self {
            Scalar::I8 => i64::from(bits as i8),
            Scalar::I16 => i64::from(bits as i16),
            Scalar::I32 => i64::from(bits as i32),
            Scalar::U8 | Scalar::U16 | Scalar::U32 | Scalar::I64 => bits as i64,
            // What does not fit is out of every range.
            Scalar::U64 => i64::try_from(bits).unwrap_or(i64::MAX),
            Scalar::F32 | Scalar::F64 => self.real(bytes, order) as i64,
        }
    }
}

/// The bytes of a file, and how far they are read.
#[derive(Clone)]
pub(super) struct Source<'a> {
    pub(super) file: &'a str,
    bytes: &'a [u8],
    at: usize,
    /// Whether messages give bytes rather than lines.
    pub(super) is_binary: bool,
    /// Whether its first line ends in a carriage return alone. A line feed after one then belongs to what follows, which may be
    /// binary.
    ends_by_return: bool,
    /// Whether it is one row of a table rather than a file.
    is_row: bool,
}

impl<'a> Source<'a> {
    pub(super) fn new(file: &'a str, bytes: &'a [u8]) -> Self {
        let end = bytes.iter().position(is_line_end).map_or(&[][..], |end| &bytes[end..]);
        let ends_by_return = end.starts_with(b"\r") && !end.starts_with(b"\r\n");
        Self { file, bytes, at: 0, is_binary: false, ends_by_return, is_row: false }
    }

    /// The bytes that are not read yet.
    pub(super) fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }

    /// An error at the next byte.
    pub(super) fn fail(&self, problem: Problem) -> MeshError {
        let element = if self.is_binary {
            Element::Byte(self.at as u64)
        } else {
            // What was read last ends here; its line counts, not the one that begins. A row is the last line of its bytes.
            let end = if self.is_row { self.bytes.len() } else { self.at };
            let mut source = Source { bytes: &self.bytes[..end], at: 0, ..self.clone() };
            let mut line = 0;
            while source.line().is_some() {
                line += 1;
            }
            Element::Line(line.max(1))
        };
        self.fail_at(element, problem)
    }

    pub(super) fn fail_at(&self, element: Element, problem: Problem) -> MeshError {
        MeshError { file: self.file.to_owned(), element, place_m: None, problem }
    }

    pub(super) fn syntax(&self, message: impl Into<String>) -> MeshError {
        self.fail(Problem::Syntax { message: message.into() })
    }

    pub(super) fn truncated(&self, missing: impl Into<String>) -> MeshError {
        let missing = missing.into();
        if self.is_row {
            return self.syntax(format!("the row ends early: {missing} is missing"));
        }
        self.fail(Problem::Truncated { missing })
    }

    /// The next line without its end, which is a line feed, a carriage return, or both; `None` at the end of the file.
    pub(super) fn line(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest();
        if rest.is_empty() {
            return None;
        }
        let Some(end) = rest.iter().position(is_line_end) else {
            self.at = self.bytes.len();
            return Some(rest);
        };
        let is_pair = !self.ends_by_return && rest[end..].starts_with(b"\r\n");
        self.at += end + 1 + usize::from(is_pair);
        Some(&rest[..end])
    }

    /// The next line that has a word, as a source of its own; `None` at the end of the file.
    pub(super) fn row(&mut self) -> Option<Source<'a>> {
        loop {
            let at = self.at;
            let line = self.line()?;
            if words(line).next().is_some() {
                return Some(Source { bytes: &self.bytes[..at + line.len()], at, is_row: true, ..self.clone() });
            }
        }
    }

    /// The next characters up to a space or the end of a line; `None` at the end of the file.
    pub(super) fn word(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest();
        let Some(start) = rest.iter().position(|byte| !is_space(byte)) else {
            self.at = self.bytes.len();
            return None;
        };
        let word = &rest[start..];
        let end = word.iter().position(is_space).unwrap_or(word.len());
        self.at += start + end;
        Some(&word[..end])
    }

    /// The word that `word` would return.
    pub(super) fn peek(&self) -> Option<&'a [u8]> {
        self.clone().word()
    }

    /// The next word, read as a number.
    pub(super) fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, MeshError> {
        let word = self.word().ok_or_else(|| self.truncated(what))?;
        parsed(word).ok_or_else(|| self.no_number(word, what))
    }

    /// The error of a word in the place of a number.
    pub(super) fn no_number(&self, word: &[u8], what: &str) -> MeshError {
        self.fail(no_number(word, what))
    }

    /// The next `count` bytes.
    pub(super) fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8], MeshError> {
        let taken = self.rest().get(..count).ok_or_else(|| self.truncated(what))?;
        self.at += count;
        Ok(taken)
    }

    /// The next number of a binary file.
    pub(super) fn integer(&mut self, scalar: Scalar, order: Order, what: &str) -> Result<i64, MeshError> {
        Ok(scalar.integer(self.take(scalar.size(), what)?, order))
    }

    /// The next number of a binary file.
    pub(super) fn real(&mut self, scalar: Scalar, order: Order, what: &str) -> Result<f64, MeshError> {
        Ok(scalar.real(self.take(scalar.size(), what)?, order))
    }

    /// A count that the file states, if that many records of at least `bytes` bytes can still follow. So nothing is
    /// allocated or counted for what is not there.
    pub(super) fn count(&self, count: i64, bytes: usize, what: &str) -> Result<usize, MeshError> {
        let count = usize::try_from(count).map_err(|_| self.syntax(format!("{count} is not a count of {what}")))?;
        if count.checked_mul(bytes.max(1)).is_none_or(|bytes| bytes > self.rest().len() + 1) {
            return Err(self.truncated(format!("a part of {count} {what}")));
        }
        Ok(count)
    }
}

fn is_line_end(byte: &u8) -> bool {
    matches!(byte, b'\n' | b'\r')
}

/// Whether a byte separates words: white space, and the NUL and Ctrl-Z by which some programs end texts.
fn is_space(byte: &u8) -> bool {
    byte.is_ascii_whitespace() || matches!(byte, 0 | 0x0b | 0x1a)
}

/// The words of a line.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(is_space).filter(|word| !word.is_empty())
}

/// What is wrong with a word in the place of a number.
pub(super) fn no_number(word: &[u8], what: &str) -> Problem {
    let text = shown(word);
    // 0,5 and 1.234,5: some programs write numbers as people do.
    let parts = text.rsplit_once(',').filter(|(_, part)| part.starts_with(|digit: char| digit.is_ascii_digit()));
    let pointed = parts.map(|(whole, part)| format!("{}.{part}", whole.replace('.', "")));
    let message = match pointed.filter(|pointed| pointed.parse::<f64>().is_ok()) {
        Some(pointed) => format!("`{text}` has a decimal comma: export the file with decimal points, here {pointed}"),
        None => format!("`{text}` is not a number: {what} is expected"),
    };
    Problem::Syntax { message }
}

/// A word as a number.
pub(super) fn parsed<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// A word for a message.
pub(super) fn shown(word: &[u8]) -> String {
    String::from_utf8_lossy(word).chars().filter(|letter| !letter.is_control()).take(40).collect()
}

/// A name for a group; the first 256 characters.
pub(super) fn named(word: &[u8]) -> String {
    String::from_utf8_lossy(word).trim().chars().take(256).collect()
}
