//! Puts many mutants into one build, so that it is compiled once: each mutated expression becomes
//! `if crate::mutant(ID) { mutated } else { original }`, and a process gets its mutant from the environment variable
//! PALPATE_MUTANT.
//!
//! `palpate-mutants MUTANTS.json ROOT` rewrites the files under ROOT that the mutants name. It prints the ids of
//! those that it can't place: constants and patterns have no place for a condition.

use std::collections::BTreeMap;
use std::path::Path;

use proc_macro2::{LineColumn, Span};
use serde::Deserialize;
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

type AnyResult<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// A mutant as `cargo mutants --list` describes it.
#[derive(Deserialize)]
struct Mutant {
    id: u32,
    file: String,
    line: usize,
    column: usize,
    genre: String,
    replacement: String,
}

/// Text to insert at a place. Of those at one place, the one of lower order comes first.
struct Insertion {
    at: usize,
    order: i64,
    text: String,
}

/// Ends of expressions come before beginnings at the same place, and those of inner ones before those of outer ones.
const END: i64 = -1_000_000_000;

struct Fitter<'a> {
    source: &'a str,
    /// Where each line begins.
    lines: Vec<usize>,
    /// Those that have no place yet.
    waiting: Vec<Mutant>,
    insertions: Vec<Insertion>,
}

impl Fitter<'_> {
    fn place(&self, at: LineColumn) -> usize {
        let line = self.lines[at.line - 1];
        self.source[line..].char_indices().nth(at.column).map_or(self.source.len(), |(offset, _)| line + offset)
    }

    fn ends(&self, span: Span) -> (usize, usize) {
        (self.place(span.start()), self.place(span.end()))
    }

    fn text(&self, span: Span) -> &str {
        let (from, to) = self.ends(span);
        &self.source[from..to]
    }

    /// Takes the mutants of a genre at the beginning of `span`.
    fn take(&mut self, span: Span, genre: &str) -> Vec<Mutant> {
        let start = span.start();
        let is_here = |mutant: &mut Mutant| {
            mutant.genre == genre && mutant.line == start.line && mutant.column == start.column + 1
        };
        self.waiting.extract_if(.., is_here).collect()
    }

    fn insert(&mut self, at: usize, order: i64, text: String) {
        self.insertions.push(Insertion { at, order, text });
    }

    /// Puts `before` and `after` around a span.
    fn around(&mut self, span: Span, before: String, after: &str) {
        let (from, to) = self.ends(span);
        let length = (to - from) as i64;
        self.insert(from, -length, before);
        self.insert(to, END + length, after.to_owned());
    }

    fn instead(&mut self, span: Span, id: u32, mutated: &str) {
        self.around(span, format!("(if crate::mutant({id}) {{ {mutated} }} else {{ "), " })");
    }

    /// A whole function that returns something else.
    fn function(&mut self, signature: &syn::Signature, block: &syn::Block) {
        let Some(first) = block.stmts.first().filter(|_| signature.constness.is_none()) else { return };
        let begin = self.place(block.brace_token.span.open().end());
        for Mutant { id, replacement, .. } in self.take(first.span(), "FnValue") {
            self.insert(begin, 2 * END, format!(" if crate::mutant({id}) {{ return {replacement}; }} "));
        }
    }
}

/// `let` within a condition can't be put into another expression.
fn has_let(expression: &syn::Expr) -> bool {
    match expression {
        syn::Expr::Let(_) => true,
        syn::Expr::Binary(binary) => has_let(&binary.left) || has_let(&binary.right),
        _ => false,
    }
}

