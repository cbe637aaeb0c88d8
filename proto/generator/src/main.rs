//! Writes the Rust code of the protocol: `make protocol`.
//!
//! The code is checked in, at `proto/generated`, since its generation takes longer than its compilation and most builds
//! don't change the protocol. A test compares it with the protocol. No protoc is needed.

use std::collections::BTreeSet;
use std::error::Error;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};
use tonic_prost_build::Config;

/// The codec of every call: it decodes within limits.
const CODEC: &str = "crate::codec::BoundedCodec";

fn main() -> Result<(), Box<dyn Error>> {
    generate(&protocol().join("generated"))
}

/// Returns the folder of the protocol.
fn protocol() -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), ".."].iter().collect()
}

/// Writes the generated code into the folder `out`.
fn generate(out: &Path) -> Result<(), Box<dyn Error>> {
    let public = compiled(&[
        "palpate/v1/session.proto",
        "palpate/v1/exercise.proto",
        "palpate/v1/haptic.proto",
        "palpate/v1/view.proto",
        "palpate/v1/admin.proto",
        "palpate/v1/node.proto",
    ])?;
    let mut journal =
        compiled(&["palpate/journal/v1/header.proto", "palpate/journal/v1/curves.proto", "foxglove/PointCloud.proto"])?;
    let etcd = compiled(&["etcd/rpc.proto"])?;
    let agones = compiled(&["agones/sdk.proto", "agones/beta.proto"])?;

    let files = [&public, &journal, &etcd].into_iter().flat_map(|set| &set.file);
    std::fs::write(out.join("shapes.rs"), shapes(files)?)?;
    std::fs::write(out.join("decoders.rs"), decoders(&public))?;
    std::fs::write(out.join("palpate.v1.bin"), prost::Message::encode_to_vec(&public))?;
    // Frames are shared between viewers, not copied for each.
    let shared = [".palpate.v1.Patch.displacement", ".palpate.v1.GetTextureResponse.png"];
    shared
        .iter()
        .fold(code(out), tonic_prost_build::Builder::bytes)
        .client_mod_attribute(".", "#[cfg(feature = \"client\")]")
        .server_mod_attribute(".", "#[cfg(feature = \"server\")]")
        .codec_path(CODEC)
        .compile_fds_with_config(public, named())?;

    // The messages of journals use those of the protocol, which are generated once.
    code(out).extern_path(".palpate.v1", "crate::pb").compile_fds_with_config(journal.clone(), named())?;
    // Journals contain the schemas, without comments.
    journal.file.iter_mut().for_each(|file| file.source_code_info = None);
    std::fs::write(out.join("palpate.journal.v1.bin"), prost::Message::encode_to_vec(&journal))?;

    // A fleet is only a client of etcd.
    code(out).build_server(false).codec_path(CODEC).compile_fds_with_config(etcd, named())?;
    // Including its server: tests imitate the SDK.
    code(out).compile_fds(agones)?;
    Ok(())
}

/// Returns the descriptors of files of the protocol and of all that they import.
fn compiled(files: &[&str]) -> Result<FileDescriptorSet, Box<dyn Error>> {
    Ok(protox::compile(files, [protocol()])?)
}

/// Returns a generator that writes into the folder `out`. Users of the code choose their connections.
fn code(out: &Path) -> tonic_prost_build::Builder {
    tonic_prost_build::configure().build_transport(false).out_dir(out)
}

/// Returns a configuration that names the messages: their size is measured by their names before they are decoded
/// (`measure`).
fn named() -> Config {
    let mut config = Config::new();
    config.enable_type_names();
    config
}

/// Returns the table of the types of requests, each with its decoder.
fn decoders(public: &FileDescriptorSet) -> String {
    let requests = public.file.iter().flat_map(|file| &file.service).flat_map(|service| &service.method);
    let names: BTreeSet<_> = requests.filter_map(|method| method.input_type().rsplit('.').next()).collect();
    let decoder = |name| format!("(\"{name}\", |bytes| <{name} as ::prost::Message>::decode(bytes).is_ok()),\n");
    format!("&[\n{}]\n", names.into_iter().map(decoder).collect::<String>())
}

/// The modules of the generated messages that are measured, by package.
const MODULES: [(&str, &str); 4] = [
    ("palpate.v1", "crate::pb"),
    ("palpate.journal.v1", "crate::journal"),
    ("etcdserverpb", "crate::etcd::etcdserverpb"),
    ("mvccpb", "crate::etcd::mvccpb"),
];

/// Returns a table of the fields of each message, for `measure`.
fn shapes<'a>(files: impl Iterator<Item = &'a FileDescriptorProto>) -> Result<String, Box<dyn Error>> {
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
        // Those of etcd are the last, so that no other message changes its place without them.
        if path.contains("::etcd::") {
            table.push_str("#[cfg(feature = \"etcd\")]\n");
        }
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

#[cfg(test)]
#[test]
#[allow(clippy::unwrap_used)]
fn the_generated_code_is_that_of_the_protocol() {
    let folder = tempfile::tempdir().unwrap();
    generate(folder.path()).unwrap();
    let names = |folder: &Path| -> BTreeSet<_> {
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect()
    };
    let checked_in = protocol().join("generated");
    assert_eq!(names(folder.path()), names(&checked_in), "run `make protocol`");
    for name in names(folder.path()) {
        let is_same =
            std::fs::read(folder.path().join(&name)).unwrap() == std::fs::read(checked_in.join(&name)).unwrap();
        assert!(is_same, "proto/generated/{} differs: run `make protocol`", name.display());
    }
}
