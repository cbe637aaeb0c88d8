//! The parts of glTF's JSON that are used, with lists of limited length.

use std::fmt;
use std::marker::PhantomData;

use serde::Deserialize;
use serde::de::{IgnoredAny, MapAccess, SeqAccess, Visitor};

use crate::Problem;
use crate::read::source::named;

/// Maximum number of nodes, meshes, accessors and so on in a file. They take more memory than their text.
pub(super) const MAX_NESTED: usize = 1 << 14;

/// Maximum number of extensions that are named in a refusal.
const NAMED: usize = 8;

/// A list of at most [`MAX_NESTED`] entries.
pub(super) struct Few<T>(pub(super) Vec<T>);

impl<T> Default for Few<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Few<T> {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for List<T> {
            type Value = Few<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "a list of at most {MAX_NESTED} entries")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Few<T>, A::Error> {
                let mut list = Vec::new();
                while let Some(entry) = entries.next_element()? {
                    if list.len() >= MAX_NESTED {
                        return Err(serde::de::Error::invalid_length(MAX_NESTED + 1, &self));
                    }
                    list.push(entry);
                }
                Ok(Few(list))
            }
        }
        deserializer.deserialize_seq(List(PhantomData))
    }
}

/// The part that is read first: it decides how the rest is read.
#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
pub(super) struct Head {
    asset: Asset,
    extensions_required: Few<String>,
    // Tables by name in version 1, lists by number in version 2.
    accessors: Outline,
    meshes: Outline,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct Asset {
    version: Outline,
}

/// The kind of a value, without the entries of lists and tables, which may be many.
#[derive(Default)]
enum Outline {
    Text(String),
    Number(f64),
    Table,
    #[default]
    Other,
}

impl<'de> Deserialize<'de> for Outline {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Outline;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "a text, a number, a list or a table")
            }

            fn visit_str<E>(self, text: &str) -> Result<Outline, E> {
                Ok(Outline::Text(text.to_owned()))
            }

            fn visit_f64<E>(self, number: f64) -> Result<Outline, E> {
                Ok(Outline::Number(number))
            }

            #[allow(clippy::cast_precision_loss)]
            fn visit_u64<E>(self, number: u64) -> Result<Outline, E> {
                Ok(Outline::Number(number as f64))
            }

            fn visit_unit<E>(self) -> Result<Outline, E> {
                Ok(Outline::Other)
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Outline, A::Error> {
                while entries.next_element::<IgnoredAny>()?.is_some() {}
                Ok(Outline::Other)
            }

            fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Outline, A::Error> {
                while entries.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
                Ok(Outline::Table)
            }
        }
        deserializer.deserialize_any(Any)
    }
}

/// Returns whether the triangles do not depend on an extension: one of textures, materials, lights or texts. The
/// normalized integers of `KHR_mesh_quantization` are supported.
fn is_harmless(extension: &str) -> bool {
    let parts =
        ["_texture", "_image", "_materials", "_lights", "_techniques", "MSFT_packing", "KHR_xmp", "KHR_animation"];
    extension == "KHR_mesh_quantization" || parts.iter().any(|part| extension.contains(part))
}

impl Head {
    /// Returns why the file can't be read, if so.
    pub(super) fn refusal(&self) -> Option<Problem> {
        let is_old = [&self.accessors, &self.meshes].into_iter().any(|list| matches!(list, Outline::Table));
        let version = match &self.asset.version {
            Outline::Text(version) => version.clone(),
            // 2 and 1.5 are kept, 1 becomes 1.0.
            Outline::Number(version) => format!("{version:?}"),
            // Version 1 need not be stated.
            _ if is_old => "1.0".to_owned(),
            _ => "2.0".to_owned(),
        };
        if version.split('.').next() != Some("2") {
            return Some(other_version(&version));
        }
        let needed = self.extensions_required.0.iter().filter(|name| !is_harmless(name));
        let needed: Vec<&str> = needed.map(String::as_str).take(NAMED).collect();
        (!needed.is_empty()).then(|| other_extension(&needed.join(", ")))
    }
}

/// Returns the problem of a file with a version other than 2.
pub(super) fn other_version(version: &str) -> Problem {
    let version = named(version.as_bytes());
    Problem::Unsupported { message: format!("glTF {version} is not read: export the file as glTF 2.0") }
}

/// Returns the problem of a file whose triangles require an unsupported extension.
pub(super) fn other_extension(extension: &str) -> Problem {
    let extension = named(extension.as_bytes());
    Problem::Unsupported { message: format!("needs {extension}, which is not read: export the file without it") }
}

