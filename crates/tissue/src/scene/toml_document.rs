//! TOML with line numbers, the format of scenes and scripts. Every refusal can name the file, the line and the
//! key. `--set` overrides values before they are read.

use std::collections::BTreeMap;

use glam::{DQuat, DVec2, DVec3};
use toml::de::{DeTable, DeValue};

use crate::shape::PointName;
use palpate_refusal::{Reason, Refusal, Result, did_you_mean, excerpt, finite, nearest, unsigned_zero};

/// A parsed TOML text with its name and line numbers; [`Document::set`] may have changed values. It is read
/// once, by [`Document::read`].
#[derive(Debug)]
pub struct Document {
    name: String,
    root: DocumentNode,
}

/// A value and its line; no line if it came from `--set`.
#[derive(Debug, Clone)]
struct DocumentNode {
    line: Option<usize>,
    value: Value,
}

#[derive(Debug, Clone)]
enum Value {
    Text(String),
    Whole(i64),
    Number(f64),
    Flag(bool),
    List(Vec<DocumentNode>),
    Table(BTreeMap<String, DocumentNode>),
    Other,
}

impl Value {
    fn kind(&self) -> &'static str {
        match self {
            Value::Text(_) => "a string",
            Value::Whole(_) => "a whole number",
            Value::Number(_) => "a number",
            Value::Flag(_) => "true or false",
            Value::List(_) => "a list",
            Value::Table(_) => "a table",
            Value::Other => "a date",
        }
    }
}

impl Document {
    /// Parses TOML text; refusals call it `name`, often the path of a file. A −0 becomes 0, and an integer
    /// beyond 64 bits a number that is not whole.
    ///
    /// # Errors
    /// Refuses text that is not TOML ([`Reason::Unreadable`]), with `name:line` as the place.
    pub fn parse(name: &str, text: &str) -> Result<Self> {
        // Binary search for lines: a long file is read in nearly linear time.
        let starts: Vec<usize> =
            std::iter::once(0).chain(text.bytes().enumerate().filter(|b| b.1 == b'\n').map(|b| b.0 + 1)).collect();
        let line_of = |offset: usize| starts.partition_point(|&start| start <= offset);
        let table = DeTable::parse(text).map_err(|e| {
            let place = e.span().map_or(name.to_owned(), |span| format!("{name}:{}", line_of(span.start)));
            Refusal { place: Some(place), ..Refusal::new(Reason::Unreadable, "", e.message()) }
        })?;
        let root = DocumentNode { line: Some(1), value: table_of(table.get_ref(), &line_of) };
        Ok(Document { name: name.to_owned(), root })
    }

    /// Sets a value by `key.path=value`, in place of an earlier one; the value is TOML or, if it can't be
    /// parsed as that, a bare string. Creates missing tables on the path. An item of a list can't be set.
    /// Refusals of the value later name `--set` instead of a line.
    ///
    /// # Errors
    /// Refuses an assignment without `=`, an empty part of the path, and a path through a value that is not a
    /// table ([`Reason::WrongKind`], with the assignment as the field). Tables that it created before stay.
    pub fn set(&mut self, assignment: &str) -> Result<()> {
        let refuse = |message: String| Refusal {
            place: Some("--set".into()),
            ..Refusal::new(Reason::WrongKind, assignment, message)
        };
        let Some((path, text)) = assignment.split_once('=') else {
            return Err(refuse("must be key=value, as in stepping.integrator=central".into()));
        };
        let (path, text) = (path.trim(), text.trim());
        let value = match DeValue::parse(text) {
            Ok(value) => value_of(value.get_ref(), &|_| 0),
            Err(_) => Value::Text(text.to_owned()),
        };
        let mut node = &mut self.root;
        for key in path.split('.') {
            if key.is_empty() {
                return Err(refuse("has an empty part in its key".into()));
            }
            let Value::Table(entries) = &mut node.value else {
                return Err(refuse(format!("`{key}` is not within a table")));
            };
            let empty = DocumentNode { line: None, value: Value::Table(BTreeMap::new()) };
            node = entries.entry(key.to_owned()).or_insert(empty);
        }
        *node = DocumentNode { line: None, value };
        node.forget_lines();
        Ok(())
    }

    /// Returns whether the document has this top-level key (without dots), set ones included.
    pub fn has(&self, key: &str) -> bool {
        matches!(&self.root.value, Value::Table(entries) if entries.contains_key(key))
    }

