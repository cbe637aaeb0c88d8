//! Compiles the protocol in Rust alone: no protoc is needed.

use std::collections::BTreeSet;
use std::error::Error;
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    const FILES: [&str; 5] = [
        "palpate/v1/session.proto",
        "palpate/v1/haptic.proto",
        "palpate/v1/view.proto",
        "palpate/v1/admin.proto",
        "palpate/v1/node.proto",
    ];
    println!("cargo::rerun-if-changed=palpate");
    let descriptors = protox::compile(FILES, ["."])?;
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    compile_journal(&out)?;
    let has = |feature: &str| std::env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    if has("ETCD") {
        compile_etcd(&out)?;
    }
    if std::env::var_os("CARGO_FEATURE_AGONES").is_some() {
        println!("cargo::rerun-if-changed=agones");
        // With its server: tests imitate the SDK.
        tonic_prost_build::configure()
            .build_transport(false)
            .compile_fds(protox::compile(["agones/sdk.proto", "agones/beta.proto"], ["."])?)?;
    }
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
    configured
        .build_client(has("CLIENT"))
        .build_server(has("SERVER"))
        // Connections are the users' choice.
        .build_transport(false)
        .codec_path("crate::codec::BoundedCodec")
        .compile_fds_with_config(descriptors, named)?;
    Ok(())
}

/// The messages of journals, in a folder of their own: they use those of the protocol, which are generated once.
fn compile_journal(out: &Path) -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=foxglove");
    const FILES: [&str; 3] =
        ["palpate/journal/v1/header.proto", "palpate/journal/v1/curves.proto", "foxglove/PointCloud.proto"];
    let mut descriptors = protox::compile(FILES, ["."])?;
    let own = out.join("journal");
    std::fs::create_dir_all(&own)?;
    let mut config = prost_build::Config::new();
    config.out_dir(&own).extern_path(".palpate.v1", "crate::pb").compile_fds(descriptors.clone())?;
    // Journals have the schemas in them, without their comments.
    descriptors.file.iter_mut().for_each(|file| file.source_code_info = None);
    std::fs::write(own.join("journal.bin"), prost::Message::encode_to_vec(&descriptors))?;
    Ok(())
}

/// The calls of etcd, of which we are a client only.
fn compile_etcd(out: &Path) -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=etcd");
    let descriptors = protox::compile(["etcd/rpc.proto"], ["."])?;
    let own = out.join("etcd");
    std::fs::create_dir_all(&own)?;
    let configured = tonic_prost_build::configure().build_server(false).build_transport(false).out_dir(own);
    configured.compile_fds(descriptors)?;
    Ok(())
}
