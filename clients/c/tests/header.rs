//! Checks that the header in the repository is the one that cbindgen generates. `make header` writes it again.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;

#[test]
fn the_header_is_that_of_the_sources() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = folder.join("include/palpate.h");
    let mut made = Vec::new();
    cbindgen::generate(folder).expect("cbindgen reads the sources").write(&mut made);
    if std::env::var_os("PALPATE_WRITE_HEADER").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let kept = std::fs::read(&path).unwrap_or_default();
    assert!(kept == made, "{} is not that of the sources: run `make header`", path.display());
}
