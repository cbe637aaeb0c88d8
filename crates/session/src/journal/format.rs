//! The format of journals: topics, their schemas, and limits of a batch.

use std::collections::BTreeSet;

use palpate_proto::journal as pb;
use prost::Message;

use super::records::{self, CHANNEL, SCHEMA};

/// Generation of the arithmetic. It is raised with each change after which equal inputs give other bits. A journal
/// with another number can be shown and exported, but neither verified nor continued.
pub const REPLAYS: u32 = 6;

/// Version of this program, which it writes into journals.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Largest number of inputs in a batch. A writer ends the batch there, and a reader treats a batch with more as
/// damaged.
pub const MAX_INPUTS: usize = 1 << 16;

/// Largest size of a chunk that is read, bytes: 1 GiB. A larger one is treated as damaged. A writer ends a batch at
/// about 4 MiB; only a single snapshot may be larger.
pub const MAX_BYTES: u64 = 1 << 30;

/// Topics of a journal's messages. The number of a topic is that of its channel and its schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// Message `Header`: the session, its scene and the run.
    Header = 1,
    /// Message `Inputs`: the inputs of a batch.
    Inputs = 2,
    /// Message `Hash`: a hash of the state at a step.
    Hashes = 3,
    /// Message `Snapshot`: a session at a step.
    Snapshots = 4,
    /// Message `Felt`: poses and forces of the tools.
    Felt = 5,
    /// Message `End`: why the journal ends.
    End = 6,
    /// Message `Waiting`: changes of the tissue that wait for their step.
    Waiting = 7,
    /// Message `Signature`: a signature of all messages before it.
    Signatures = 8,
}

impl Topic {
    /// Every topic, in the order of declaration, which is that of the numbers.
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

    /// Returns the name of the topic, as its MCAP channel has it, such as `/inputs`.
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

    /// Returns the name of the message type.
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

    /// Returns the number of the topic's channel, 1 to 8, which is also that of its schema.
    pub fn channel(self) -> u16 {
        self as u16
    }
}

/// Name and imports of a file of the protocol.
#[derive(Clone, PartialEq, Message)]
struct ProtoFile {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, repeated, tag = "3")]
    dependency: Vec<String>,
}

/// Encoded files of the protocol.
#[derive(Clone, PartialEq, Message)]
struct Files {
    #[prost(bytes = "vec", repeated, tag = "1")]
    file: Vec<Vec<u8>>,
}

/// Returns the schema of a topic.
fn schema(topic: Topic) -> Vec<u8> {
    schema_of(if topic == Topic::Header {
        "palpate/journal/v1/header.proto"
    } else {
        "palpate/journal/v1/journal.proto"
    })
}

/// Returns a file of the protocol, such as `palpate/journal/v1/journal.proto`, and all files that it imports, each
/// after its imports, as an encoded `FileDescriptorSet`. An unknown file gives an empty set.
pub fn schema_of(file: &str) -> Vec<u8> {
    let all = Files::decode(pb::DESCRIPTORS).unwrap_or_default();
    let mut wanted = BTreeSet::from([file.to_owned()]);
    // Each file comes after its imports.
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

/// Appends the schemas and channels of all topics, as records; those of signatures only if `signed`.
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
            assert!(schema(topic).len() < 13_000, "{topic:?}: {} bytes", schema(topic).len());
        }
    }
}