    /// Returns a refusal of the whole document: its place is the document's name, without a line, and its field
    /// is empty.
    pub fn refuse(&self, reason: Reason, message: impl Into<String>) -> Refusal {
        Refusal { place: Some(self.name.clone()), ..Refusal::new(reason, "", message) }
    }

    /// Reads the whole document by `read`, which asks for its keys, and returns the result of `read`.
    ///
    /// # Errors
    /// Returns the refusal of `read` with its file and line ([`Document::locate`]), and refuses the first key
    /// that `read` did not ask for ([`Reason::UnknownKey`]).
    pub fn read<'a, T>(&'a self, read: impl FnOnce(&mut Fields<'a>) -> Result<T>) -> Result<T> {
        Item { path: String::new(), node: &self.root }.table(read).map_err(|refusal| self.locate(refusal))
    }

    /// Adds the place, `name:line`, to a refusal, unless it has a place already. The line is that of the value
    /// that its field names, or of the innermost table on the way that exists; `--set` if that value was set.
    pub fn locate(&self, mut refusal: Refusal) -> Refusal {
        if refusal.place.is_none() {
            let mut node = &self.root;
            for key in refusal.field.split(['.', '[', ']']).filter(|key| !key.is_empty()) {
                let inner = match &node.value {
                    Value::Table(entries) => entries.get(key),
                    Value::List(items) => key.parse::<usize>().ok().and_then(|index| items.get(index)),
                    _ => None,
                };
                // Report a missing key at the table that should have it.
                let Some(inner) = inner else { break };
                node = inner;
            }
            refusal.place = Some(match node.line {
                Some(line) => format!("{}:{line}", self.name),
                None => "--set".to_owned(),
            });
        }
        refusal
    }
}

impl DocumentNode {
    fn forget_lines(&mut self) {
        self.line = None;
        match &mut self.value {
            Value::List(items) => items.iter_mut().for_each(DocumentNode::forget_lines),
            Value::Table(entries) => entries.values_mut().for_each(DocumentNode::forget_lines),
            _ => {}
        }
    }
}

fn table_of(table: &DeTable<'_>, line_of: &dyn Fn(usize) -> usize) -> Value {
    let entry = |(key, value): (&toml::Spanned<_>, &toml::Spanned<DeValue<'_>>)| {
        let key: &std::borrow::Cow<'_, str> = key.get_ref();
        let line = Some(line_of(value.span().start));
        (key.to_string(), DocumentNode { line, value: value_of(value.get_ref(), line_of) })
    };
    Value::Table(table.iter().map(entry).collect())
}

fn number_of(digits: &str) -> Value {
    digits.parse().map_or(Value::Other, |number| Value::Number(unsigned_zero(number)))
}

fn value_of(value: &DeValue<'_>, line_of: &dyn Fn(usize) -> usize) -> Value {
    match value {
        DeValue::String(text) => Value::Text(text.to_string()),
        DeValue::Integer(whole) => {
            let digits = whole.as_str().replace('_', "");
            i64::from_str_radix(&digits, whole.radix()).map_or_else(|_| number_of(&digits), Value::Whole)
        }
        DeValue::Float(number) => number_of(&number.as_str().replace('_', "")),
        DeValue::Boolean(flag) => Value::Flag(*flag),
        DeValue::Datetime(_) => Value::Other,
        DeValue::Array(items) => Value::List(
            items
                .iter()
                .map(|item| DocumentNode {
                    line: Some(line_of(item.span().start)),
                    value: value_of(item.get_ref(), line_of),
                })
                .collect(),
        ),
        DeValue::Table(table) => table_of(table, line_of),
    }
}

/// The keys of one table, while [`Item::table`] or [`Document::read`] reads it. A key that the reader never
/// asks for counts as unknown, and is refused when the reader ends.
#[derive(Debug)]
pub struct Fields<'a> {
    path: String,
    entries: &'a BTreeMap<String, DocumentNode>,
    known: Vec<&'static str>,
}

/// One value of a document, with its path (`stepping.rate_hz`, `force[0].profile`), of a kind that is not known
/// yet.
#[derive(Debug)]
pub struct Item<'a> {
    path: String,
    node: &'a DocumentNode,
}

impl<'a> Fields<'a> {
    /// Returns the full path of this table; empty for the document.
    pub fn own_path(&self) -> &str {
        &self.path
    }

