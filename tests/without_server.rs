//! Everything that needs no running server, in one program: each would link the tissue and the sessions again.
//! `cargo test --release --test without_server solid::` runs one file of it.
#![allow(clippy::unwrap_used)]

#[path = "common"]
mod common {
    #[path = "mod.rs"]
    mod shared;

    pub(crate) use shared::*;

    pub(crate) mod cases;
    pub(crate) mod closed_mesh;
    pub(crate) mod journal_opening;
    pub(crate) mod moved;
    pub(crate) mod random;
    pub(crate) mod random_scenes;
    pub(crate) mod thin_mesh;
}

mod bounds;
mod command_line;
mod cuts;
mod instruments;
mod journal;
mod journal_signed;
mod legal;
mod mesh;
mod mesh_program;
mod mesh_touch;
mod numbers;
mod printable;
mod properties;
mod recovery;
mod reference;
mod render;
mod restored;
mod scenes;
mod scripts;
mod simulation;
mod sleep;
mod snapshot;
mod solid;
mod stress;
mod thin;
mod tolerance;
mod volume;
