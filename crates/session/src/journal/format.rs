//! What every journal has in common: its topics, their schemas, and the bounds of a batch.

use std::collections::BTreeSet;

use palpate_proto::journal as pb;
use prost::Message;

use super::records::{self, CHANNEL, SCHEMA};

/// Raised with each change after which the same inputs give other bits: a journal with another number is shown and exported, but
/// neither verified nor gone on from.
pub const REPLAYS: u32 = 3;

/// The version that writes.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Most inputs in a batch. With more, a flush writes several.
pub const MAX_INPUTS: usize = 1 << 16;

/// Largest chunk that is read, bytes. A writer begins another batch long before; only a single snapshot may be large.
pub const MAX_BYTES: u64 = 1 << 30;

/// The messages of a journal. Their numbers are those of their channels and schemas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// `Header`.
    Header = 1,
    /// `Inputs`.
    Inputs = 2,
    /// `Hash`.
    Hashes = 3,
    /// `Snapshot`.
    Snapshots = 4,
    /// `Felt`.
    Felt = 5,
    /// `End`.
    End = 6,
    /// `Waiting`.
    Waiting = 7,
    /// `Signature`.
    Signatures = 8,
}

impl Topic {
    /// All of them.
    pub const ALL: [Topic; 8] = [
        Topic::Header,
        Topic::Inputs,
        Topic::Hashes,
        Topic::Snapshots,
        Topic::Felt,
        Topic::End,
        Topic::Waiting,
        Topic::Signatures,
    ];

    /// Returns the topic of its channel.
    pub fn name(self) -> &'static str {
        match self {
            Topic::Header => "/header",
            Topic::Inputs => "/inputs",
            Topic::Hashes => "/hashes",
            Topic::Snapshots => "/snapshots",
            Topic::Felt => "/felt",
            Topic::End => "/end",
            Topic::Waiting => "/waiting",
            Topic::Signatures => "/signatures",
        }
    }

    /// Name of the message.
    fn message(self) -> &'static str {
        match self {
            Topic::Header => "Header",
            Topic::Inputs => "Inputs",
            Topic::Hashes => "Hash",
            Topic::Snapshots => "Snapshot",
            Topic::Felt => "Felt",
            Topic::End => "End",
            Topic::Waiting => "Waiting",
            Topic::Signatures => "Signature",
        }
    }

    /// Returns the number of its channel.
    pub fn channel(self) -> u16 {
        self as u16
    }
}

/// A file of the protocol, as far as its imports are concerned.
#[derive(Clone, PartialEq, Message)]
struct ProtoFile {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, repeated, tag = "3")]
    dependency: Vec<String>,
}

/// Files of the protocol, each as its bytes.
#[derive(Clone, PartialEq, Message)]
struct Files {
    #[prost(bytes = "vec", repeated, tag = "1")]
    file: Vec<Vec<u8>>,
}

/// The schema of a topic.
fn schema(topic: Topic) -> Vec<u8> {
    schema_of(if topic == Topic::Header {
        "palpate/journal/v1/header.proto"
    } else {
        "palpate/journal/v1/journal.proto"
    })
}

/// Returns a file of the protocol and all that it imports: a `FileDescriptorSet`.
pub fn schema_of(file: &str) -> Vec<u8> {
    let all = Files::decode(pb::DESCRIPTORS).unwrap_or_default();
    let mut wanted = BTreeSet::from([file.to_owned()]);
    // Each file is after its imports.
    let mut kept: Vec<Vec<u8>> = Vec::new();
    for bytes in all.file.into_iter().rev() {
        let file = ProtoFile::decode(&*bytes).unwrap_or_default();
        if wanted.contains(&file.name) {
            wanted.extend(file.dependency);
            kept.push(bytes);
        }
    }
    kept.reverse();
    Files { file: kept }.encode_to_vec()
}

/// The schemas and channels of all topics, as records; that of signatures only if there are some.
pub(super) fn channels(out: &mut Vec<u8>, signed: bool) {
    for topic in Topic::ALL.into_iter().filter(|topic| signed || *topic != Topic::Signatures) {
        records::record(out, SCHEMA, |body| {
            body.extend(topic.channel().to_le_bytes());
            records::string(body, &format!("palpate.journal.v1.{}", topic.message()));
            records::string(body, "protobuf");
            records::bytes(body, &schema(topic));
        });
        records::record(out, CHANNEL, |body| {
            body.extend(topic.channel().to_le_bytes());
            body.extend(topic.channel().to_le_bytes());
            records::string(body, topic.name());
            records::string(body, "protobuf");
            // No metadata.
            body.extend(0_u32.to_le_bytes());
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schema_has_its_message_and_all_that_it_imports_in_order() {
        for topic in Topic::ALL {
            let files = Files::decode(&*schema(topic)).unwrap().file;
            let mut seen = BTreeSet::new();
            for file in &files {
                let file = ProtoFile::decode(&**file).unwrap();
                assert!(file.dependency.iter().all(|import| seen.contains(import)), "{topic:?}: {}", file.name);
                seen.insert(file.name);
            }
            assert_eq!(seen.len(), if topic == Topic::Header { 4 } else { 2 }, "{topic:?}: {seen:?}");
            // Comments, which would be most of it, are not in it.
            assert!(schema(topic).len() < 10_000, "{topic:?}: {} bytes", schema(topic).len());
        }
    }
}