    /// Returns the full path of `key` in this table, for example `stepping.rate_hz`. The key need not exist.
    pub fn path(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    /// Returns a refusal of `key`, with its full path as the field; of the table itself if `key` is empty.
    pub fn refuse(&self, reason: Reason, key: &str, message: impl Into<String>) -> Refusal {
        let path = if key.is_empty() { self.path.clone() } else { self.path(key) };
        Refusal::new(reason, path, message)
    }

    /// Returns the value of `key`, of any kind, or `None` if it is absent. Marks the key as known.
    pub fn item(&mut self, key: &'static str) -> Option<Item<'a>> {
        self.known.push(key);
        self.entries.get(key).map(|node| Item { path: self.path(key), node })
    }

    /// Returns the value of `key`, of any kind. Marks the key as known.
    ///
    /// # Errors
    /// Refuses a missing key ([`Reason::Missing`]). If a similar key is there that has not been asked for, the
    /// refusal names that ([`Reason::UnknownKey`]): so ask for optional keys with similar names first.
    pub fn required(&mut self, key: &'static str) -> Result<Item<'a>> {
        let unknown: Vec<&String> = self.entries.keys().filter(|there| !self.known.contains(&there.as_str())).collect();
        self.item(key).ok_or_else(|| match unknown.into_iter().find(|there| meant(there, [key]).is_some()) {
            Some(there) => self.misspelt(there, key),
            None => self.refuse(Reason::Missing, key, "is missing"),
        })
    }

    fn misspelt(&self, there: &str, key: &str) -> Refusal {
        // A table has no unit.
        let is_value = self.entries.get(there).is_some_and(|node| !matches!(node.value, Value::Table(_)));
        let message = match key.strip_prefix(there) {
            Some(unit) if unit.starts_with('_') && is_value => {
                format!("unknown key: the unit belongs to the name, `{key}`")
            }
            _ => format!("unknown key; did you mean `{key}`?"),
        };
        self.refuse(Reason::UnknownKey, there, message)
    }

    /// Returns the value of `key` as a finite number, whole ones included; `None` if it is absent. Marks the
    /// key as known.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]), and one that is not finite
    /// ([`Reason::NotFinite`]).
    pub fn number(&mut self, key: &'static str) -> Result<Option<f64>> {
        self.item(key).map(|item| item.number()).transpose()
    }

    /// Returns the value of `key` as a finite number, whole ones included. Marks the key as known.
    ///
    /// # Errors
    /// Refuses a missing key, as [`Fields::required`] does, a value of another kind ([`Reason::WrongKind`]),
    /// and one that is not finite ([`Reason::NotFinite`]).
    pub fn required_number(&mut self, key: &'static str) -> Result<f64> {
        self.required(key)?.number()
    }

    /// Returns the value of `key` as a string; `None` if it is absent. Marks the key as known.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]).
    pub fn text(&mut self, key: &'static str) -> Result<Option<String>> {
        self.item(key).map(|item| item.text()).transpose()
    }

    /// Refuses a key that the reader did not ask for.
    fn done(&self) -> Result<()> {
        let Some(key) = self.entries.keys().find(|key| !self.known.contains(&key.as_str())) else { return Ok(()) };
        let absent = self.known.iter().copied().filter(|known| !self.entries.contains_key(*known));
        Err(match meant(key, absent) {
            Some(known) => self.misspelt(key, known),
            None => {
                let message = format!("unknown key; known here: {}", self.known.join(", "));
                self.refuse(Reason::UnknownKey, key, message)
            }
        })
    }
}

/// Rewrites serde's message about an unknown key: it names the most similar known key, or else all known keys.
/// Other messages are returned as they are.
pub fn nearest_name(message: &str) -> String {
    // As in "unknown field `lissen`, expected one of `listen`, `tls_cert`".
    let mut names = message.split('`').skip(1).step_by(2);
    match (message.starts_with("unknown field"), names.next()) {
        // Or one that has all of another, as `max_sessions`.
        (true, Some(given)) => match meant(given, names.clone()).or_else(|| {
            names.clone().filter(|name| name.len() > 4 && given.contains(name)).max_by_key(|name| name.len())
        }) {
            Some(name) => format!("unknown key; did you mean `{name}`?"),
            None => format!("unknown key; known here: {}", names.collect::<Vec<_>>().join(", ")),
        },
        _ => message.to_owned(),
    }
}

/// Returns the key that `there` probably stands for: the same without its unit, or misspelt.
fn meant<'k>(there: &str, keys: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    let keys: Vec<&str> = keys.into_iter().collect();
    let unit_is_missing = |key: &&&str| key.strip_prefix(there).is_some_and(|rest| rest.starts_with('_'));
    keys.iter().find(unit_is_missing).copied().or_else(|| nearest(there, keys.iter().copied()))
}

impl<'a> Item<'a> {
    /// Returns a refusal of this value, with its path as the field and without a place, which
    /// [`Document::read`] adds.
    pub fn refuse(&self, reason: Reason, message: impl Into<String>) -> Refusal {
        Refusal::new(reason, &self.path, message)
    }

    /// Returns a refusal ([`Reason::WrongKind`]) that says what was expected ("must be {expected}, but is …"),
    /// and what was probably meant. Words in quotation marks in `expected` are the allowed words.
    pub fn wrong(&self, expected: &str) -> Refusal {
        let words: Vec<&str> = expected.split('"').skip(1).step_by(2).collect();
        let is = match &self.node.value {
            Value::Text(text) if !words.is_empty() => {
                format!("`{}`{}", excerpt(text), did_you_mean(text, words.iter().copied()))
            }
            Value::Text(text) if expected.ends_with("number") && text.trim().parse::<f64>().is_ok() => {
                format!("a string: write {} without quotation marks", text.trim())
            }
            Value::Text(text) if expected == "true or false" && ["true", "false"].contains(&text.as_str()) => {
                format!("a string: write {text} without quotation marks")
            }
            #[allow(clippy::cast_possible_truncation)]
            Value::Number(number) if expected.ends_with("a whole number") => {
                let is_whole = number.fract() == 0.0 && number.abs() < 1e15;
                if is_whole { format!("{number:?}: write {}", *number as i64) } else { format!("{number:?}") }
            }
            other => other.kind().to_owned(),
        };
        self.refuse(Reason::WrongKind, format!("must be {expected}, but is {is}"))
    }

    /// Returns the value as a finite number, whole ones included.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]), and one that is not finite
    /// ([`Reason::NotFinite`]).
    pub fn number(&self) -> Result<f64> {
        match self.node.value {
            Value::Number(number) => finite(&self.path, number),
            #[allow(clippy::cast_precision_loss)]
            Value::Whole(whole) => Ok(whole as f64),
            _ => Err(self.wrong("a number")),
        }
    }

    /// Returns the value as an integer, 0 to 2^63 − 1.
    ///
    /// # Errors
    /// Refuses a value of another kind, `1.0` and larger integers among them ([`Reason::WrongKind`]), and a
    /// negative one ([`Reason::OutOfRange`]).
    pub fn whole(&self) -> Result<u64> {
        match self.node.value {
            Value::Whole(whole) => u64::try_from(whole)
                .map_err(|_| self.refuse(Reason::OutOfRange, format!("must be 0 or more, but is {whole}"))),
            _ => Err(self.wrong("a whole number")),
        }
    }

    /// Returns the value as a string.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]).
    pub fn text(&self) -> Result<String> {
        match &self.node.value {
            Value::Text(text) => Ok(text.clone()),
            _ => Err(self.wrong("a string")),
        }
    }

    /// Returns the value if it is a string, or `None` if it is of another kind.
    pub fn as_text(&self) -> Option<&'a str> {
        match &self.node.value {
            Value::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the value as true or false.
    ///
    /// # Errors
    /// Refuses a value of another kind, strings and 0 or 1 among them ([`Reason::WrongKind`]).
    pub fn flag(&self) -> Result<bool> {
        match self.node.value {
            Value::Flag(flag) => Ok(flag),
            _ => Err(self.wrong("true or false")),
        }
    }

    /// Returns the items of a list, in its order; they may be of any kind, and of different kinds.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]).
    pub fn list(&self) -> Result<Vec<Item<'a>>> {
        match &self.node.value {
            Value::List(items) => Ok(items
                .iter()
                .enumerate()
                .map(|(index, node)| Item { path: format!("{}[{index}]", self.path), node })
                .collect()),
            _ => Err(self.wrong("a list")),
        }
    }

    /// Returns the items of a list that should be tables (`[[key]]`), in its order. Their kind is checked when
    /// they are read ([`Item::table`]).
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]). For a single table the message says how to
    /// write the list.
    pub fn tables(&self) -> Result<Vec<Item<'a>>> {
        self.list().map_err(|refusal| match &self.node.value {
            Value::Table(_) => Refusal { message: format!("{}: write [[{}]]", refusal.message, self.path), ..refusal },
            _ => refusal,
        })
    }

    fn numbers<const N: usize>(&self, expected: &str) -> Result<[f64; N]> {
        let items = self.list().map_err(|_| self.wrong(expected))?;
        let numbers = items.iter().map(Item::number).collect::<Result<Vec<_>>>()?;
        numbers.try_into().map_err(|_| self.refuse(Reason::WrongKind, format!("must be {expected}")))
    }

    /// Returns the value as `[x, y, z]`, in the unit that its key names.
    ///
    /// # Errors
    /// Refuses a value that is not a list of three numbers ([`Reason::WrongKind`]), and a number that is not
    /// finite.
    pub fn vector(&self) -> Result<DVec3> {
        Ok(DVec3::from_array(self.numbers("a list of three numbers")?))
    }

    /// Returns the value, `[w, x, y, z]`, as a rotation.
    ///
    /// # Errors
    /// Refuses a value that is not a list of four numbers ([`Reason::WrongKind`]), a number that is not finite, and one whose length
    /// is not 1 within a thousandth ([`Reason::OutOfRange`]).
    pub fn quaternion(&self) -> Result<DQuat> {
        let [w, x, y, z] = self.numbers("a list of four numbers, w, x, y and z")?;
        let turn = DQuat::from_xyzw(x, y, z, w);
        if (turn.length() - 1.0).abs() <= 1e-3 {
            return Ok(turn.normalize());
        }
        Err(self.refuse(Reason::OutOfRange, format!("must have the length 1, but has {}", turn.length())))
    }

    /// Returns the value as `[x, y]`, in the unit that its key names.
    ///
    /// # Errors
    /// Refuses a value that is not a list of two numbers ([`Reason::WrongKind`]), and a number that is not
    /// finite.
    pub fn place(&self) -> Result<DVec2> {
        Ok(DVec2::from_array(self.numbers("a list of two numbers")?))
    }

    /// Returns the value as a place of a shape whose places have `dimensions` numbers, in the unit that its key names:
    /// `[x, y]` with z = 0, or `[x, y, z]`.
    ///
    /// # Errors
    /// Refuses a value that is not a list of so many numbers ([`Reason::WrongKind`]), and a number that is not finite.
    pub fn place_in(&self, dimensions: usize) -> Result<DVec3> {
        match dimensions {
            2 => Ok(self.place()?.extend(0.0)),
            _ => self.vector(),
        }
    }

    /// Returns the value as `[i, j]`, both 0 or more. Whether a tissue has this point is not checked.
    ///
    /// # Errors
    /// Refuses a value that is not a list of two whole numbers ([`Reason::WrongKind`]), and a negative one
    /// ([`Reason::OutOfRange`]).
    pub fn point(&self) -> Result<[usize; 2]> {
        let expected = "a list of two whole numbers";
        let items = self.list().map_err(|_| self.wrong(expected))?;
        let [i, j] = items.as_slice() else {
            return Err(self.refuse(Reason::WrongKind, format!("must be {expected}")));
        };
        let index = |item: &Item<'_>| {
            usize::try_from(item.whole()?).map_err(|_| item.refuse(Reason::OutOfRange, "is too large"))
        };
        Ok([index(i)?, index(j)?])
    }

    /// Returns the value as the name of a point: `[i, j]` of a sheet or the number of a vertex. Whether a
    /// tissue has this point is not checked.
    ///
    /// # Errors
    /// Refuses a list that [`Item::point`] refuses, and another value that is not a whole number from 0 to 2^32
    /// − 1 ([`Reason::WrongKind`]).
    pub fn point_name(&self) -> Result<PointName> {
        match self.node.value {
            Value::List(_) => Ok(PointName::Point(self.point()?)),
            _ => match self.whole().ok().and_then(|whole| u32::try_from(whole).ok()) {
                Some(vertex) => Ok(PointName::Vertex(vertex)),
                None => Err(self.wrong("[i, j] on a sheet, or on a mesh the number of a vertex, 0 or more")),
            },
        }
    }

    /// Returns whether the value is a table with this key.
    pub fn has(&self, key: &str) -> bool {
        matches!(&self.node.value, Value::Table(entries) if entries.contains_key(key))
    }

    /// Reads the value as a table by `read`, which asks for its keys, and returns the result of `read`.
    ///
    /// # Errors
    /// Refuses a value of another kind ([`Reason::WrongKind`]); returns the refusal of `read`; and refuses the
    /// first key that `read` did not ask for ([`Reason::UnknownKey`]).
    pub fn table<T>(&self, read: impl FnOnce(&mut Fields<'a>) -> Result<T>) -> Result<T> {
        let Value::Table(entries) = &self.node.value else { return Err(self.wrong("a table")) };
        let mut fields = Fields { path: self.path.clone(), entries, known: Vec::new() };
        let value = read(&mut fields)?;
        fields.done()?;
        Ok(value)
    }
}
