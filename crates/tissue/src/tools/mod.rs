//! What tools do to a tissue: forces, prescribed displacements, contact of a tip's disc (`contact`) or of a rigid tip, what threads
//! and clips hold (`tie`), and what tips burn (`burns`).

pub(crate) mod applied_force;
pub(crate) mod blade;
pub(crate) mod burns;
pub(crate) mod contact;
pub(crate) mod input;
pub(crate) mod prescribed;
pub(crate) mod rigid_tip;
pub(crate) mod tie;
