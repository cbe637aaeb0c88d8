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
}

impl<'a> Source<'a> {
    pub(super) fn new(file: &'a str, bytes: &'a [u8]) -> Self {
        Self { file, bytes, at: 0, is_binary: false }
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
            // What was read last ends here; its line counts, not the one that begins.
            let read = &self.bytes[..self.at];
            let read = read.strip_suffix(b"\n").unwrap_or(read);
            Element::Line(1 + read.iter().filter(|byte| **byte == b'\n').count() as u64)
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
        self.fail(Problem::Truncated { missing: missing.into() })
    }

    /// The next line without its end; `None` at the end of the file.
    pub(super) fn line(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest();
        if rest.is_empty() {
            return None;
        }
        let end = rest.iter().position(|byte| *byte == b'\n');
        self.at += end.map_or(rest.len(), |end| end + 1);
        let line = &rest[..end.unwrap_or(rest.len())];
        Some(line.strip_suffix(b"\r").unwrap_or(line))
    }

    /// The next characters up to white space; `None` at the end of the file.
    pub(super) fn word(&mut self) -> Option<&'a [u8]> {
        let rest = self.rest();
        let start = rest.iter().position(|byte| !byte.is_ascii_whitespace());
        let Some(start) = start else {
            self.at = self.bytes.len();
            return None;
        };
        let word = &rest[start..];
        let end = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
        self.at += start + end;
        Some(&word[..end])
    }

    /// The next word, read as a number.
    pub(super) fn number<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, MeshError> {
        let word = self.word().ok_or_else(|| self.truncated(what))?;
        parsed(word).ok_or_else(|| self.syntax(format!("`{}` is no number: {what} is expected", shown(word))))
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
        let count = usize::try_from(count).map_err(|_| self.syntax(format!("{count} is no count of {what}")))?;
        if count.checked_mul(bytes.max(1)).is_none_or(|bytes| bytes > self.rest().len() + 1) {
            return Err(self.truncated(format!("a part of {count} {what}")));
        }
        Ok(count)
    }
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
