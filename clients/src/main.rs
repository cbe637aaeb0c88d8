//! Placeholder while the server takes shape.
fn main() {}