/// A list of exactly `N` numbers.
pub(super) struct Numbers<const N: usize>(pub(super) [f64; N]);

impl<'de, const N: usize> Deserialize<'de> for Numbers<N> {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct List<const N: usize>;
        impl<'de, const N: usize> Visitor<'de> for List<N> {
            type Value = Numbers<N>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{N} numbers")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Numbers<N>, A::Error> {
                let mut numbers = [0.0; N];
                for (place, number) in numbers.iter_mut().enumerate() {
                    let entry = entries.next_element()?;
                    *number = entry.ok_or_else(|| serde::de::Error::invalid_length(place, &self))?;
                }
                if entries.next_element::<IgnoredAny>()?.is_some() {
                    let message = format!(
                        "more than {N} numbers: if decimal commas made two of one, export the file with decimal points"
                    );
                    return Err(serde::de::Error::custom(message));
                }
                Ok(Numbers(numbers))
            }
        }
        deserializer.deserialize_seq(List::<N>)
    }
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Root {
    #[serde(default)]
    pub(super) scene: usize,
    #[serde(default)]
    pub(super) scenes: Few<GltfScene>,
    #[serde(default)]
    pub(super) nodes: Few<GltfNode>,
    #[serde(default)]
    pub(super) meshes: Few<GltfMesh>,
    #[serde(default)]
    pub(super) materials: Few<Named>,
    #[serde(default)]
    pub(super) accessors: Few<Accessor>,
    #[serde(default)]
    pub(super) buffer_views: Few<View>,
    #[serde(default)]
    pub(super) buffers: Few<Buffer>,
}

#[derive(Deserialize)]
pub(super) struct GltfScene {
    #[serde(default)]
    pub(super) nodes: Few<u32>,
}

#[derive(Deserialize)]
pub(super) struct GltfNode {
    pub(super) name: Option<String>,
    pub(super) mesh: Option<usize>,
    #[serde(default)]
    pub(super) children: Few<u32>,
    pub(super) matrix: Option<Box<Numbers<16>>>,
    pub(super) translation: Option<Box<Numbers<3>>>,
    pub(super) rotation: Option<Box<Numbers<4>>>,
    pub(super) scale: Option<Box<Numbers<3>>>,
}

#[derive(Deserialize)]
pub(super) struct Named {
    pub(super) name: Option<String>,
}

#[derive(Deserialize)]
pub(super) struct GltfMesh {
    pub(super) name: Option<String>,
    #[serde(default)]
    pub(super) primitives: Few<Primitive>,
}

#[derive(Deserialize)]
pub(super) struct Primitive {
    pub(super) attributes: Attributes,
    pub(super) indices: Option<usize>,
    pub(super) material: Option<usize>,
    pub(super) mode: Option<u32>,
    #[serde(default)]
    pub(super) extensions: PrimitiveExtensions,
}

#[derive(Default, Deserialize)]
#[serde(default)]
pub(super) struct PrimitiveExtensions {
    #[serde(rename = "KHR_draco_mesh_compression")]
    pub(super) draco: Option<IgnoredAny>,
}

// Required, so that no short text creates many primitives.
#[derive(Deserialize)]
pub(super) struct Attributes {
    #[serde(rename = "POSITION")]
    pub(super) position: usize,
    #[serde(rename = "TEXCOORD_0")]
    pub(super) uv: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub(super) buffer_view: Option<usize>,
    #[serde(default)]
    pub(super) byte_offset: usize,
    pub(super) component_type: u32,
    #[serde(default)]
    pub(super) normalized: bool,
    pub(super) count: usize,
    #[serde(rename = "type")]
    pub(super) kind: String,
    pub(super) sparse: Option<Box<Sparse>>,
}

#[derive(Deserialize)]
pub(super) struct Sparse {
    pub(super) count: usize,
    pub(super) indices: SparsePart,
    pub(super) values: SparsePart,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SparsePart {
    pub(super) buffer_view: usize,
    #[serde(default)]
    pub(super) byte_offset: usize,
    pub(super) component_type: Option<u32>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct View {
    pub(super) buffer: usize,
    #[serde(default)]
    pub(super) byte_offset: usize,
    pub(super) byte_length: usize,
    pub(super) byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer {
    pub(super) uri: Option<String>,
    pub(super) byte_length: usize,
    #[serde(default)]
    pub(super) extensions: BufferExtensions,
}

/// Extensions that provide the content of a buffer.
#[derive(Default, Deserialize)]
#[serde(default)]
pub(super) struct BufferExtensions {
    #[serde(rename = "EXT_meshopt_compression", alias = "KHR_meshopt_compression")]
    pub(super) meshopt: Option<IgnoredAny>,
}
