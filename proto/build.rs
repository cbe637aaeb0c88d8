//! Compiles the protocol in Rust alone: no protoc is needed.

use std::collections::BTreeSet;
use std::error::Error;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{FieldDescriptorProto, FileDescriptorProto};

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
    let mut files = descriptors.file.clone();
    files.extend(compile_journal(&out)?);
    let has = |feature: &str| std::env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    if has("ETCD") {
        files.extend(compile_etcd(&out)?);
    }
    std::fs::write(out.join("shapes.rs"), shapes(&files)?)?;
    if std::env::var_os("CARGO_FEATURE_AGONES").is_some() {
        println!("cargo::rerun-if-changed=agones");
        // Including its server: tests imitate the SDK.
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
    // The size of messages is measured by their names before they are decoded (`measure`).
    let mut named = tonic_prost_build::Config::new();
    named.enable_type_names();
    configured
        .build_client(has("CLIENT"))
        .build_server(has("SERVER"))
        // Users of this crate choose their connections.
        .build_transport(false)
        .codec_path("crate::codec::BoundedCodec")
        .compile_fds_with_config(descriptors, named)?;
    Ok(())
}

/// Compiles the messages of journals into a folder of their own: they use those of the protocol, which are generated
/// once.
fn compile_journal(out: &Path) -> Result<Vec<FileDescriptorProto>, Box<dyn Error>> {
    println!("cargo::rerun-if-changed=foxglove");
    const FILES: [&str; 3] =
        ["palpate/journal/v1/header.proto", "palpate/journal/v1/curves.proto", "foxglove/PointCloud.proto"];
    let mut descriptors = protox::compile(FILES, ["."])?;
    let own = out.join("journal");
    std::fs::create_dir_all(&own)?;
    let mut config = prost_build::Config::new();
    config.out_dir(&own).extern_path(".palpate.v1", "crate::pb").enable_type_names();
    config.compile_fds(descriptors.clone())?;
    // Journals contain the schemas, without comments.
    descriptors.file.iter_mut().for_each(|file| file.source_code_info = None);
    std::fs::write(own.join("journal.bin"), prost::Message::encode_to_vec(&descriptors))?;
    Ok(descriptors.file)
}

/// Compiles the calls of etcd, of which we are only a client.
fn compile_etcd(out: &Path) -> Result<Vec<FileDescriptorProto>, Box<dyn Error>> {
    println!("cargo::rerun-if-changed=etcd");
    let descriptors = protox::compile(["etcd/rpc.proto"], ["."])?;
    let own = out.join("etcd");
    std::fs::create_dir_all(&own)?;
    let files = descriptors.file.clone();
    let mut named = tonic_prost_build::Config::new();
    named.enable_type_names();
    let configured = tonic_prost_build::configure().build_server(false).build_transport(false).out_dir(own);
    configured.codec_path("crate::codec::BoundedCodec").compile_fds_with_config(descriptors, named)?;
    Ok(files)
}

/// The modules of the generated messages that are measured, by package.
const MODULES: [(&str, &str); 4] = [
    ("palpate.v1", "crate::pb"),
    ("palpate.journal.v1", "crate::journal"),
    ("etcdserverpb", "crate::etcd::etcdserverpb"),
    ("mvccpb", "crate::etcd::mvccpb"),
];

/// Returns a table of the fields of each message, for `measure`.
fn shapes(files: &[FileDescriptorProto]) -> Result<String, Box<dyn Error>> {
    let mut paths = BTreeSet::new();
    let mut messages = Vec::new();
    for file in files {
        let Some((package, module)) = MODULES.iter().find(|module| module.0 == file.package()) else { continue };
        for message in &file.message_type {
            let path = format!("{package}.{}", message.name());
            if !message.nested_type.is_empty() {
                return Err(format!("{path} has messages within it, which are not measured").into());
            }
            if paths.insert(path.clone()) {
                messages.push((path, format!("{module}::{}", message.name()), &message.field));
            }
        }
    }
    let place = |name: &str| messages.iter().position(|message| Some(message.0.as_str()) == name.strip_prefix('.'));
    let kind = |field: &FieldDescriptorProto| -> Result<String, Box<dyn Error>> {
        Ok(match field.r#type() {
            Type::Double | Type::Fixed64 | Type::Sfixed64 => "Number(8, 8)".to_owned(),
            Type::Float | Type::Fixed32 | Type::Sfixed32 => "Number(4, 4)".to_owned(),
            Type::Int64 | Type::Uint64 | Type::Sint64 => "Number(8, 0)".to_owned(),
            Type::Int32 | Type::Uint32 | Type::Sint32 | Type::Enum => "Number(4, 0)".to_owned(),
            Type::Bool => "Number(1, 0)".to_owned(),
            Type::String | Type::Bytes => "Text".to_owned(),
            Type::Message | Type::Group => {
                let of = place(field.type_name()).ok_or_else(|| format!("{} is not measured", field.type_name()))?;
                format!("Message({of})")
            }
        })
    };
    let mut table = String::from("static SHAPES: &[Shape] = &[\n");
    for (name, path, fields) in &messages {
        let decode = format!("|bytes| <{path} as Message>::decode(bytes).is_ok()");
        writeln!(table, "Shape {{ name: \"{name}\", bytes: size_of::<{path}>(), decode: {decode}, fields: &[")?;
        for field in *fields {
            let (number, is_list, kind) = (field.number(), field.label() == Label::Repeated, kind(field)?);
            writeln!(table, "Field {{ number: {number}, is_list: {is_list}, kind: FieldKind::{kind} }},")?;
        }
        table.push_str("] },\n");
    }
    table.push_str("];\n");
    Ok(table)
}