impl<'a> Visit<'a> for Fitter<'_> {
    fn visit_item_const(&mut self, _: &'a syn::ItemConst) {}
    fn visit_impl_item_const(&mut self, _: &'a syn::ImplItemConst) {}
    fn visit_item_static(&mut self, _: &'a syn::ItemStatic) {}

    fn visit_item_fn(&mut self, item: &'a syn::ItemFn) {
        self.function(&item.sig, &item.block);
        if item.sig.constness.is_none() {
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'a syn::ImplItemFn) {
        self.function(&item.sig, &item.block);
        if item.sig.constness.is_none() {
            visit::visit_impl_item_fn(self, item);
        }
    }

    fn visit_trait_item_fn(&mut self, item: &'a syn::TraitItemFn) {
        if let Some(block) = &item.default {
            self.function(&item.sig, block);
        }
        visit::visit_trait_item_fn(self, item);
    }

    fn visit_expr_binary(&mut self, binary: &'a syn::ExprBinary) {
        if !has_let(&binary.left) && !has_let(&binary.right) {
            for Mutant { id, replacement, .. } in self.take(binary.op.span(), "BinaryOperator") {
                let (left, right) = (self.text(binary.left.span()), self.text(binary.right.span()));
                let mutated = format!("{left} {replacement} {right}");
                self.instead(binary.span(), id, &mutated);
            }
        }
        visit::visit_expr_binary(self, binary);
    }

    fn visit_expr_unary(&mut self, unary: &'a syn::ExprUnary) {
        for Mutant { id, .. } in self.take(unary.op.span(), "UnaryOperator") {
            let mutated = self.text(unary.expr.span()).to_owned();
            self.instead(unary.span(), id, &mutated);
        }
        visit::visit_expr_unary(self, unary);
    }

    fn visit_arm(&mut self, arm: &'a syn::Arm) {
        let guard = arm.guard.as_ref().map(|(_, guard)| guard);
        if guard.is_none_or(|guard| !has_let(guard)) {
            for Mutant { id, .. } in self.take(arm.span(), "MatchArm") {
                match guard {
                    Some(guard) => self.around(guard.span(), format!("!crate::mutant({id}) && ("), ")"),
                    None => {
                        let end = self.place(arm.pat.span().end());
                        self.insert(end, -1, format!(" if !crate::mutant({id})"));
                    }
                }
            }
            if let Some(guard) = guard {
                for Mutant { id, replacement, .. } in self.take(guard.span(), "MatchArmGuard") {
                    self.instead(guard.span(), id, &replacement);
                }
            }
        }
        visit::visit_arm(self, arm);
    }

    fn visit_expr_struct(&mut self, structure: &'a syn::ExprStruct) {
        if let Some(rest) = &structure.rest {
            for field in &structure.fields {
                for Mutant { id, .. } in self.take(field.span(), "StructField") {
                    let (member, rest) = (self.text(field.member.span()).to_owned(), self.text(rest.span()));
                    let mutated = format!("({rest}).{member}");
                    if field.colon_token.is_some() {
                        self.instead(field.expr.span(), id, &mutated);
                    } else {
                        let before = format!("{member}: (if crate::mutant({id}) {{ {mutated} }} else {{ ");
                        self.around(field.span(), before, " })");
                    }
                }
            }
        }
        visit::visit_expr_struct(self, structure);
    }
}

/// Fits mutants into the text of a file. Returns the text, and the ids of those without a place.
fn fitted(source: &str, mutants: Vec<Mutant>) -> AnyResult<(String, Vec<u32>)> {
    let lines = std::iter::once(0).chain(source.match_indices('\n').map(|(at, _)| at + 1)).collect();
    let mut fitter = Fitter { source, lines, waiting: mutants, insertions: Vec::new() };
    fitter.visit_file(&syn::parse_file(source)?);
    let Fitter { mut insertions, waiting, .. } = fitter;
    insertions.sort_by_key(|insertion| (insertion.at, insertion.order));
    let (mut text, mut from) = (String::new(), 0);
    for Insertion { at, text: inserted, .. } in insertions {
        text += &source[from..at];
        text += &inserted;
        from = at;
    }
    Ok((text + &source[from..], waiting.into_iter().map(|mutant| mutant.id).collect()))
}

fn main() -> AnyResult<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, list, root] = &arguments[..] else { return Err("usage: palpate-mutants MUTANTS.json ROOT".into()) };
    let mutants: Vec<Mutant> = serde_json::from_str(&std::fs::read_to_string(list)?)?;
    let mut files: BTreeMap<String, Vec<Mutant>> = BTreeMap::new();
    for mutant in mutants {
        files.entry(mutant.file.clone()).or_default().push(mutant);
    }
    for (file, mutants) in files {
        let path = Path::new(root).join(&file);
        let (text, unplaced) = fitted(&std::fs::read_to_string(&path)?, mutants)?;
        std::fs::write(&path, text)?;
        unplaced.iter().for_each(|id| println!("{id}"));
    }
    Ok(())
}
