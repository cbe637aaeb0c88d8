//! Reads the bytes of a file from front to back: words, lines and numbers, in text and binary. Keeps the position for
//! error messages.

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

/// Byte order of a number.
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

    /// Returns whether it is a type of whole numbers.
    pub(super) fn is_integer(self) -> bool {
        !matches!(self, Scalar::F32 | Scalar::F64)
    }

    /// Returns the first `size` bytes as an unsigned number; missing bytes are 0.
    fn bits(self, bytes: &[u8], order: Order) -> u64 {
        let bytes = &bytes[..self.size().min(bytes.len())];
        let join = |bits: u64, byte: &u8| bits << 8 | u64::from(*byte);
        match order {
            Order::Little => bytes.iter().rev().fold(0, join),
            Order::Big => bytes.iter().fold(0, join),
        }
    }

    /// Decodes the number at the beginning of `bytes`.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub(super) fn real(self, bytes: &[u8], order: Order) -> f64 {
        match self {
            Scalar::F32 => f64::from(f32::from_bits(self.bits(bytes, order) as u32)),
            Scalar::F64 => f64::from_bits(self.bits(bytes, order)),
            _ => self.integer(bytes, order) as f64,
        }
    }

    /// Decodes the integer at the beginning of `bytes`; floating-point numbers are truncated.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
    pub(super) fn integer(self, bytes: &[u8], order: Order) -> i64 {
        let bits = self.bits(bytes, order);
        match self {
            Scalar::I8 => i64::from(bits as i8),
            Scalar::I16 => i64::from(bits as i16),
            Scalar::I32 => i64::from(bits as i32),
            Scalar::U8 | Scalar::U16 | Scalar::U32 | Scalar::I64 => bits as i64,
            // A larger number is out of every valid range in any case.
            Scalar::U64 => i64::try_from(bits).unwrap_or(i64::MAX),
            Scalar::F32 | Scalar::F64 => self.real(bytes, order) as i64,
        }
    }
}

/// The bytes of a file, and the current position.
#[derive(Clone)]
pub(super) struct Source<'a> {
    pub(super) file: &'a str,
    bytes: &'a [u8],
    at: usize,
    /// Whether messages give the byte rather than the line.
    pub(super) is_binary: bool,
    /// Whether the first line ends in a carriage return alone. In this case, a line feed after a carriage return
    /// belongs to the data that follows, which may be binary.
    ends_by_return: bool,
    /// Whether this is one row of a table rather than a file.
    is_row: bool,
}

impl<'a> Source<'a> {
    pub(super) fn new(file: &'a str, bytes: &'a [u8]) -> Self {
        let end = bytes.iter().position(is_line_end).map_or(&[][..], |end| &bytes[end..]);
        let ends_by_return = end.starts_with(b"\r") && !end.starts_with(b"\r\n");
        Self { file, bytes, at: 0, is_binary: false, ends_by_return, is_row: false }
    }

    /// Returns the bytes that have not been read yet.
    pub(super) fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }

    /// Creates an error at the current position.
    pub(super) fn fail(&self, problem: Problem) -> MeshError {
        let element = if self.is_binary {
            Element::Byte(self.at as u64)
        } else {
            // Reports the line of what was read last, not the line that begins here. A row is the last line of its
            // bytes.
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

    /// Returns the next line without its line ending, which is a line feed, a carriage return, or both. `None` at the
    /// end of the file.
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

    /// Returns the next line that contains a word, as a separate source. `None` at the end of the file.
    pub(super) fn row(&mut self) -> Option<Source<'a>> {
        loop {
            let at = self.at;
            let line = self.line()?;
            if words(line).next().is_some() {
                return Some(Source { bytes: &self.bytes[..at + line.len()], at, is_row: true, ..self.clone() });
            }
        }
    }

    /// Returns the next characters up to white space or the end of a line. `None` at the end of the file.
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

    /// Returns the next word without reading past it.
    pub(super) fn peek(&self) -> Option<&'a [u8]> {
        self.clone().word()
    }

    /// Reads the next word as a number.
    pub(super) fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, MeshError> {
        let word = self.word().ok_or_else(|| self.truncated(what))?;
        parsed(word).ok_or_else(|| self.no_number(word, what))
    }

    /// Creates the error for a word that should have been a number.
    pub(super) fn no_number(&self, word: &[u8], what: &str) -> MeshError {
        self.fail(no_number(word, what))
    }

    /// Reads the next `count` bytes.
    pub(super) fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8], MeshError> {
        let taken = self.rest().get(..count).ok_or_else(|| self.truncated(what))?;
        self.at += count;
        Ok(taken)
    }

    /// Reads the next number of a binary file as an integer.
    pub(super) fn integer(&mut self, scalar: Scalar, order: Order, what: &str) -> Result<i64, MeshError> {
        Ok(scalar.integer(self.take(scalar.size(), what)?, order))
    }

    /// Reads the next number of a binary file as a floating-point number.
    pub(super) fn real(&mut self, scalar: Scalar, order: Order, what: &str) -> Result<f64, MeshError> {
        Ok(scalar.real(self.take(scalar.size(), what)?, order))
    }

    /// Checks a count that the file states: so many records of at least `bytes` bytes must still follow. This way,
    /// nothing is allocated for data that is not there.
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

/// Returns whether a byte separates words: white space, and the NUL and Ctrl-Z with which some programs end text
/// files.
fn is_space(byte: &u8) -> bool {
    byte.is_ascii_whitespace() || matches!(byte, 0 | 0x0b | 0x1a)
}

/// Splits a line into words.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(is_space).filter(|word| !word.is_empty())
}

/// Describes a word that should have been a number.
pub(super) fn no_number(word: &[u8], what: &str) -> Problem {
    let text = shown(word);
    // Numbers such as 0,5 and 1.234,5: some programs write them in a local format.
    let parts = text.rsplit_once(',').filter(|(_, part)| part.starts_with(|digit: char| digit.is_ascii_digit()));
    let pointed = parts.map(|(whole, part)| format!("{}.{part}", whole.replace('.', "")));
    let message = match pointed.filter(|pointed| pointed.parse::<f64>().is_ok()) {
        Some(pointed) => format!("`{text}` has a decimal comma: export the file with decimal points, here {pointed}"),
        None => format!("`{text}` is not a number: {what} is expected"),
    };
    Problem::Syntax { message }
}

/// Parses a word as a number.
pub(super) fn parsed<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// Formats a word for a message: without control characters, at most 40 characters.
pub(super) fn shown(word: &[u8]) -> String {
    String::from_utf8_lossy(word).chars().filter(|letter| !letter.is_control()).take(40).collect()
}

/// Formats the name of a group: at most 256 characters.
pub(super) fn named(word: &[u8]) -> String {
    String::from_utf8_lossy(word).trim().chars().take(256).collect()
}
