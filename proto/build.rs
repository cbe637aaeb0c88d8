//! Compiles the protocol in Rust alone: no protoc is needed.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    const FILES: [&str; 4] =
        ["palpate/v1/session.proto", "palpate/v1/haptic.proto", "palpate/v1/view.proto", "palpate/v1/admin.proto"];
    println!("cargo::rerun-if-changed=palpate");
    let descriptors = protox::compile(FILES, ["."])?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    std::fs::write(out.join("palpate.bin"), prost::Message::encode_to_vec(&descriptors))?;
    let requests = descriptors.file.iter().flat_map(|file| &file.service).flat_map(|service| &service.method);
    let names: BTreeSet<_> = requests.filter_map(|method| method.input_type().rsplit('.').next()).collect();
    let decoders: String = names
        .iter()
        .map(|name| format!("(\"{name}\", |bytes| <{name} as ::prost::Message>::decode(bytes).is_ok()),\n"))
        .collect();
    std::fs::write(out.join("decoders.rs"), format!("&[\n{decoders}]\n"))?;
    // Frames are shared between viewers, not copied for each.
    let shared = [".palpate.v1.Patch.displacement", ".palpate.v1.GetTextureResponse.png"];
    let configured = shared.iter().fold(tonic_prost_build::configure(), tonic_prost_build::Builder::bytes);
    // Requests are bounded before they are decoded (`codec`), which recognizes them by their names.
    let mut named = tonic_prost_build::Config::new();
    named.enable_type_names();
    let has = |feature: &str| std::env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    configured
        .build_client(has("CLIENT"))
        .build_server(has("SERVER"))
        // Connections are the users' choice.
        .build_transport(false)
        .codec_path("crate::codec::BoundedCodec")
        .compile_fds_with_config(descriptors, named)?;
    Ok(())
}
