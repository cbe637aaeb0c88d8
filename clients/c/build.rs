//! Sets the soname of the shared library, by which programs find it.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let is_elf = std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "linux" || os.ends_with("bsd"));
    if is_elf {
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libpalpate.so.0");
    }
}
